// Trends: a window of plant time, the horizon ahead, zoom, values at the cursor, export.

import { asPicture, DASHES, leastSpread, legendOf, makeChart } from "./charts.js";
import { byId, element } from "./dom.js";
import { durationText, timeText } from "./numbers.js";
import { LETTERS, TEXTS } from "./quality.js";
import { valuesAt } from "./readout.js";
import { ask, qualityOf, signalText, state } from "./store.js";

const WINDOWS = [60, 180, 360, 720, 1440]; // sampling periods: 5 min to 2 h of the cold box
const COLOURS = ["trend", "trend-2", "trend-3"];
const LAST = [
  {
    id: "tau",
    title: "τu s, click to see why",
    lines: [{ label: "tau_u", stroke: "trend", from: "updates", stepped: true }],
    spread: 1,
  },
  {
    id: "cost",
    title: "(cost)",
    tall: true,
    lines: [
      { label: "J", name: "J reached", stroke: "trend", from: "updates" },
      { label: "J_predicted", name: "J predicted", stroke: "trend-2", from: "updates", dash: [4, 3] },
    ],
    log: true,
  },
];
const line = (label, stroke, more) => ({ label, stroke, from: "series", ...more });
const titled = (names, unit) => (names.length > 1 ? `(${unit})` : `${names[0]} ${unit}`);
const controlledChart = (one, place) => ({
  id: one.name,
  title: `${one.name} ${one.unit}`,
  lines: [line(one.name, "trend")],
  band: one.name,
  spread: leastSpread(one.bar),
  tall: true,
  ahead: [one.name],
  ribbon: place === 0,
});
// Inputs of one unit share a chart, and those in the unit of the load the chart of the load.
function inputChart(unit) {
  const group = state.catalog.process.inputs.filter((one) => one.unit === unit),
    names = group.map((one) => one.name);
  const { bounds, bar } = group[0],
    isShared = group.every((one) => String(one.bounds) === String(bounds));
  return {
    id: names[0],
    title: titled(names, unit),
    lines: names.map((name, i) => line(name, COLOURS[i % 3], { stepped: true, dash: DASHES[i % 4] })),
    bounds: isShared ? names[0] : null,
    spread: (bar[1] - bar[0]) / 25,
    ahead: names,
    isInputs: true,
  };
}
function loadChart() {
  const { inputs, load } = state.catalog.process;
  if (!load) return [];
  const names = inputs.filter((one) => one.unit === load.unit).map((one) => one.name);
  return [
    {
      id: "load",
      title: titled(["load", ...names], load.unit),
      lines: [
        line("load", "trend-3", { stepped: true }),
        ...names.map((name, i) => line(name, COLOURS[i % 2], { stepped: true, dash: DASHES[1 + (i % 3)] })),
      ],
      spread: (load.bar[1] - load.bar[0]) / 20,
    },
  ];
}
const disturbanceCharts = () =>
  state.catalog.process.disturbances.map((one) => ({
    id: one.name,
    title: `${one.name} ${one.unit}`,
    lines: [line(one.name, "trend-3")],
    spread: leastSpread(one.bar),
  }));
function ofProcess() {
  const { controlled, inputs, load } = state.catalog.process;
  const units = [...new Set(inputs.map((one) => one.unit))].filter((unit) => !load || unit !== load.unit);
  return [...controlled.map(controlledChart), ...units.map(inputChart), ...loadChart(), ...disturbanceCharts()];
}
// Of a whole refrigerator the pressures too, between the inputs and the updating period.
const PRESSURES = [
  ["P12", "HP bar"],
  ["P11", "LP bar"],
].map(([name, title]) => ({
  id: name,
  title,
  lines: [{ label: name, stroke: "trend", from: "series" }],
  station: name,
  spread: name === "P12" ? 0.4 : 0.04,
}));
const isRefrigerator = () => state.plant.kind === "refrigerator";
const drawn = () => [...ofProcess(), ...(isRefrigerator() ? PRESSURES : [])];
// Further pens: any other signal that trends are kept of, each in a chart of its own.
const MOST_PENS = 8;
/** @type {string[]} */
let pens = [];
const layout = () => [
  ...drawn(),
  ...pens.map((name) => ({
    id: `pen-${name}`,
    title: `${name}${unitOf(name)}`,
    lines: [{ label: name, stroke: "trend", from: "series", stepped: name === "mode" }],
    spread: 0.01,
  })),
  ...LAST,
];
const names = () =>
  layout()
    .flatMap((one) => one.lines)
    .filter((line) => line.from === "series")
    .map((line) => line.label)
    .join(",");
const aboutOf = (name) =>
  ["process.y.", "process.u.", "process."]
    .map((part) => state.catalog.signals[`control_plc.${part}${name}`])
    .concat(state.catalog.signals[`plant.station.signals.${name}`])
    .find(Boolean);
const unitOf = (name) => {
  const about = aboutOf(name);
  return about?.unit ? ` ${about.unit}` : "";
};
const stationBand = (name) => {
  const [low, high] = state.plant.bands?.[`plant.station.signals.${name}`] || [];
  return Number.isFinite(low) && Number.isFinite(high) ? [low, high] : null;
};
const REFRESH_MS = 1000;

let seconds = 0,
  /** @type {Ends | null} */ zoom = null,
  held = false,
  /** @type {any} */ newest = null,
  /** @type {any} */ onPick = () => {};
let /** @type {any} */ charts = null,
  /** @type {any} */ timer = null;

/** @returns {Ends} */
function range() {
  if (zoom) return zoom;
  const now = newest ? newest.now_s : 0,
    ahead = Math.min(100 * state.catalog.process.sample_s, seconds / 4);
  return [now - seconds, now + ahead];
}

function build() {
  const holder = byId("charts");
  holder.replaceChildren();
  charts = layout().map((one, place, all) => {
    const box = element("div", { class: `chart${one.tall ? " tall" : ""}`, id: `chart-${one.id}` });
    holder.append(box);
    const made = makeChart(box, one.lines, {
      title: one.title,
      spread: one.spread,
      log: one.log,
      sync: "trends",
      axis: place === all.length - 1,
      range,
      onZoom: (from, to) => {
        zoom = [from, Math.max(to, from + 8 * state.catalog.tick_s)];
        byId("unzoom").hidden = false;
        refresh();
      },
      onCursor: readout,
      onPick: one.id === "tau" || one.id === "cost" ? (time) => onPick(time) : null,
    });
    return { ...one, ...made };
  });
}

function readout(u) {
  const time = u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null;
  const target = byId("readout");
  if (time === null || !newest) {
    target.textContent = "";
    return;
  }
  const tick = state.catalog.tick_s,
    words = { tau_u: "τu", predicted: " (predicted)" };
  const said = (one) => words[one.quality] || (LETTERS[one.quality] ? ` ${LETTERS[one.quality]}` : "");
  const parts = valuesAt(newest, time).map(
    (one) => `${words[one.name] || one.name} ${signalText(one.value, aboutOf(one.name) || null)}${said(one)}`,
  );
  target.textContent = [timeText(Math.round(time / tick) * tick), ...(parts.length ? parts : ["nothing known"])].join(
    "  ",
  );
}

function show(one) {
  const source = (line) => (line.from === "updates" ? newest.updates : newest.series)[line.label] || [];
  const times = one.lines[0].from === "updates" ? newest.updates.time : newest.time;
  const predictions = one.ahead
    ? newest.predictions.map((each) => ({
        time: one.isInputs ? each.input_time : each.time,
        curves: one.ahead.map((name) => each[name]),
      }))
    : [];
  one.show([times, ...one.lines.map(source)], {
    band: one.band
      ? newest.bands[one.band]
      : one.station
        ? stationBand(one.station)
        : one.bounds
          ? newest.bounds[one.bounds]
          : null,
    bandName: one.band
      ? "band"
      : one.station
        ? "alarm limits"
        : one.bounds
          ? ["bounds", "bounds of both"][one.lines.length - 1] || "bounds of all"
          : "",
    predictions,
    planned: newest.planned,
    gaps: newest.gaps,
    doubtful: newest.doubtful,
    marks: newest.marks,
    modes: newest.modes,
    now: newest.now_s,
    ribbon: one.ribbon,
  });
}

async function refresh() {
  if (byId("trends").hidden) return;
  const end = zoom ? Math.min(zoom[1], state.tick * state.catalog.tick_s) : null;
  const span = zoom ? Math.max(1, Number(end) - zoom[0]) : seconds;
  const query = `names=${names()}&seconds=${span}&points=600`;
  const isHeld = held && newest && !zoom; // what was asked for last stays, also where it is drawn anew
  if (isHeld && charts) return;
  if (!isHeld)
    try {
      newest = await ask(`api/trend?${query}${zoom ? `&end=${end}` : ""}`);
    } catch {
      return;
    }
  if (!charts) build();
  charts.forEach(show);
  byId("charts").dataset.now = newest.now_s;
  byId("trend-legend").replaceChildren(
    ...legendOf(newest, { predictions: true }),
    element("span", { text: "Drag to zoom." }),
  );
  byId("export-csv").href = `api/trend.csv?${query}&end=${zoom ? end : newest.now_s}`;
}

/** @param {(time: number) => void} pick */
export function initTrends(pick) {
  onPick = pick;
  const holder = byId("windows");
  const lengths = WINDOWS.map((samples) => samples * state.catalog.process.sample_s);
  [seconds] = lengths;
  for (const length of lengths) {
    holder.append(
      element("button", {
        type: "button",
        class: "quiet",
        text: durationText(length),
        "aria-pressed": String(length === seconds),
        onclick: (event) => {
          seconds = length;
          zoom = null;
          byId("unzoom").hidden = true;
          for (const other of holder.children) other.setAttribute("aria-pressed", String(other === event.target));
          refresh();
        },
      }),
    );
  }
  byId("hold").addEventListener("click", () => {
    held = !held;
    byId("hold").setAttribute("aria-pressed", String(held));
    refresh();
  });
  byId("unzoom").addEventListener("click", () => {
    zoom = null;
    byId("unzoom").hidden = true;
    refresh();
  });
  byId("export-png").addEventListener("click", () => {
    asPicture(charts || [], byId("trend-legend")).toBlob((blob) => {
      const link = element("a", {
        href: URL.createObjectURL(/** @type {Blob} */ (blob)),
        download: "coldloop-trends.png",
      });
      link.click();
      URL.revokeObjectURL(link.href);
    });
  });
  pens = (localStorage.getItem("pens") || "")
    .split(",")
    .filter((name) => state.catalog.trended.includes(name))
    .slice(0, MOST_PENS);
  byId("pen-add").addEventListener("change", () => setPens([...pens, byId("pen-add").value]));
  showPens();
}

function setPens(names_) {
  pens = names_;
  localStorage.setItem("pens", pens.join(","));
  showPens();
  recolourTrends();
}

function showPens() {
  const choice = byId("pen-add"),
    shown = names().split(",");
  choice.replaceChildren(
    element("option", { value: "", text: "add…" }),
    ...state.catalog.trended
      .filter((name) => !shown.includes(name))
      .map((name) => element("option", { value: name, text: name })),
  );
  choice.value = "";
  choice.disabled = pens.length >= MOST_PENS;
  byId("pens").replaceChildren(
    ...pens.map((name) =>
      element("button", {
        type: "button",
        class: "quiet",
        text: `${name} ×`,
        "aria-label": `Remove ${name}`,
        onclick: () => setPens(pens.filter((one) => one !== name)),
      }),
    ),
  );
}

export function showTrends() {
  refresh();
  if (!timer) timer = setInterval(refresh, REFRESH_MS);
}
export function hideTrends() {
  clearInterval(timer);
  timer = null;
}
export function recolourTrends() {
  if (charts) {
    for (const one of charts) one.chart.destroy();
    charts = null;
    refresh();
  }
}

// The four small ones under the mimic.
function stripCharts() {
  const { controlled, load } = state.catalog.process;
  return [
    ...controlled.map((one) => ({
      title: `${one.name} ${one.unit} and its band`,
      lines: [{ label: one.name, stroke: "trend" }],
      band: one.name,
      spread: leastSpread(one.bar),
    })),
    ...loadChart().map((one) => ({
      ...one,
      title: `load ${load?.unit}`,
      lines: [{ label: "load", stroke: "trend", stepped: true }],
    })),
    ...disturbanceCharts(),
    { title: "τu s", lines: [{ label: "tau_u", stroke: "trend", stepped: true }], spread: 1, updates: true },
  ];
}
// What the letters beside values mean, of those that are shown now.
function lettersShown() {
  const shown = new Set(state.catalog.outputs.map((name) => qualityOf(`control_plc.process.y.${name}`)));
  return [...shown]
    .filter((quality) => LETTERS[quality])
    .map((quality) => element("span", { class: "entry", text: `${LETTERS[quality]}: ${TEXTS[quality]}` }));
}
let /** @type {any} */ strips = null,
  stripsNow = 0;
export async function refreshStrips() {
  if (byId("overview").hidden) return;
  const { controlled, disturbances, load, sample_s } = state.catalog.process,
    length = WINDOWS[0] * sample_s;
  let found;
  try {
    const shown = [...controlled, ...disturbances].map((one) => one.name).concat(load ? "load" : []);
    found = await ask(`api/trend?names=${shown}&seconds=${length}&points=400&brief=1`);
  } catch {
    return;
  }
  const holder = byId("strip-charts");
  stripsNow = found.now_s;
  if (!strips) {
    holder.replaceChildren();
    strips = stripCharts().map((one) => {
      const box = element("div", { class: "strip" });
      holder.append(box);
      return {
        ...one,
        ...makeChart(box, one.lines, {
          title: one.title,
          spread: one.spread,
          small: true,
          axis: true,
          range: () => [stripsNow - length, stripsNow],
        }),
      };
    });
  }
  for (const one of strips) {
    const times = one.updates ? found.updates.time : found.time;
    one.show([times, one.updates ? found.updates.tau_u : found.series[one.lines[0].label]], {
      band: one.band ? found.bands[one.band] : null,
      doubtful: found.doubtful,
      modes: found.modes,
      marks: found.marks,
      gaps: found.gaps,
    });
  }
  byId("strip-legend").replaceChildren(...legendOf(found), ...lettersShown());
}
export function recolourStrips() {
  if (strips) {
    for (const one of strips) one.chart.destroy();
    strips = null;
    refreshStrips();
  }
}
