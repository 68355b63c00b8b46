// The page of qsim explore: sliders, pictures and charts. The laws are in sensor_law.js.

const data = JSON.parse(document.getElementById("data").textContent);
const at = id => document.getElementById(id);
const NAMES = ["light", "frames", "bits", "efficiency", "noise", "gain", "dark", "dead", "start"];
const GRID = 160;  // light levels of the curve
const pixels = data.height * data.width;
const stored = light16(data.light);
const state = { device: data.devices[0].name, model: "QIS", light: 3.25, frames: 1, start: 1, seed: 0 };
let timer = null, waiting = false;

function light16(text) {  // little-endian 16 bits in base64 -> light relative to the mean of the clip
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0)), light = new Float64Array(bytes.length / 2);
  for (let i = 0; i < light.length; i++) light[i] = data.brightest * ((bytes[2 * i] + 256 * bytes[2 * i + 1]) / data.steps) ** 2;
  return light;
}

// Light [photons per pixel] of `count` frames from frame `first` (0, 1, ...), added.
function photonsOf(first, count) {
  const sum = new Float64Array(pixels);
  for (let t = first; t < first + count; t++) for (let i = 0; i < pixels; i++) sum[i] += state.light * stored[t * pixels + i];
  return sum;
}

function sensor() {
  const { model, bits, efficiency, dark, noise, gain, dead } = state;
  return { model, bits, efficiency, dark, noise, gain, dead, exposure: data.exposure * state.frames };
}

// Numbers as text.

function short(value, digits = 3) { return value === 0 ? "0" : String(Number(value.toPrecision(digits))); }

function seconds(value) {
  const [factor, unit] = value < 1e-6 ? [1e9, "ns"] : value < 1e-3 ? [1e6, "µs"] : [1e3, "ms"];
  return value ? short(value * factor) + " " + unit : "0 s";
}

function shown(name, value) {
  if (name === "dead") return seconds(value);
  const unit = at(name).dataset.unit;
  return short(value) + (unit ? " " + unit : "");
}

// Sliders: positions are 0, 1, 2, ...; values even, or even in the logarithm, with 0 at the left end where it is allowed.

function scaleOf(input) {
  const { from, to, by = 1, low, high, zero } = input.dataset, PER_DECADE = 20;
  if (low === undefined) {
    return { count: Math.round((to - from) / by), value: i => Number((Number(from) + i * by).toFixed(4)), place: v => (v - from) / by };
  }
  const first = zero ? 1 : 0, steps = Math.round(PER_DECADE * Math.log10(high / low));
  return {
    count: steps + first,
    value: i => i < first ? 0 : Number((low * (high / low) ** ((i - first) / steps)).toPrecision(2)),
    place: v => v > 0 ? first + steps * Math.log(v / low) / Math.log(high / low) : 0,
  };
}

function setLimits() {
  state.start = Math.min(state.start, data.frames - state.frames + 1);
  at("start").max = data.frames - state.frames;
}

function showControls() {
  for (const name of NAMES) {
    const input = at(name), scale = scaleOf(input);
    input.max = scale.count;
    if (name === "start") setLimits();
    input.value = Math.round(scale.place(state[name]));
    at(name + "-shown").value = shown(name, state[name]);
    input.setAttribute("aria-valuetext", shown(name, state[name]));
    input.closest(".slider").hidden = !input.closest(".slider").dataset.models.includes(state.model);
  }
  at("model").value = state.model;
  at("device").value = state.device;
}

function takeDevice(name) {
  const device = data.devices.find(one => one.name === name);
  if (device) Object.assign(state, { device: name }, device.settings, device.follows);
}

// Some gains follow the light: at other light, or with more frames per code, the settings are those of no named sensor.
function keepName() {
  const device = data.devices.find(one => one.name === state.device);
  if (device && Object.entries(device.follows || {}).some(([name, value]) => state[name] !== value)) state.device = "";
}

// Settings in the address.

function readAddress() {
  takeDevice(state.device);
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (wanted.has("device")) takeDevice(wanted.get("device"));
  if (["QIS", "BinarySPAD", "CountingSPAD"].includes(wanted.get("model"))) state.model = wanted.get("model");
  for (const name of [...NAMES, "seed"]) {
    const value = Number(wanted.get(name));
    if (!wanted.has(name) || !Number.isFinite(value)) continue;
    const scale = name === "seed" ? null : scaleOf(at(name));
    state[name] = scale ? Math.min(Math.max(value, scale.value(0)), scale.value(scale.count)) : value;
    if (["frames", "bits", "start", "seed"].includes(name)) state[name] = Math.round(state[name]);
  }
  if (wanted.has("model") || NAMES.slice(2, 8).some(name => wanted.has(name))) state.device = "";
  keepName();
}

function writeAddress() {
  const words = new URLSearchParams(state.device ? { device: state.device } : { model: state.model });
  for (const name of [...NAMES, "seed"]) if (!(state.device && NAMES.slice(2, 8).includes(name))) words.set(name, state[name]);
  history.replaceState(null, "", "#" + words);
}

// Pictures: grey = 255 (value / brightest)^(1/2.2), as in qsim.colour.tone.

// As numpy.percentile: linear between the two nearest values.
function percentile(values, share) {
  const sorted = Float64Array.from(values).sort(), place = share * (sorted.length - 1), low = Math.floor(place);
  return sorted[low] + (place - low) * (sorted[Math.min(low + 1, sorted.length - 1)] - sorted[low]);
}

function paint(id, values, brightest) {
  const canvas = at(id), image = new ImageData(data.width, data.height);
  canvas.width = data.width; canvas.height = data.height;
  for (let i = 0; i < pixels; i++) {
    const grey = 255 * Math.min(values[i] / brightest, 1) ** (1 / 2.2);
    image.data.set([grey, grey, grey, 255], 4 * i);
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
}

// Charts: elements of SVG in a frame of 480 x 250, with the axes at 50 and 210.

function element(name, attributes, words = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  made.textContent = words;
  return made;
}

function frame(x, y, xTicks, yTicks, xLabel, yLabel) {
  const parts = [];
  for (const [value, text] of yTicks) {
    parts.push(element("line", { class: "grid", x1: 50, x2: 475, y1: y(value), y2: y(value) }));
    parts.push(element("text", { x: 45, y: y(value) + 4, "text-anchor": "end" }, text));
  }
  for (const [value, text] of xTicks) parts.push(element("text", { x: x(value), y: 226, "text-anchor": x(value) > 465 ? "end" : "middle" }, text));
  parts.push(element("line", { class: "axis", x1: 50, x2: 475, y1: 210, y2: 210 }));
  parts.push(element("text", { x: 475, y: 245, "text-anchor": "end" }, xLabel));
  parts.push(element("text", { x: 4, y: 12 }, yLabel));
  return parts;
}

function drawHistogram(drawn, expected) {
  const levels = drawn.length, highest = Math.max(...drawn, ...expected.share), width = 425 / levels;
  const decade = 10 ** Math.floor(Math.log10(highest)), step = decade * (highest > 4 * decade ? 2 : highest > 2 * decade ? 1 : 0.5);
  const x = k => 50 + (k + 0.5) * width, y = v => 210 - 185 * v / highest;
  const every = Math.ceil(levels / 16), xTicks = [], yTicks = [];
  for (let k = 0; k < levels; k += every) xTicks.push([k, k]);
  for (let v = 0; v <= highest; v += step) yTicks.push([v, short(v, 2)]);
  const bars = Array.from(drawn, (v, k) => element("rect", { class: "drawn", x: x(k) - 0.42 * width, width: 0.84 * width, y: y(v), height: Math.max(210 - y(v), 0) }));
  const marks = Array.from(expected.share, (v, k) => `M${x(k) - 0.42 * width} ${y(v)}h${0.84 * width}`).join("");
  at("histogram").replaceChildren(...frame(x, y, xTicks, yTicks, "code", "share of pixels"), ...bars, element("path", { class: "expected", d: marks }));
}

function drawSnr(response, photons, mean, here) {
  const low = response[0].photons, high = response[response.length - 1].photons;
  const decibel = snr => snr > 0 ? 20 * Math.log10(snr) : -99;
  const x = v => 50 + 425 * Math.min(Math.max(Math.log(v / low) / Math.log(high / low), 0), 1), y = v => 200 - 175 * (Math.min(Math.max(v, -22), 52) + 20) / 70;
  const line = points => points.map(([a, b], i) => (i ? "L" : "M") + x(a) + " " + y(b)).join("");
  const xTicks = [], yTicks = [-20, 0, 20, 40].map(v => [v, v]);
  for (let v = low; v <= 1.001 * high; v *= 10) xTicks.push([v, v > 5000 ? "10" + "⁴⁵"[Math.round(Math.log10(v)) - 4] : short(v)]);
  const left = x(percentile(photons, 0.01)), right = x(percentile(photons, 0.99));
  at("snr").replaceChildren(
    element("rect", { class: "range", x: left, width: Math.max(right - left, 1), y: 20, height: 190 }),
    ...frame(x, y, xTicks, yTicks, "photons per code", "SNR [dB]"),
    element("path", { class: "ideal", d: line([[low, 10 * Math.log10(low)], [high, 10 * Math.log10(high)]]) }),
    element("path", { class: "snr", d: line(response.map(r => [r.photons, decibel(r.snr)]).filter(p => p[1] > -21)) }),
    element("circle", { class: "point", cx: x(mean), cy: y(here), r: 5 }));
  at("snr").setAttribute("aria-label", `signal-to-noise ratio against light; ${here.toFixed(1)} dB at the mean light`);
}

// Everything that follows from the state.

function update() {
  waiting = false;
  const own = sensor(), top = 2 ** own.bits - 1, first = state.start - 1;
  const photons = photonsOf(first, state.frames);
  const codes = drawCodes(own, photons, state.seed * 4096 + first), expected = expectedShares(own, photons);
  const counts = new Float64Array(top + 1);
  for (const code of codes) counts[code] += 1;
  const mean = photons.reduce((a, b) => a + b, 0) / pixels, decades = [0.01, 100_000];
  const lights = Array.from({ length: GRID }, (_, i) => decades[0] * (decades[1] / decades[0]) ** (i / (GRID - 1)));
  const response = responseAt(own, lights), here = 20 * Math.log10(Math.max(responseAt(own, [mean])[0].snr, 1e-3));
  showPictures(first, photons, codes, lightOfCodes(response, top));
  drawHistogram(counts.map(n => n / pixels), expected);
  drawSnr(response, photons, mean, here);
  showNumbers(own, counts, expected, mean, here);
  writeAddress();
}

function showPictures(first, photons, codes, light) {
  const middle = photonsOf(first + Math.floor((state.frames - 1) / 2), 1);
  const bright = percentile(photons, 0.999) || 1, brightest = Math.min(bright, light[light.length - 1]) || 1;
  paint("instant", middle, percentile(middle, 0.999) || 1);
  paint("exposed", photons, bright);
  paint("codes", Float64Array.from(codes, code => light[code]), brightest);
  at("exposed-caption").textContent = state.frames > 1 ? `, mean of ${state.frames} frames` : "";
  at("codes-caption").textContent = `, ${state.bits} bit, each as its light; brightest shown: ${short(brightest)} photons or code ${light.length - 1}`;
}

function showNumbers(own, counts, expected, mean, here) {
  const top = counts.length - 1;
  const moved = data.motion === null ? null : data.motion * (state.frames - 1 + data.shutter);
  at("photons").textContent = short(mean);
  at("events").textContent = short(meanEvents(own, mean));
  at("event-name").textContent = own.model === "QIS" ? "electrons" : "avalanches";
  at("snr-mean").textContent = here.toFixed(1) + " dB";
  at("saturated").textContent = short(100 * counts[top] / pixels, 2) + " %";
  at("blur").textContent = moved === null ? "unknown" : short(moved, 2) + " px";
  at("rate").textContent = short(data.frameRate / state.frames, 3) + "/s";
  const z = Array.from(counts, (n, k) => (n / pixels - expected.share[k]) / expected.sigma[k]).filter((_, k) => pixels * expected.sigma[k] > 3);
  const most = z.length ? Math.max(...z.map(Math.abs)).toFixed(1) : "0";
  const words = `Codes of ${pixels} pixels. Bars: drawn; lines: expected from the exact distribution. Largest difference ${most} standard deviations.`;
  at("histogram-caption").textContent = words;
  at("histogram").setAttribute("aria-label", words);
  at("numbers").tBodies[0].replaceChildren(...Array.from(counts, (n, k) => {
    const row = document.createElement("tr");
    for (const value of [k, n, pixels * expected.share[k], pixels * expected.sigma[k]]) {
      const cell = row.insertCell();
      cell.className = "number";
      cell.textContent = Number.isInteger(value) ? value : value.toFixed(2);
    }
    return row;
  }));
  at("file").textContent = sensorFile(own);
  at("sense").textContent = state.frames === 1
    ? `qsim sense CLIP --sensor my_sensor.toml --ppp ${state.light} draws these codes of the whole clip.`
    : "qsim sense draws one code per clip frame: set frames per code to 1 for the command.";
}

function later() {
  if (!waiting) { waiting = true; requestAnimationFrame(update); }
}

function change(name, value) {
  state[name] = value;
  if (["model", ...NAMES.slice(2, 8)].includes(name)) state.device = "";
  keepName();
  showControls();
  later();
}

function play() {
  if (timer) { clearInterval(timer); timer = null; } else {
    timer = setInterval(() => {
      state.seed += 1;
      change("start", state.start % (data.frames - state.frames + 1) + 1);
    }, 200);
  }
  at("play").textContent = timer ? "pause" : "play";
  at("play").setAttribute("aria-pressed", String(Boolean(timer)));
}

for (const name of NAMES) at(name).addEventListener("input", event => change(name, scaleOf(event.target).value(Number(event.target.value))));
at("model").addEventListener("change", event => change("model", event.target.value));
at("device").addEventListener("change", event => { takeDevice(event.target.value); showControls(); later(); });
at("play").addEventListener("click", play);
at("again").addEventListener("click", () => { state.seed += 1; later(); });
document.querySelector("form.controls").addEventListener("submit", event => event.preventDefault());
addEventListener("hashchange", () => { readAddress(); showControls(); later(); });
readAddress();
showControls();
update();
