// Values on the page: text, analogue bars and the tags of the mimic, all bound to a signal by data-signal.
import { element, elements, shape } from "./dom.js";
import { endsText } from "./numbers.js";
import { LETTERS, TEXTS, worse } from "./quality.js";
import { isStale, onChange, qualityOf, signal, state, valueText } from "./store.js";

const bound = new Map(); // signal -> functions that draw
const watched = []; // [element, signals or prefixes: all of them are current, or the element is crossed out]

function bind(name, draw) {
  if (!bound.has(name)) bound.set(name, []);
  bound.get(name).push(draw);
  draw();
}

const number = (name) => (typeof state.values[name] === "number" ? state.values[name] : NaN);
const pair = (text) => (text ? text.match(/\S+ limits\.\S+/g) : null);

/** @param {ParentNode} root */
export function bindAll(root) {
  for (const one of elements(".tag[data-signal]", root)) bindTag(one);
  for (const one of elements(".bar[data-signal]", root)) bindBar(one);
  for (const one of elements("[data-signal]:not(.tag):not(.bar)", root)) bindText(one);
  for (const one of elements("[data-fill]", root)) bindFill(one);
  for (const one of elements("[data-source]", root)) watched.push([one, ...one.dataset.source.split(" ")]);
}

/** @param {PageElement} one */
export function bindText(one) {
  const name = one.dataset.signal,
    as = one.dataset.as;
  bind(name, () => {
    const text = valueText(name, as);
    if (one.textContent !== text) one.textContent = text;
  });
  if (as === "pace")
    for (const other of ["plant.pace.paused", "plant.pace.realtime"])
      bind(other, () => {
        one.textContent = valueText(name, as);
      });
  watched.push([one, name]);
}

// The scale of a bar: from data-low to data-high, wider when the value or its band is outside.
function scale(one, value, ends) {
  const all = [Number(one.dataset.low), Number(one.dataset.high), value, ...ends].filter(Number.isFinite);
  const low = Math.min(...all),
    high = Math.max(...all);
  return { from: low, to: high, at: (x) => (x - low) / (high - low || 1) };
}

// Where the plant's own alarms of a signal begin; an end that there is not is the end of the scale.
function ownBand(one, name) {
  const [low, high] = state.plant.bands?.[name] || [null, null];
  return low === null && high === null
    ? null
    : [low === null ? Number(one.dataset.low) : low, high === null ? Number(one.dataset.high) : high];
}

// How far an output may be beyond its band until it is marked.
const deadBand = (name) =>
  (state.catalog.process.controlled.find((one) => name.endsWith(`.y.${one.name}`)) || { dead_band: 0 }).dead_band;

function place(one, parts, width) {
  const name = one.dataset.signal,
    value = number(name);
  const own = ownBand(one, name),
    band = own || pair(one.dataset.band),
    bounds = pair(one.dataset.bounds);
  const ends = own || (band || bounds || []).map(number);
  const known = ends.length === 2 && ends[1] > ends[0];
  const { from, to, at } = scale(one, value, known ? ends : []);
  if (known) {
    parts.band.setAttribute("x", at(ends[0]) * width);
    parts.band.setAttribute("width", Math.max(0, (at(ends[1]) - at(ends[0])) * width));
  }
  parts.pointer.classList.toggle("unknown", !Number.isFinite(value));
  if (Number.isFinite(value)) parts.pointer.setAttribute("x", at(value) * width - 1.5);
  const dead = own ? 0 : deadBand(name),
    outside = known && (value < ends[0] - dead || value > ends[1] + dead);
  one.classList.toggle("abnormal", Boolean(band) && outside);
  one.classList.toggle("at-limit", Boolean(bounds) && known && (value <= ends[0] || value >= ends[1]));
  return { value, from, to };
}

// What is not current is crossed out from corner to corner: a line along the middle would hide a sign.
const cross = (width, height) => shape("line", { class: "cross", x1: -2, y1: height, x2: width + 2, y2: 0 });

// A value without a bar, for what has no limits.
function bindSmallTag(tag) {
  const name = tag.dataset.signal,
    width = Number(tag.dataset.width) || 100;
  const text = shape("text", { x: width, y: 12, "text-anchor": "end", class: "reading" });
  tag.append(
    shape("rect", { class: "ground", x: -2, y: 0, width: width + 4, height: 16, rx: 2, opacity: 0.85 }),
    shape("text", { class: "name", x: 0, y: 12 }, tag.dataset.name),
    shape("text", { class: "mark", x: -14, y: 13 }),
    text,
    cross(width, 16),
  );
  bind(name, () => {
    text.textContent = valueText(name);
  });
  watched.push([tag, name]);
}

function bindTag(tag) {
  if (tag.classList.contains("small")) {
    bindSmallTag(tag);
    return;
  }
  const name = tag.dataset.signal,
    width = Number(tag.dataset.width) || 100;
  const frame = shape("rect", { class: "frame", x: -3, y: -1, width: width + 6, height: 32, rx: 2 });
  const ground = shape("rect", { class: "ground", x: -2, y: 0, width: width + 4, height: 30, rx: 2, opacity: 0.85 });
  const label = shape("text", { class: "name", x: 0, y: 14 }, tag.dataset.name);
  const letter = shape("text", { class: "letter", x: -14, y: 15 }, "!"),
    mark = shape("text", { class: "mark", x: -14, y: 29 });
  const text = shape("text", { x: width, y: 14, "text-anchor": "end", class: "reading" });
  const parts = {
    track: shape("rect", { class: "track", x: 0, y: 20, width, height: 6 }),
    band: shape("rect", { class: "band", x: 0, y: 20, width: 0, height: 6 }),
    pointer: shape("rect", { class: "pointer", x: 0, y: 18, width: 3, height: 10 }),
  };
  tag.append(ground, frame, label, letter, mark, text, parts.track, parts.band, parts.pointer, cross(width, 30));
  const draw = () => {
    text.textContent = valueText(name);
    place(tag, parts, width);
  };
  for (const one of [name, ...(pair(tag.dataset.band) || []), ...(pair(tag.dataset.bounds) || [])]) bind(one, draw);
  watched.push([tag, name]);
}

// A rectangle that is full where its signal is at data-high, and empty at data-low.
function bindFill(one) {
  const name = one.dataset.fill,
    low = Number(one.dataset.low),
    high = Number(one.dataset.high);
  const full = Number(one.getAttribute("height")),
    bottom = Number(one.getAttribute("y")) + full;
  bind(name, () => {
    const height = full * Math.min(1, Math.max(0, (number(name) - low) / (high - low) || 0));
    one.setAttribute("y", bottom - height);
    one.setAttribute("height", height);
  });
  watched.push([one, name]);
}

/**
 * A drawing that a process brings names its signals as the process does; tags and levels have the ends of their bars.
 * @param {PageElement} root
 */
export function bindNames(root) {
  const { inputs, controlled, measured, load } = state.catalog.process,
    known = new Map();
  const add = (name, signal, one, more) =>
    known.set(name, { name, signal: `control_plc.process.${signal}`, low: one.bar[0], high: one.bar[1], ...more });
  for (const one of inputs) add(one.name, `u.${one.name}`, one, { bounds: within("input", one.name) });
  for (const one of controlled) add(one.name, `y.${one.name}`, one, { band: within("output", one.name) });
  for (const one of measured) add(one.name, `y.${one.name}`, one);
  if (load) add("load", "load", load);
  for (const one of elements("[data-signal], [data-fill]", root)) {
    const { signal: full, ...more } = known.get(one.dataset.signal || one.dataset.fill),
      about = signal(full);
    const unit = String(about?.unit ?? "");
    more.width = Math.max(100, Math.ceil(6.5 * more.name.length + 8 * (8 + unit.length))); // room for both
    if (one.dataset.fill) one.dataset.fill = full;
    else one.dataset.signal = full;
    if (one.matches(".tag, [data-fill]"))
      for (const [key, value] of Object.entries(more)) if (!(key in one.dataset)) one.dataset[key] = value;
  }
}

// A bar of a signal of the process, with its band or its bounds: ends that the optimiser keeps it within.
function bar(name, label, ends, more = {}) {
  return element("div", {
    class: "bar",
    "data-name": label,
    "data-signal": `control_plc.process.${name}`,
    "data-low": ends[0],
    "data-high": ends[1],
    ...more,
  });
}
const within = (kind, name) =>
  ["low", "high"].map((end) => `optimizer_plc.operating limits.${kind}_${end}.${name}`).join(" ");
/**
 * @param {ProcessSignal} one
 * @param {string} label
 */
export const inputBar = (one, label) =>
  bar(`u.${one.name}`, label, one.bar, { "data-bounds": within("input", one.name) });
/** @param {ProcessSignal} one */
export const controlledBar = (one) =>
  bar(`y.${one.name}`, one.name, one.bar, { "data-band": within("output", one.name) });
/** @param {ProcessSignal} one */
export const measuredBar = (one) => bar(`y.${one.name}`, one.name, one.bar);
/** @param {ProcessLoad} one */
export const loadBar = (one) => bar("load", "load", one.bar);

function bindBar(bar) {
  const name = bar.dataset.signal,
    width = 100;
  const drawing = shape("svg", { viewBox: `0 0 ${width} 20`, preserveAspectRatio: "none", "aria-hidden": "true" });
  const parts = {
    track: shape("rect", { class: "track", x: 0, y: 6, width, height: 9 }),
    band: shape("rect", { class: "band", x: 0, y: 6, width: 0, height: 9 }),
    pointer: shape("rect", { class: "pointer", x: 0, y: 2, width: 2.2, height: 17 }),
  };
  drawing.append(parts.track, parts.band, parts.pointer);
  const about = signal(name);
  const text = element("span", { class: "value reading", "data-reading": name });
  const low = element("span"),
    high = element("span");
  bar.append(
    element("span", { class: "name", text: bar.dataset.name, title: about ? about.description : "" }),
    drawing,
    text,
    element("span", { class: "ends", "aria-hidden": "true" }, low, high),
  );
  const draw = () => {
    text.textContent = valueText(name);
    const { from, to } = place(bar, parts, width);
    [low.textContent, high.textContent] = endsText(from, to);
  };
  for (const one of [name, ...(pair(bar.dataset.band) || []), ...(pair(bar.dataset.bounds) || [])]) bind(one, draw);
  watched.push([text, name], [drawing, name]);
}

// Words on the drawing, and machines that have tripped.
function drawStation() {
  for (const one of elements("[data-station]")) {
    const text = `${one.dataset.station}${state.plant.mode || ""}`;
    if (one.textContent !== text) one.textContent = text;
  }
  for (const one of elements("[data-alarm-of]"))
    one.classList.toggle("tripped", (state.plant.alarms || []).includes(one.dataset.alarmOf));
  for (const one of elements("[data-station], [data-alarm-of]"))
    one.classList.toggle("stale", isStale("plant.station."));
}

/**
 * One form of quality everywhere: what is doubtful has a letter beside its value.
 * @param {any} one
 * @param {string[]} names
 */
export function show(one, names) {
  const quality = names.map(qualityOf).reduce(worse);
  one.classList.toggle("stale", names.some(isStale));
  if ((one.dataset.quality || "good") === quality) return;
  if (quality === "good") delete one.dataset.quality;
  else one.dataset.quality = quality;
  const mark = one.querySelector(".mark");
  if (mark) mark.textContent = LETTERS[quality];
  else one.dataset.letter = LETTERS[quality];
  if (one instanceof HTMLElement) one.title = TEXTS[quality] || "";
}

onChange(({ names }) => {
  drawStation();
  const drawn = new Set();
  for (const name of names === null ? bound.keys() : names) {
    for (const draw of bound.get(name) || [])
      if (!drawn.has(draw)) {
        drawn.add(draw);
        draw();
      }
  }
  for (const [one, ...names] of watched) show(one, names);
});
