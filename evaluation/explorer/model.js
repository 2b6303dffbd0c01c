// The model itself, in plain arithmetic: what Python predicts, to rounding. `bundle.models` says what to do, `arrays` holds
// the numbers. A model reads parameters by name (SI or the dataset's units) and a time, s; it gives displacements, m.
'use strict';

function makeModel(spec, arrays, mesh) {
  const registration = makeRegistration(spec.registration, spec.parameters);
  const core = spec.kind === 'process' ? makeProcess(spec, arrays) : makeCascade(spec, arrays);
  const remembered = new Map();

  function values(parameters) {
    return spec.parameters.map((p) => {
      const v = parameters[p.name];
      if (typeof v !== 'number' || !Number.isFinite(v)) throw new Error(`parameter ${p.name}: expected a number, found ${v}`);
      return v;
    });
  }

  // Displacements on the nodes of `level`; 0: the full mesh.
  function predict(parameters, time, level) {
    const p = values(parameters), inputs = registration.inputs(p), [at, size] = registration.clock(p, time);
    const own = level === 0 ? spec.levels[0].number : level;
    if (!spec.levels.some((l) => l.number === own)) throw new Error(`level ${level} is not in this model; it has ${spec.levels.map((l) => l.number).join(', ')}, and 0`);
    const key = inputs.join();
    if (remembered.size > 4) remembered.clear();
    if (!remembered.has(key)) remembered.set(key, core.prepare(inputs));
    const out = core.state(remembered.get(key), at, own);
    for (let i = 0; i < out.length; i++) out[i] *= size;
    return level === 0 && own !== 0 ? lift(out, own) : out;
  }

  // The same lifted to the full mesh from any level.
  function full(parameters, time, level) {
    const out = predict(parameters, time, level);
    return level === 0 ? out : lift(out, level);
  }

  function lift(states, level) {
    const told = spec.levels.find((l) => l.number === level).lift, columns = arrays[told.columns], weights = arrays[told.weights], width = weights.length / mesh.nodes;
    const out = new Float32Array(3 * mesh.nodes);
    for (let n = 0; n < mesh.nodes; n++) for (let k = 0; k < width; k++) {
      const w = weights[n * width + k], from = 3 * columns[n * width + k];
      if (w) for (let c = 0; c < 3; c++) out[3 * n + c] += w * states[from + c];
    }
    return out;
  }

  // Half-width of the band that should hold `spec.band.share` of nodes and states, m, on the full mesh; null without.
  function band(parameters, time, level) {
    const known = spec.bands[level === 0 ? spec.levels[0].number : level];
    if (!known) return null;
    const [at] = [time], node = arrays[known.node], state = arrays[known.state], times = arrays[known.time];
    const scale = interpolate(times, state, at) * spread(values(parameters), known) / known.unit;
    return Float32Array.from(node, (v) => v * scale);
  }

  // How wide the band of a query is: see surrogates/uncertainty.py.
  function spread(p, known) {
    if (known.spread === 'constant') return 1;
    const size = registration.clock(p, 0)[1];
    if (known.spread === 'size') return size;
    const expected = size * Math.sqrt(core.deviation ? core.deviation(registration.inputs(p), (t) => registration.clock(p, t)[0]) : 1);
    return known.spread === 'local' ? expected * localErrors(known.local, place(p)) : expected;
  }

  // Where a query lies in the trained range, in [-1, 1].
  function place(p) {
    const out = [];
    spec.parameters.forEach((q, k) => { if (q.high > q.low) out.push(2 * (p[k] - q.low) / (q.high - q.low) - 1); });
    return out;
  }

  // What is said of a query: parameters beyond the trained ranges, and runs near it that were predicted badly.
  function warnings(parameters) {
    const out = [];
    for (const p of spec.parameters) {
      const v = parameters[p.name], slack = 1e-9 * Math.max(Math.abs(p.low), Math.abs(p.high));
      if (v < p.low - slack || v > p.high + slack) out.push(`${p.label} is outside the trained range: do not rely on what is shown`);
    }
    const query = values(parameters);
    if (spec.hard) {
      const point = place(query), times = localErrors(spec.hard, point);
      const near = spec.hard.run.map((run, k) => [run, spec.hard.ratio[k], distance(point, spec.hard.points[k])])
        .filter(([, ratio, away]) => ratio > spec.hard.limit && away <= spec.hard.reach * spec.hard.width)
        .sort((a, b) => b[1] - a[1]).map(([run]) => run);
      const named = [...new Set(near)].slice(0, 3).map((run) => `${spec.hard.runs[run][0]} (${(100 * spec.hard.runs[run][1]).toPrecision(2)} cm)`);
      if (times >= spec.hard.limit && named.length) out.push(`near a fold: the model was wrong about ${named.join(', ')} when left out; expect ${times.toFixed(1)} times the typical error here`);
    }
    return out;
  }

  return {spec, predict, full, band, warnings};
}

function distance(a, b) { return Math.hypot(...a.map((v, k) => v - b[k])); }

// How many times the typical error to expect at a point; see surrogates/local_errors.py.
function localErrors(told, point) {
  let sum = told.prior, weights = 1;
  told.points.forEach((other, k) => {
    const w = Math.exp(-0.5 * (distance(point, other) / told.width) ** 2);
    sum += w * told.ratio[k]; weights += w;
  });
  return sum / weights;
}

// Derived inputs, clock and size; see surrogates/physics.
function makeRegistration(told, parameters) {
  const product = (p, powers) => powers.reduce((out, power, k) => power ? out * Math.pow(p[k], power) : out, 1);
  function inputs(p) {
    const out = told.columns.map((c) => {
      if (c.logarithm) return c.powers.reduce((sum, power, k) => power ? sum + power * Math.log(p[k]) : sum, 0);
      const v = p[c.powers.indexOf(1)];
      return c.width ? Math.asinh(v / c.width) : v;
    });
    return told.flagged ? [...out, 0] : out;
  }
  function clock(p, time) {
    if (told.speed === null) return [time, 1];
    const rate = product(p.map((v, k) => v / told.reference[k]), told.exponents);
    return [told.start + (time - told.start) * rate, p[told.speed] / told.reference[told.speed] / rate];
  }
  return {inputs, clock};
}

// A Gaussian process over whole courses of POD coefficients: coefficients = mean + k(x) pull, states = modes coefficients. Over
// coarse runs it is a sum of such processes; the first one is that of the fine runs, which says the deviation.
function makeProcess(spec, arrays) {
  const {x, mix, mean, pull, modes, grid, low, high, inverse} = Object.fromEntries(
    ['x', 'mix', 'mean', 'pull', 'modes', 'grid', 'low', 'high', 'inverse'].map((name) => [name, arrays[spec.arrays[name]]]));
  const {variance, slope, noise} = spec.kernel, r = spec.modes, samples = spec.samples, kept = spec.kept;
  const terms = [{x, mix, mean, pull, kernel: spec.kernel, samples}, ...spec.added.map((term) => ({...term, ...Object.fromEntries(
    Object.entries(term.arrays).map(([name, key]) => [name, arrays[key]]))}))];
  function scaled(inputs) {
    const q = [];
    inputs.forEach((v, k) => { if (kept[k]) q.push(2 * (v - low[k]) / (high[k] - low[k]) - 1); });
    return q;
  }
  function covariances(q, {x, mix, kernel: {variance, slope}, samples} = terms[0]) {
    const d = q.length, out = new Float64Array(samples);
    for (let i = 0; i < samples; i++) {
      let away = 0, dot = 0;
      for (let a = 0; a < d; a++) {
        let s = 0;
        for (let b = 0; b <= a; b++) s += mix[a * d + b] * (q[b] - x[i * d + b]);
        away += s * s; dot += q[a] * x[i * d + a];
      }
      const m = Math.sqrt(3 * away);
      out[i] = variance * (1 + m) * Math.exp(-m) + slope * dot;
    }
    return out;
  }
  function prepare(inputs) {
    const course = new Float64Array(mean.length), q = scaled(inputs);
    for (const term of terms) {
      for (let j = 0; j < course.length; j++) course[j] += term.mean[j];
      covariances(q, term).forEach((k, i) => {
        const from = i * course.length;
        for (let j = 0; j < course.length; j++) course[j] += k * term.pull[from + j];
      });
    }
    return course;
  }
  function deviation(inputs) {  // what the process believes its standard deviation to be, in units of the outputs' spread
    const q = scaled(inputs), k = covariances(q);
    let own = variance, gain = 0, sum = 0, ones = 0;
    for (const v of q) own += slope * v * v;
    for (let i = 0; i < samples; i++) {
      let row = 0, all = 0;
      for (let j = 0; j < samples; j++) { row += inverse[i * samples + j] * k[j]; all += inverse[i * samples + j]; }
      gain += k[i] * row; sum += row; ones += all;
    }
    return Math.sqrt(Math.max(own - gain + (1 - sum) ** 2 / ones, 0) + noise);
  }
  function state(course, time) {
    const c = new Float64Array(r), n = modes.length / r, out = new Float32Array(n);
    for (let k = 0; k < r; k++) c[k] = monotone(grid, (s) => course[s * r + k], time);
    for (let i = 0; i < n; i++) { let s = 0; for (let k = 0; k < r; k++) s += modes[i * r + k] * c[k]; out[i] = s; }
    return out;
  }
  return {prepare, state, deviation};
}

// The monotone cubic of Fritsch and Butland through value(0), value(1), .. at `grid`; the ends are held outside.
function monotone(grid, value, time) {
  const last = grid.length - 1;
  if (last === 0) return value(0);
  const t = Math.min(Math.max(time, grid[0]), grid[last]);
  let k = 0, top = last;
  while (top - k > 1) { const middle = (k + top) >> 1; if (grid[middle] <= t) k = middle; else top = middle; }
  const step = (i) => grid[i + 1] - grid[i], rise = (i) => (value(i + 1) - value(i)) / step(i);
  function slope(i) {
    if (last === 1) return rise(0);
    if (i === 0 || i === last) {
      const a = i === 0 ? 0 : last - 1, b = i === 0 ? 1 : last - 2, ha = step(a), hb = step(b), ma = rise(a), mb = rise(b);
      const d = ((2 * ha + hb) * ma - ha * mb) / (ha + hb);
      if (Math.sign(d) !== Math.sign(ma)) return 0;
      return Math.sign(ma) !== Math.sign(mb) && Math.abs(d) > 3 * Math.abs(ma) ? 3 * ma : d;
    }
    const ma = rise(i - 1), mb = rise(i), ha = step(i - 1), hb = step(i);
    if (ma * mb <= 0) return 0;
    const w1 = 2 * hb + ha, w2 = hb + 2 * ha;
    return (w1 + w2) / (w1 / ma + w2 / mb);
  }
  const h = step(k), s = (t - grid[k]) / h, d0 = slope(k), d1 = slope(k + 1);
  return value(k) * (1 + 2 * s) * (1 - s) ** 2 + value(k + 1) * s * s * (3 - 2 * s) + h * (d0 * s * (1 - s) ** 2 - d1 * s * s * (1 - s));
}

function interpolate(grid, values, time) {
  let k = 0;
  while (k < grid.length - 2 && grid[k + 1] < time) k++;
  const s = Math.min(Math.max((time - grid[k]) / (grid[k + 1] - grid[k] || 1), 0), 1);
  return values[k] * (1 - s) + values[Math.min(k + 1, values.length - 1)] * s;
}

// Networks as a list of steps on named vectors; each level is one list that ends in `out`, m.
function makeCascade(spec, arrays) {
  const steps = {
    linear(s, at) { return affine(arrays[s.weight], s.bias && arrays[s.bias], at[s.of]); },
    activation(s, at) { return at[s.of].map(ACTIVATIONS[s.kind]); },
    concat(s, at) { return Float32Array.from(s.of.flatMap((name) => Array.from(at[name]))); },
    sum(s, at) {  // shorter vectors are padded with zeros
      const out = new Float32Array(Math.max(...s.of.map((name) => at[name].length)));
      for (const name of s.of) at[name].forEach((v, i) => { out[i] += v; });
      return out;
    },
    mix(s, at) { return at[s.of[0]].map((v, i) => v + s.share * (at[s.of[1]][i] - v)); },
    minus(s, at) { const v = arrays[s.array]; return at[s.of].map((x, i) => x - v[i]); },
    course(s, at) {  // mean(t) + growth(t) * network
      const [k, share] = between(arrays[s.time], at.inputs[s.column]), mean = arrays[s.mean], growth = arrays[s.growth], r = at[s.of].length;
      const blend = (values, a, b) => values[a] * (1 - share) + values[b] * share, next = Math.min(k + 1, growth.length - 1);
      return at[s.of].map((v, i) => blend(mean, k * r + i, next * r + i) + blend(growth, k, next) * v);
    },
    times(s, at) { return at[s.of].map((v) => v * s.factor); },
    first(s, at) { return at[s.of].slice(0, s.count); },
    transpose(s, at) {  // (rows, columns) row by row -> (columns, rows)
      const x = at[s.of], out = new Float32Array(x.length), columns = x.length / s.rows;
      for (let i = 0; i < s.rows; i++) for (let j = 0; j < columns; j++) out[j * s.rows + i] = x[i * columns + j];
      return out;
    },
    chebyshev(s, at) { return chebyshev(s, arrays, at[s.of]); },
    gather(s, at) {  // upsampling: node by node a few weighted coarse nodes
      const x = at[s.of], columns = arrays[s.columns], weights = arrays[s.weights], bias = s.bias && arrays[s.bias];
      const width = weights.length / s.nodes, out = new Float32Array(3 * s.nodes);
      for (let n = 0; n < s.nodes; n++) {
        for (let k = 0; k < width; k++) {
          const w = weights[n * width + k], from = 3 * columns[n * width + k];
          for (let c = 0; c < 3; c++) out[3 * n + c] += w * x[from + c];
        }
        if (bias) for (let c = 0; c < 3; c++) out[3 * n + c] += bias[n];
      }
      return out;
    },
    kernel(s, at) { return kernelStep(s, arrays, at[s.of]); },
  };
  function done(inputs, time, level) {
    const at = {inputs: scaledInputs(spec.scaling, inputs, time)};
    for (const s of level.steps) at[s.out] = steps[s.step](s, at);
    return at;
  }
  function state(inputs, time, level) { return done(inputs, time, spec.levels.find((l) => l.number === level)).out; }
  // How far the trainings behind a mean lie apart, m, for a run of size 1; see surrogates/models/average.py.
  function apart(inputs, clock) {
    const {level: number, floor, time} = spec.apart, level = spec.levels.find((l) => l.number === number);
    let sum = 0;
    for (const t of time) {
      const at = done(inputs, clock(t), level);
      for (const name of level.outs) at[name].forEach((v, i) => { sum += (v - at.out[i]) ** 2; });
    }
    return Math.hypot(Math.sqrt(sum / (time.length * level.outs.length * level.nodes)), floor);
  }
  return {prepare: (inputs) => inputs, state, deviation: spec.apart && apart};
}

const ACTIVATIONS = {
  elu: (v) => v > 0 ? v : Math.expm1(v),
  tanh: Math.tanh,
  gelu: (v) => v / 2 * (1 + erf(v / Math.SQRT2)),
  silu: (v) => v / (1 + Math.exp(-v)),
};

// The interval of `time` in an increasing grid, and the share of it that has passed; the ends are held.
function between(grid, time) {
  let k = 0;
  while (k < grid.length - 2 && grid[k + 1] <= time) k++;
  if (grid.length < 2) return [0, 0];
  return [k, Math.min(Math.max((time - grid[k]) / (grid[k + 1] - grid[k]), 0), 1)];
}

// A Gaussian process over courses of latent vectors, cubic between states; see surrogates/regression/latent_process.py.
function kernelStep(s, arrays, inputs) {
  const runs = arrays[s.runs], mix = arrays[s.mix], grid = arrays[s.time], mean = arrays[s.mean], pull = arrays[s.pull];
  const p = s.parameters, r = mean.length / grid.length, last = grid.length - 1, weights = [];
  for (let i = 0; i < s.samples; i++) {
    let away = 1e-12, dot = 0;
    for (let a = 0; a < p; a++) {
      let sum = 0;
      for (let b = 0; b < p; b++) sum += mix[a * p + b] * (inputs[b] - runs[i * p + b]);
      away += sum * sum; dot += inputs[a] * runs[i * p + a];
    }
    const d = Math.sqrt(3 * away);
    weights.push(s.numbers[0] * (1 + d) * Math.exp(-d) + s.numbers[1] * dot);
  }
  const at = (k, j) => {
    let sum = mean[k * r + j];
    for (let i = 0; i < s.samples; i++) sum += weights[i] * pull[(i * grid.length + k) * r + j];
    return sum;
  };
  const out = new Float32Array(r);
  if (last === 0) { for (let j = 0; j < r; j++) out[j] = at(0, j); return out; }
  const time = Math.min(Math.max(inputs[p], grid[0]), grid[last]);
  let k = 0;
  while (k < last - 1 && grid[k + 1] <= time) k++;
  const clip = (i) => Math.min(Math.max(i, 0), last), step = grid[k + 1] - grid[k], u = (time - grid[k]) / step;
  const left = step * u * (1 - u) ** 2 / (grid[k + 1] - grid[clip(k - 1)]), right = step * u * u * (u - 1) / (grid[clip(k + 2)] - grid[k]);
  const rise = u * u * (3 - 2 * u), parts = [[clip(k - 1), -left], [k, 1 - rise - right], [k + 1, rise + left], [clip(k + 2), right]];
  for (let j = 0; j < r; j++) for (const [i, part] of parts) out[j] += part * at(i, j);
  return out;
}

function affine(weight, bias, x) {
  const rows = weight.length / x.length, out = new Float32Array(rows);
  for (let i = 0; i < rows; i++) {
    let sum = bias ? bias[i] : 0;
    for (let j = 0, from = i * x.length; j < x.length; j++) sum += weight[from + j] * x[j];
    out[i] = sum;
  }
  return out;
}

// Chebyshev convolution on (node, channel): sum over k of T_k(L) x W_k + b; L by rows with the same number of entries.
function chebyshev(s, arrays, x) {
  const columns = arrays[s.columns], entries = arrays[s.entries], width = columns.length / s.nodes, weight = arrays[s.weight], bias = arrays[s.bias];
  const {nodes, inputs, outputs, order} = s;
  const move = (v) => {
    const out = new Float32Array(v.length);
    for (let n = 0; n < nodes; n++) for (let k = 0; k < width; k++) {
      const e = entries[n * width + k];
      if (e) for (let c = 0, from = columns[n * width + k] * inputs; c < inputs; c++) out[n * inputs + c] += e * v[from + c];
    }
    return out;
  };
  const terms = [x];
  if (order > 1) terms.push(move(x));
  while (terms.length < order) {
    const next = move(terms[terms.length - 1]), before = terms[terms.length - 2];
    terms.push(next.map((v, i) => 2 * v - before[i]));
  }
  const out = new Float32Array(nodes * outputs);
  for (let n = 0; n < nodes; n++) for (let o = 0; o < outputs; o++) {
    let sum = bias ? bias[o] : 0;
    for (let k = 0; k < order; k++) for (let c = 0; c < inputs; c++) sum += terms[k][n * inputs + c] * weight[(k * inputs + c) * outputs + o];
    out[n * outputs + o] = sum;
  }
  return out;
}

// Parameters and time, their products, sines and cosines of angles, each to [-1, 1]; see surrogates/data/inputs.py.
// The error function to 1.5e-7 (Abramowitz and Stegun 1964, 7.1.26).
function erf(x) {
  const t = 1 / (1 + 0.3275911 * Math.abs(x));
  const y = 1 - ((((1.061405429 * t - 1.453152027) * t + 1.421413741) * t - 0.284496736) * t + 0.254829592) * t * Math.exp(-x * x);
  return x < 0 ? -y : y;
}

function scaledInputs(scaling, inputs, time) {
  const raw = [...inputs, time];
  if (scaling.products) for (const v of inputs) raw.push(v * time);
  for (const f of [Math.sin, Math.cos]) for (const k of scaling.angles) raw.push(f(inputs[k] * Math.PI / 180));
  return Float32Array.from(raw, (v, k) => scaling.high[k] > scaling.low[k] ? 2 * (v - scaling.low[k]) / (scaling.high[k] - scaling.low[k]) - 1 : 0);
}

if (typeof module !== 'undefined') module.exports = {makeModel, monotone};
