// Sliders, time, levels, holding one prediction beside another: everything between the model and the viewer.
'use strict';

(async function () {
  const get = (id) => document.getElementById(id);
  const bundle = JSON.parse(get('bundle').textContent);
  const arrays = await unpack(bundle.arrays);
  const mesh = bundle.mesh;
  const reference = arrays[mesh.reference], faces = arrays[mesh.faces];
  const models = bundle.models.map((spec) => makeModel(spec, arrays, mesh));
  let model = models[0], held = null, picked = [], playing = null, colour = 'displacement', now = null, waiting = false, drawnCurves = {};
  const state = {parameters: {}, time: 0};

  // For programs: displacements, m, xyz node by node; parameters in the dataset's units, time in s, level 0: the full mesh.
  function named(name) {
    const chosen = name === undefined ? models[0] : models.find((m) => m.spec.name === name);
    if (!chosen) throw new Error(`no model is called ${name}; there are ${bundle.models.map((m) => m.name).join(', ')}`);
    return chosen;
  }
  window.crashkit = {
    models: bundle.models.map((m) => m.name),
    predict: async (parameters, time, level = 0, name = undefined) => {
      return named(name).predict(parameters, time, level);
    },
    band: async (parameters, time, level = 0, name = undefined) => named(name).band(parameters, time, level),
    warnings: async (parameters, name = undefined) => named(name).warnings(parameters),
  };

  get('about').textContent = bundle.about;
  const span = bundle.models[0].parameters;
  for (const p of span) {
    state.parameters[p.name] = (p.low + p.high) / 2;
    const room = 0.1 * (p.high - p.low), box = document.createElement('div');
    box.className = 'slider';
    box.innerHTML = `<label><span></span><output></output></label><svg class="marks" viewBox="0 0 1000 9" preserveAspectRatio="none"></svg><input type="range" step="any"><div class="ends"><span></span><span></span></div>`;
    const [label, out] = [box.querySelector('label span'), box.querySelector('output')], input = box.querySelector('input'), ends = box.querySelectorAll('.ends span');
    label.textContent = p.label;
    Object.assign(input, {min: p.low - room, max: p.high + room, value: state.parameters[p.name]});
    input.setAttribute('aria-label', p.label);
    ends[0].textContent = `trained from ${show(p.low * p.factor)} ${p.unit}`; ends[1].textContent = `to ${show(p.high * p.factor)} ${p.unit}`;
    box.querySelector('svg').innerHTML = p.runs.map((v) => `<rect x="${(1000 * (v - p.low + room) / (p.high - p.low + 2 * room)).toFixed(1)}" y="0" width="3" height="9" fill="#627d98"/>`).join('');
    const tell = () => { out.textContent = `${show(state.parameters[p.name] * p.factor)} ${p.unit}`; };
    input.addEventListener('input', () => { state.parameters[p.name] = Number(input.value); tell(); later(); });
    tell();
    get('sliders').append(box);
  }
  options(get('model'), bundle.models.map((m, k) => [k, m.name]));
  get('modelrow').style.display = models.length > 1 ? '' : 'none';
  options(get('part'), [[-1, 'whole structure'], ...mesh.parts.map((p, k) => [k, p.name])]);
  get('axis').value = String(bundle.axis);
  const last = Math.max(...bundle.models.map((m) => m.time[m.time.length - 1])), first = bundle.models[0].time[0];
  state.time = last;

  const viewer = makeViewer(get('view'), faces, reference);
  if (!viewer) get('names').textContent = 'The picture needs a browser with WebGL 2; numbers and curves work without.';
  if (viewer) viewer.handle(() => redraw(), (x, y) => {
    const things = drawn(), which = held && x > get('view').clientWidth / 2 ? 1 : 0;
    const node = viewer.pick(things[which], x, y, things.length, which);
    if (node < 0) return;
    picked = picked.includes(node) ? picked.filter((n) => n !== node) : [...picked, node].slice(-4);
    update();
  });
  get('bar').getContext('2d').putImageData(new ImageData(new Uint8ClampedArray(colourTable()), 256, 1), 0, 0);
  get('model').addEventListener('change', () => { model = models[Number(get('model').value)]; levels(); update(); });
  get('level').addEventListener('change', () => update());
  get('colour').addEventListener('change', () => { colour = get('colour').value; update(); });
  for (const id of ['part', 'axis']) get(id).addEventListener('change', () => update());
  get('time').addEventListener('input', () => { state.time = first + (last - first) * Number(get('time').value) / 1000; later(); });
  get('reset').addEventListener('click', () => { if (viewer) viewer.reset(); redraw(); });
  get('hold').addEventListener('click', () => {
    held = held ? null : {parameters: {...state.parameters}, model, level: level()};
    get('hold').setAttribute('aria-pressed', String(!!held));
    get('hold').textContent = held ? 'Let it go' : 'Hold this one';
    update();
  });
  get('play').addEventListener('click', () => {
    if (playing) { cancelAnimationFrame(playing); playing = null; get('play').textContent = 'Play'; return; }
    get('play').textContent = 'Pause';
    let from = performance.now() - 4000 * (state.time >= last ? 0 : (state.time - first) / (last - first));
    const step = (now) => {
      const share = ((now - from) / 4000) % 1.15;
      get('time').value = String(1000 * Math.min(share, 1));
      state.time = first + (last - first) * Math.min(share, 1);
      update();
      playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  });
  window.addEventListener('resize', () => redraw());
  levels();
  update();
  document.documentElement.dataset.ready = 'yes';

  function levels() {
    const named = model.spec.levels;
    options(get('level'), named.map((l) => [l.number, `${l.name}, ${l.nodes} nodes`]));
    get('level').value = String(named[0].number);
  }
  function level() { return Number(get('level').value); }

  function update() {
    const u = model.full(state.parameters, state.time, level());
    const other = held && held.model.full(held.parameters, state.time, held.level);
    const band = model.band(state.parameters, state.time, level());
    now = {u, other, band};
    const said = model.warnings(state.parameters);
    get('warnings').textContent = said.length ? said.join('; ') + '.' : '';
    get('now').textContent = `${(1e3 * state.time).toFixed(1)} ms`;
    numbers();
    curves();
    redraw();
  }
  // Once a frame; where no frames are drawn (a page in the background), a moment later all the same.
  function later() {
    if (waiting) return;
    waiting = true;
    const go = () => { if (waiting) { waiting = false; update(); } };
    requestAnimationFrame(go);
    setTimeout(go, 60);
  }

  function drawn() {
    const lengths = (u) => { const out = new Float32Array(mesh.nodes); for (let n = 0; n < mesh.nodes; n++) out[n] = length(u, n); return out; };
    const {u, other, band} = now;
    let value = lengths(u), second = other && lengths(other), top = Math.max(bundle.largest, 1e-9);
    if (colour === 'band' && band) { value = band; second = other && held.model.band(held.parameters, state.time, held.level) || second; top = Math.max(...band, 1e-9); }
    if (colour === 'difference' && other) {
      value = new Float32Array(mesh.nodes);
      for (let n = 0; n < mesh.nodes; n++) value[n] = Math.hypot(u[3 * n] - other[3 * n], u[3 * n + 1] - other[3 * n + 1], u[3 * n + 2] - other[3 * n + 2]);
      second = new Float32Array(mesh.nodes); top = Math.max(...value, 1e-9);
    }
    get('low').textContent = '0'; get('high').textContent = `${show(1e3 * top)} mm`;
    const things = [{displacement: u, value, span: [0, top], picked}];
    if (other) things.push({displacement: other, value: second, span: [0, top], picked});
    return things;
  }
  function redraw() {
    if (!viewer || !now) return;
    const things = drawn();
    viewer.draw(things);
    get('names').innerHTML = things.length > 1 ? '<div></div><div>held</div>' : '';
    if (things.length > 1) get('names').firstChild.textContent = 'now';
  }

  // Largest displacement of a part (along an axis) in the state shown, with its band.
  function numbers() {
    const part = Number(get('part').value), axis = Number(get('axis').value);
    const nodes = part < 0 ? null : arrays[mesh.parts[part].nodes];
    const most = (u) => {
      let best = 0, at = 0;
      const look = (n) => { const v = axis === 3 ? length(u, n) : Math.abs(u[3 * n + axis]); if (v > best) { best = v; at = n; } };
      if (nodes) nodes.forEach(look); else for (let n = 0; n < mesh.nodes; n++) look(n);
      return [best, at];
    };
    const rows = [], [largest, at] = most(now.u), share = Math.round(100 * bundle.share);
    rows.push(['largest displacement', `${show(1e3 * largest)} mm${now.band ? ` ± ${show(1e3 * now.band[at])}` : ''}`]);
    if (now.other) rows.push(['the held one', `${show(1e3 * most(now.other)[0])} mm`]);
    if (now.band) rows.push([`band of ${share} %, mean over nodes`, `${show(1e3 * now.band.reduce((a, b) => a + b, 0) / mesh.nodes)} mm`]);
    get('numbers').replaceChildren(...rows.map(([a, b]) => { const r = document.createElement('tr'); for (const t of [a, b]) { const d = document.createElement('td'); d.textContent = t; r.append(d); } return r; }));
  }

  // Displacement over time of the picked nodes, with their band, and dashed those of the held one.
  function curves() {
    const canvas = get('curves'), ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight, pen = canvas.getContext('2d');
    canvas.width = w * ratio; canvas.height = h * ratio; pen.scale(ratio, ratio); pen.clearRect(0, 0, w, h);
    get('picked').textContent = picked.length ? `nodes ${picked.map((n) => mesh.node_id ? arrays[mesh.node_id][n] : n).join(', ')}` : 'Tap a node of the structure.';
    if (!picked.length) return;
    const times = Array.from({length: 25}, (_, k) => first + (last - first) * k / 24), hues = ['#1c6dd0', '#c2410c', '#15803d', '#7e22ce'];
    const course = (m, parameters, number) => times.map((t) => { const u = m.full(parameters, t, number); return picked.map((n) => length(u, n)); });
    const key = JSON.stringify([models.indexOf(model), state.parameters, level(), picked, held && [models.indexOf(held.model), held.parameters, held.level]]);
    if (drawnCurves.key !== key) {  // while the time alone moves, the curves stay
      drawnCurves = {
        key, mine: course(model, state.parameters, level()), theirs: held && course(held.model, held.parameters, held.level),
        bands: times.map((t) => model.band(state.parameters, t, level())),
      };
    }
    const {mine, theirs, bands} = drawnCurves;
    const top = Math.max(...mine.flat(), ...(theirs ? theirs.flat() : []), 1e-9) * 1.05, x = (t) => 40 + (w - 46) * (t - first) / (last - first || 1), y = (v) => h - 18 - (h - 26) * v / top;
    pen.font = '11px system-ui'; pen.fillStyle = '#616e7c'; pen.strokeStyle = '#d9e2ec';
    pen.fillText(`${show(1e3 * top)} mm`, 0, 12); pen.fillText('0', 28, h - 16); pen.fillText(`${show(1e3 * last)} ms`, w - 42, h - 4);
    pen.strokeRect(40, 8, w - 46, h - 26);
    picked.forEach((n, k) => {
      if (bands[0]) {
        pen.fillStyle = hues[k] + '26'; pen.beginPath();
        times.forEach((t, i) => pen.lineTo(x(t), y(Math.min(top, mine[i][k] + bands[i][n]))));
        for (let i = times.length - 1; i >= 0; i--) pen.lineTo(x(times[i]), y(Math.max(0, mine[i][k] - bands[i][n])));
        pen.fill();
      }
      for (const [values, dash] of [[mine, []], [theirs, [4, 3]]]) {
        if (!values) continue;
        pen.strokeStyle = hues[k]; pen.setLineDash(dash); pen.beginPath();
        times.forEach((t, i) => pen.lineTo(x(t), y(values[i][k]))); pen.stroke(); pen.setLineDash([]);
      }
    });
    pen.strokeStyle = '#1f2933'; pen.beginPath(); pen.moveTo(x(state.time), 8); pen.lineTo(x(state.time), h - 18); pen.stroke();
  }

  function length(u, n) { const x = u[3 * n], y = u[3 * n + 1], z = u[3 * n + 2]; return Math.sqrt(x * x + y * y + z * z); }
  function options(select, pairs) {
    select.replaceChildren(...pairs.map(([value, text]) => { const o = document.createElement('option'); o.value = String(value); o.textContent = text; return o; }));
  }
  function show(v) { return Number(v.toPrecision(3)).toString(); }
})().catch((error) => { document.body.prepend(`This page could not be started: ${error.message}`); throw error; });

// Arrays are kept as base64 of the byte planes of little-endian numbers, gzipped; rounded ones column by column, as whole
// multiples of a step, 0, 1, 2, 3, .. for 0, -1, 1, -2, ..
async function unpack(stored) {
  if (typeof DecompressionStream === 'undefined') throw new Error('this browser is too old to unpack it (it lacks DecompressionStream, which all have since May 2023); open it in a newer one');
  const kinds = {f4: Float32Array, f8: Float64Array, i4: Int32Array, u4: Uint32Array, u2: Uint16Array, i2: Int16Array};
  const out = {};
  for (const [name, a] of Object.entries(stored)) {
    const raw = Uint8Array.from(atob(a.data), (c) => c.charCodeAt(0));
    const bytes = new Uint8Array(await new Response(new Blob([raw]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer());
    if (a.steps) {
      const columns = a.columns, count = bytes.length / 4, rows = count / columns, values = new kinds[a.kind](count);
      for (let k = 0, i = 0; k < columns; k++) for (let row = 0; row < rows; row++, i++) {
        const u = bytes[i] + 256 * (bytes[count + i] + 256 * (bytes[2 * count + i] + 256 * bytes[3 * count + i]));
        values[row * columns + k] = a.steps[k % a.steps.length] * (u % 2 ? -(u + 1) / 2 : u / 2);
      }
      out[name] = values;
      continue;
    }
    const plain = new Uint8Array(bytes.length), size = kinds[a.kind].BYTES_PER_ELEMENT, count = bytes.length / size;
    for (let b = 0; b < size; b++) for (let i = 0; i < count; i++) plain[i * size + b] = bytes[b * count + i];
    out[name] = new kinds[a.kind](plain.buffer);
  }
  return out;
}
