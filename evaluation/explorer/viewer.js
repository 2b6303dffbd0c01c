// Draws a structure that moves: one or two views with one camera, colour by a number per node, nodes picked by hand.
// Faces are lit by the slope of what is drawn (derivatives in the shader), so that moving nodes need no normals.
'use strict';

function makeViewer(canvas, faces, reference) {
  const gl = canvas.getContext('webgl2', {antialias: true, preserveDrawingBuffer: true});
  if (!gl) return null;
  const nodes = reference.length / 3;
  const vertex = `#version 300 es
    in vec3 position; in float value;
    uniform mat4 camera; uniform vec2 span; out vec3 place; out float shade;
    void main() {
      place = position; shade = clamp((value - span.x) / max(span.y - span.x, 1e-20), 0.0, 1.0);
      gl_Position = camera * vec4(position, 1.0); gl_PointSize = 9.0;
    }`;
  const fragment = `#version 300 es
    precision highp float; in vec3 place; in float shade; out vec4 colour;
    uniform sampler2D table; uniform vec3 eye; uniform float flat_colour;
    void main() {
      if (flat_colour > 0.5) { colour = vec4(0.85, 0.15, 0.15, 1.0); return; }
      vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
      float light = 0.35 + 0.65 * abs(dot(normal, normalize(eye - place)));
      colour = vec4(texture(table, vec2(shade, 0.5)).rgb * light, 1.0);
    }`;
  const program = link(gl, vertex, fragment);
  const [uniforms, attributes] = [new Map(), new Map()];  // asking the driver for a place waits for it
  const at = (name) => remembered(uniforms, name, () => gl.getUniformLocation(program, name));
  const places = gl.createBuffer(), values = gl.createBuffer(), triangles = gl.createBuffer();
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  const table = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, table);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, colourTable());
  for (const [k, v] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(gl.TEXTURE_2D, k, v);
  const box = bounds(reference);
  const view = {centre: box.centre.slice(), zoom: 1, distance: 1, yaw: -0.9, pitch: 0.5};
  const points = new Float32Array(3 * nodes);

  // One thing to draw: displacement (3 n), value (n) and span of the colours; `picked` nodes are marked.
  // The whole structure fits, with room for its motion, whatever the shape of the canvas.
  function fit(width, height) { view.distance = view.zoom * 3.1 * box.radius / Math.min(1, width / height); }

  function drawOne(thing, x, width, height) {
    fit(width, height);
    gl.viewport(x, 0, width, height);
    for (let i = 0; i < points.length; i++) points[i] = reference[i] + thing.displacement[i];
    const matrix = cameraMatrix(view, width / height, box.radius);
    gl.useProgram(program);
    gl.uniformMatrix4fv(at('camera'), false, matrix.all);
    gl.uniform3fv(at('eye'), matrix.eye);
    gl.uniform2f(at('span'), thing.span[0], thing.span[1]);
    gl.uniform1f(at('flat_colour'), 0);
    attribute(places, points, 'position', 3);
    attribute(values, thing.value, 'value', 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    if (thing.picked.length) {
      const marked = new Float32Array(3 * thing.picked.length);
      thing.picked.forEach((n, k) => marked.set(points.subarray(3 * n, 3 * n + 3), 3 * k));
      gl.uniform1f(at('flat_colour'), 1);
      gl.disable(gl.DEPTH_TEST);
      attribute(places, marked, 'position', 3);
      attribute(values, new Float32Array(thing.picked.length), 'value', 1);
      gl.drawArrays(gl.POINTS, 0, thing.picked.length);
      gl.enable(gl.DEPTH_TEST);
    }
  }

  function attribute(buffer, data, name, size) {
    const location = remembered(attributes, name, () => gl.getAttribLocation(program, name));
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, size, gl.FLOAT, false, 0, 0);
  }

  function draw(things) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0.97, 0.975, 0.985, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const each = Math.floor(width / things.length);
    things.forEach((thing, k) => drawOne(thing, k * each, each, height));
  }

  // The node that is drawn nearest to a place on the canvas (CSS pixels), the nearer to the eye of two alike.
  function pick(thing, x, y, count, which) {
    const width = canvas.clientWidth / count, height = canvas.clientHeight;
    fit(width, height);
    const m = cameraMatrix(view, width / height, box.radius).all;
    let best = -1, least = 400;
    for (let n = 0; n < nodes; n++) {
      const p = [0, 1, 2].map((c) => reference[3 * n + c] + thing.displacement[3 * n + c]);
      const w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
      const sx = ((m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w + 1) / 2 * width + which * width;
      const sy = (1 - (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w) / 2 * height;
      const away = (sx - x) ** 2 + (sy - y) ** 2 + 1e-3 * w;
      if (away < least) { least = away; best = n; }
    }
    return best;
  }

  const fingers = new Map();
  let moved = 0;
  function handle(onChange, onPick) {
    canvas.style.touchAction = 'none';
    canvas.addEventListener('pointerdown', (e) => {
      canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.offsetX, e.offsetY]); moved = 0;
    });
    canvas.addEventListener('pointermove', (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const dx = e.offsetX - before[0], dy = e.offsetY - before[1];
      moved += Math.abs(dx) + Math.abs(dy);
      if (fingers.size === 1 && !e.shiftKey && e.buttons !== 2) {
        view.yaw -= dx * 0.008; view.pitch = Math.max(-1.55, Math.min(1.55, view.pitch + dy * 0.008));
      } else if (fingers.size === 1) pan(dx, dy);
      else {
        const other = [...fingers.entries()].find(([id]) => id !== e.pointerId)[1];
        const was = Math.hypot(before[0] - other[0], before[1] - other[1]), is = Math.hypot(e.offsetX - other[0], e.offsetY - other[1]);
        if (was > 1 && is > 1) view.zoom *= was / is;
        pan(dx / 2, dy / 2);
      }
      fingers.set(e.pointerId, [e.offsetX, e.offsetY]);
      onChange();
    });
    const up = (e) => { if (fingers.delete(e.pointerId) && moved < 6 && e.type === 'pointerup') onPick(e.offsetX, e.offsetY); };
    canvas.addEventListener('pointerup', up);
    canvas.addEventListener('pointercancel', up);
    canvas.addEventListener('contextmenu', (e) => e.preventDefault());
    canvas.addEventListener('wheel', (e) => { e.preventDefault(); view.zoom *= Math.exp(e.deltaY * 0.001); onChange(); }, {passive: false});
  }
  function pan(dx, dy) {
    const scale = view.distance / canvas.clientHeight, c = Math.cos(view.yaw), s = Math.sin(view.yaw);
    const right = [-s, c, 0], up = [-c * Math.sin(view.pitch), -s * Math.sin(view.pitch), Math.cos(view.pitch)];
    for (let k = 0; k < 3; k++) view.centre[k] += scale * (-dx * right[k] + dy * up[k]);
  }
  function reset() { Object.assign(view, {centre: box.centre.slice(), zoom: 1, distance: 1, yaw: -0.9, pitch: 0.5}); }
  return {draw, pick, handle, reset};
}

function remembered(known, name, find) {
  if (!known.has(name)) known.set(name, find());
  return known.get(name);
}

function link(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text.trim()); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  return program;
}

function bounds(points) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; i++) { low[i % 3] = Math.min(low[i % 3], points[i]); high[i % 3] = Math.max(high[i % 3], points[i]); }
  return {centre: low.map((v, k) => (v + high[k]) / 2), radius: Math.hypot(...low.map((v, k) => high[k] - v)) / 2 || 1};
}

// Looks at the centre from yaw and pitch, z upwards; column by column as WebGL wants it.
function cameraMatrix(view, aspect, radius) {
  const c = Math.cos(view.pitch), back = [c * Math.cos(view.yaw), c * Math.sin(view.yaw), Math.sin(view.pitch)];
  const right = [-Math.sin(view.yaw), Math.cos(view.yaw), 0];
  const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]];
  const eye = view.centre.map((v, k) => v + view.distance * back[k]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const near = Math.max(view.distance - 6 * radius, view.distance * 0.01), far = view.distance + 6 * radius;
  const fy = 1 / Math.tan(0.35), fx = fy / aspect, a = (far + near) / (near - far), b = 2 * far * near / (near - far);
  const rows = [[...right, -dot(right, eye)], [...up, -dot(up, eye)], [...back, -dot(back, eye)]];
  const all = new Float32Array(16);
  for (let k = 0; k < 4; k++) {
    all[4 * k] = fx * rows[0][k]; all[4 * k + 1] = fy * rows[1][k]; all[4 * k + 2] = a * rows[2][k]; all[4 * k + 3] = -rows[2][k];
  }
  all[14] += b;
  return {all, eye: new Float32Array(eye)};
}

// Dark blue over green to yellow, even in brightness: eight fixed colours and straight lines between them.
function colourTable() {
  const stops = [[68, 1, 84], [70, 50, 126], [54, 92, 141], [39, 127, 142], [31, 161, 135], [74, 193, 109], [160, 218, 57], [253, 231, 37]];
  const out = new Uint8Array(1024);
  for (let k = 0; k < 256; k++) {
    const t = k / 255 * 7, i = Math.min(6, Math.floor(t)), s = t - i;
    for (let c = 0; c < 3; c++) out[4 * k + c] = Math.round(stops[i][c] * (1 - s) + stops[i + 1][c] * s);
    out[4 * k + 3] = 255;
  }
  return out;
}
