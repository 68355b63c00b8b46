"use strict";
// The exact laws of qsim/sensor in the browser: P(code <= k) of light, draws of codes, and what follows from them.
// No function here touches the page; tests/qsim/report/test_sensor_law.py compares all of them with qsim.sensor.
//
// A sensor is {model, bits, efficiency, dark, exposure, noise, gain, dead}:
//   model "QIS" (one read: noise [e- rms], gain [codes/e-]), "BinarySPAD" (sum of 2^bits - 1 planes) or
//   "CountingSPAD" (non-paralyzable, dead [s]); efficiency [events/photon], dark [events/s], exposure [s] of a code.
// Light is constant within an exposure. Means are events per exposure: efficiency photons + dark exposure.

const LIGHT_BINS = 1024;  // of the light of a picture, even in its square root, for the expected histogram
const SIGMAS = 9;         // tails beyond are below 1e-18

function meanEvents(sensor, photons) { return sensor.efficiency * photons + sensor.dark * sensor.exposure; }

// Numbers.

function logFactorial(n) {
  if (n < 2) return 0;
  if (n < 20) { let product = 1; for (let i = 2; i <= n; i++) product *= i; return Math.log(product); }
  const m = n * n;  // Stirling's series
  const series = (1 / 12 - (1 / 360 - (1 / 1260 - 1 / (1680 * m)) / m) / m) / n;
  return (n + 0.5) * Math.log(n) - n + 0.5 * Math.log(2 * Math.PI) + series;
}

function poisson(mean, n) { return mean > 0 ? Math.exp(n * Math.log(mean) - mean - logFactorial(n)) : Number(n === 0); }

// Phi(z): below 3 the series of positive terms, above it the continued fraction of the tail.
function normalCdf(z) {
  const x = Math.abs(z), density = Math.exp(-x * x / 2) / Math.sqrt(2 * Math.PI);
  let tail;
  if (x < 3) {
    let term = x, sum = x;
    for (let k = 3; term > 1e-17 * sum; k += 2) { term *= x * x / k; sum += term; }
    tail = 0.5 - density * sum;
  } else {
    let fraction = x;
    for (let k = 60; k > 0; k--) fraction = x + k / fraction;
    tail = density / fraction;
  }
  return z > 0 ? 1 - tail : tail;
}

function roundHalfEven(x) {
  const low = Math.floor(x);
  return x - low === 0.5 ? low + (low % 2 !== 0) : Math.round(x);
}

// Laws: each returns a function, mean events -> Float64Array of P(code <= k), k = 0 ... top.

function qisCode(sensor, electrons) {
  return Math.min(Math.max(roundHalfEven(sensor.gain * electrons), 0), 2 ** sensor.bits - 1);
}

function qisLaw(sensor) {
  const top = 2 ** sensor.bits - 1, steps = [];
  for (let k = 0; k < top; k++) {  // P(code <= k | n electrons) is 1 for n < first, 0 beyond the row
    const at = (k + 0.5) / sensor.gain, reach = SIGMAS * sensor.noise + 2;
    const first = Math.max(0, Math.floor(at - reach)), row = [];
    for (let n = first; n <= at + reach; n++) {
      row.push(sensor.noise > 0 ? normalCdf((at - n) / sensor.noise) : Number(qisCode(sensor, n) <= k));
    }
    steps.push({ first, row });
  }
  return mean => {
    const spread = SIGMAS * Math.sqrt(mean), low = Math.max(0, Math.floor(mean - spread - 20));
    const count = Math.ceil(mean + spread + 20) - low + 1, weight = new Float64Array(count), below = new Float64Array(count + 1);
    const mode = Math.floor(mean);
    weight[mode - low] = poisson(mean, mode);
    for (let n = mode + 1; n < low + count; n++) weight[n - low] = weight[n - low - 1] * mean / n;
    for (let n = mode; n > low; n--) weight[n - low - 1] = weight[n - low] * n / mean;
    for (let i = 0; i < count; i++) below[i + 1] = below[i] + weight[i];
    const cdf = new Float64Array(top + 1).fill(1);
    for (let k = 0; k < top; k++) {
      const { first, row } = steps[k];
      let sum = below[Math.min(Math.max(first - low, 0), count)];
      const end = Math.min(row.length, low + count - first);
      for (let j = Math.max(0, low - first); j < end; j++) sum += weight[first + j - low] * row[j];
      cdf[k] = Math.min(sum, 1);
    }
    return cdf;
  };
}

function binaryLaw(sensor) {
  const planes = 2 ** sensor.bits - 1, logs = [];
  for (let k = 0; k <= planes; k++) logs.push(logFactorial(planes) - logFactorial(k) - logFactorial(planes - k));
  return mean => {
    const each = mean / planes, logLit = Math.log(-Math.expm1(-each)), cdf = new Float64Array(planes + 1);
    let sum = 0;
    for (let k = 0; k < planes; k++) {
      sum += Math.exp(logs[k] + (k ? k * logLit : 0) - (planes - k) * each);
      cdf[k] = Math.min(sum, 1);
    }
    cdf[planes] = 1;
    return cdf;
  };
}

function countingLaw(sensor) {
  const top = 2 ** sensor.bits - 1, share = sensor.dead / sensor.exposure;
  return mean => {
    const cdf = new Float64Array(top + 1).fill(1);
    for (let k = 0; k < top; k++) {  // fewer than k + 1 arrivals in the time that k dead times leave
      const live = mean * Math.max(1 - k * share, 0);
      let term = Math.exp(-live), sum = term;
      for (let j = 1; j <= k; j++) { term *= live / j; sum += term; }
      cdf[k] = Math.min(sum, 1);
    }
    return cdf;
  };
}

function lawOf(sensor) { return { QIS: qisLaw, BinarySPAD: binaryLaw, CountingSPAD: countingLaw }[sensor.model](sensor); }

function probabilities(cdf) { return cdf.map((value, k) => Math.max(value - (k ? cdf[k - 1] : 0), 0)); }

// Draws.

// Uniform numbers in (0, 1) of 52 bits: xoshiro128** (Blackman and Vigna 2018), seeded through Murmur3's finalizer.
function uniformNumbers(seed) {
  const state = new Uint32Array(4);
  for (let i = 0; i < 4; i++) {
    let z = (seed = (seed + 0x9e3779b9) | 0);
    z = Math.imul(z ^ (z >>> 16), 0x85ebca6b);
    z = Math.imul(z ^ (z >>> 13), 0xc2b2ae35);
    state[i] = z ^ (z >>> 16);
  }
  const turned = (x, k) => (x << k) | (x >>> (32 - k));
  function word() {
    const result = Math.imul(turned(Math.imul(state[1], 5), 7), 9) >>> 0, shifted = state[1] << 9;
    state[2] ^= state[0]; state[3] ^= state[1]; state[1] ^= state[2]; state[0] ^= state[3];
    state[2] ^= shifted; state[3] = turned(state[3], 11);
    return result;
  }
  return () => ((word() >>> 6) * 2 ** 26 + (word() >>> 6) + 0.5) / 2 ** 52;
}

// A whole number from its probabilities, by subtracting them from u from the mode outwards: exact, about sigma steps.
function searchFromMode(u, mode, atMode, up, down) {
  let high = mode, low = mode, above = atMode, below = atMode;
  u -= atMode;
  for (let turn = 0; u > 0 && turn < 1e6; turn++) {
    above *= up(high++);
    if ((u -= above) <= 0) return high;
    if (low > 0) { below *= down(low--); if ((u -= below) <= 0) return low; }
    if (above < 1e-300 && (low === 0 || below < 1e-300)) break;
  }
  return mode;  // rounding left less than 1e-12 of the unit interval
}

function drawPoisson(mean, random) {
  if (!(mean > 0)) return 0;
  const mode = Math.floor(mean);
  return searchFromMode(random(), mode, poisson(mean, mode), n => mean / (n + 1), n => n / mean);
}

function drawNormal(random) { return Math.sqrt(-2 * Math.log(random())) * Math.cos(2 * Math.PI * random()); }

// Planes from one rare outcome to the next: the gaps are geometric. Lit planes are the rare ones, or dark planes.
function drawPlanes(planes, each, random) {
  const lit = -Math.expm1(-each), dark = Math.exp(-each), rate = -Math.log1p(-Math.min(lit, dark));
  let rare = 0;
  for (let i = Math.floor(-Math.log(random()) / rate); i < planes; i += 1 + Math.floor(-Math.log(random()) / rate)) rare++;
  return lit <= dark ? rare : planes - rare;
}

function drawCounts(mean, share, top, random) {  // one avalanche after the other; the exposure is the unit of time
  let code = 0;
  for (let time = -Math.log(random()) / mean; time < 1 && code < top; time += share - Math.log(random()) / mean) code++;
  return code;
}

// A function, mean events -> code, that follows the physics and does not use the law above.
function drawer(sensor, random) {
  const top = 2 ** sensor.bits - 1;
  if (sensor.model === "BinarySPAD") return mean => drawPlanes(top, mean / top, random);
  if (sensor.model === "CountingSPAD") return mean => drawCounts(mean, sensor.dead / sensor.exposure, top, random);
  const noise = sensor.noise > 0 ? () => sensor.noise * drawNormal(random) : () => 0;
  return mean => qisCode(sensor, drawPoisson(mean, random) + noise());
}

// Codes of a picture: photons [pixels] -> Uint8Array, the same for the same seed.
function drawCodes(sensor, photons, seed) {
  const draw = drawer(sensor, uniformNumbers(seed));
  return Uint8Array.from(photons, light => draw(meanEvents(sensor, light)));
}

// What follows from the law.

// Mean share of each code in a drawn picture, and its standard deviation: {share, sigma}, arrays [codes]. The light of
// the pixels is grouped in LIGHT_BINS steps of its square root.
function expectedShares(sensor, photons) {
  let brightest = 0;
  for (const light of photons) brightest = Math.max(brightest, light);
  const counts = new Float64Array(LIGHT_BINS), sums = new Float64Array(LIGHT_BINS);
  for (const light of photons) {
    const i = Math.min(LIGHT_BINS - 1, Math.floor(LIGHT_BINS * Math.sqrt(light / (brightest || 1))));
    counts[i] += 1; sums[i] += light;
  }
  const law = lawOf(sensor), share = new Float64Array(2 ** sensor.bits), sigma = new Float64Array(2 ** sensor.bits);
  counts.forEach((count, i) => {
    if (!count) return;
    probabilities(law(meanEvents(sensor, sums[i] / count))).forEach((p, k) => {
      share[k] += count * p / photons.length;
      sigma[k] += count * p * (1 - p);
    });
  });
  return { share, sigma: sigma.map(variance => Math.sqrt(variance) / photons.length) };
}

// Mean and standard deviation of the code, and the exposure-referred signal-to-noise ratio
// photons (d mean / d photons) / deviation, at each light [photons per code].
function responseAt(sensor, lights) {
  const law = lawOf(sensor);
  const meanCode = events => law(events).reduce((sum, value) => sum + 1 - value, 0);
  return lights.map(photons => {
    const events = meanEvents(sensor, photons), chances = probabilities(law(events));
    let mean = 0, square = 0;
    chances.forEach((p, k) => { mean += k * p; });
    chances.forEach((p, k) => { square += (k - mean) ** 2 * p; });
    const step = 1e-4 * Math.max(events, 1e-12);
    const slope = (meanCode(events + step) - meanCode(events - step)) / (2 * step) * sensor.efficiency;
    const deviation = Math.sqrt(square);
    return { photons, mean, deviation, snr: deviation > 1e-9 ? photons * slope / deviation : 0 };
  });
}

// The light [photons per code] whose mean code is each code, from the points of a response; the ends are clamped.
function lightOfCodes(response, top) {
  const light = new Float64Array(top + 1);
  for (let code = 0, i = 1; code <= top; code++) {
    const wanted = Math.min(code, top - 0.5);
    while (i < response.length - 1 && response[i].mean < wanted) i++;
    const a = response[i - 1], b = response[i];
    const share = b.mean > a.mean ? Math.min(Math.max((wanted - a.mean) / (b.mean - a.mean), 0), 1) : 0;
    light[code] = a.photons + share * (b.photons - a.photons);
  }
  return light;
}

// The sensor as the file of `qsim sense --sensor`.
function sensorFile(sensor) {
  const own = {
    QIS: { quantum_efficiency: sensor.efficiency, dark_current: sensor.dark, read_noise: sensor.noise, gain: sensor.gain },
    BinarySPAD: { pde: sensor.efficiency, dark_count_rate: sensor.dark },
    CountingSPAD: { pde: sensor.efficiency, dark_count_rate: sensor.dark, dead_time: sensor.dead },
  }[sensor.model];
  const number = value => Number.isInteger(value) ? value + ".0" : String(value);
  const lines = Object.entries(own).map(([key, value]) => key + " = " + number(value));
  return ['[sensor]', 'model = "' + sensor.model + '"', ...lines, "bits = " + sensor.bits, ""].join("\n");
}
