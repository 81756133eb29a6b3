// One signal of the drawing or of a bar: its trend, and setpoint, value and output together.

import { leastSpread, makeChart } from "./charts.js";
import { byId, element, elements } from "./dom.js";
import { ask, onChange, signal, state, valueText } from "./store.js";
import { show } from "./values.js";

const REFRESH_MS = 1000,
  SAMPLES = 60;
let /** @type {any} */ shown = null,
  /** @type {any} */ chart = null;

// What belongs to a signal: [word, name of its signal], the curves of its trend, and the band or the bounds of these.
function partsOf(full) {
  const { process, trended } = state.catalog,
    name = full.split(".").at(-1);
  const range = (kind) =>
    [
      ["low", "from"],
      ["high", "to"],
    ].map(([end, word]) => [
      `${kind === "output" ? "band" : "bounds"} ${word}`,
      `optimizer_plc.operating limits.${kind}_${end}.${name}`,
    ]);
  const input = full.includes(".process.u.") && process.inputs.find((one) => one.name === name);
  const output = full.includes(".process.y.") && process.controlled.find((one) => one.name === name);
  const rows = input
    ? [["operator's setpoint", `control_plc.operator.${input.register}`], ["output, applied", full], ...range("input")]
    : [
        ["value", full],
        ...(output ? range("output") : []),
        ...(output?.loop ? [[`output of its loop, ${output.loop}`, `control_plc.process.u.${output.loop}`]] : []),
      ];
  return {
    name,
    rows: rows.filter(([, one]) => signal(one)),
    curve: trended.includes(name) ? name : null,
    bar: (input || output)?.bar,
    kind: input ? "bounds" : "bands",
  };
}

async function refresh() {
  if (!shown?.curve) return;
  const { curve, kind } = shown,
    seconds = SAMPLES * state.catalog.process.sample_s;
  let found;
  try {
    found = await ask(`api/trend?names=${curve}&seconds=${seconds}&points=400`);
  } catch {
    return;
  }
  if (!shown || shown.curve !== curve) return;
  const about = signal(shown.full),
    title = `${curve} ${about ? about.unit : ""}`;
  chart ??= makeChart(byId("point-chart"), [{ label: curve, stroke: "trend", stepped: kind === "bounds" }], {
    title,
    axis: true,
    spread: shown.bar ? leastSpread(shown.bar) : 0.01,
    range: (_low, high) => [high - seconds, high],
  });
  chart.show([found.time, found.series[curve]], {
    band: found[kind][curve] || null,
    bandName: kind === "bands" ? "band" : "bounds",
    doubtful: found.doubtful,
    modes: found.modes,
    gaps: found.gaps,
  });
}

function open(full) {
  const about = signal(full);
  shown = { ...partsOf(full), full };
  byId("point-title").textContent = shown.name;
  byId("point-about").textContent = about ? about.description : "";
  byId("point-facts").replaceChildren(
    ...shown.rows.flatMap(([word, name]) => [
      element("dt", { text: word }),
      element("dd", { class: "value", "data-of": name }),
    ]),
  );
  byId("point-chart").hidden = !shown.curve;
  byId("point").showModal();
  draw();
  refresh();
}

function draw() {
  if (shown)
    for (const one of elements(".value", byId("point-facts"))) {
      one.textContent = valueText(one.dataset.of);
      show(one, [one.dataset.of]);
    }
}

/** @param {ParentNode} root */
export function initPoint(root) {
  for (const one of elements(".tag[data-signal], .bar[data-signal]", root)) {
    one.setAttribute("role", "button");
    one.setAttribute("tabindex", "0");
    one.addEventListener("click", () => open(one.dataset.signal));
    one.addEventListener("keydown", (event) => {
      if (["Enter", " "].includes(event.key)) {
        event.preventDefault();
        open(one.dataset.signal);
      }
    });
  }
  byId("point-close").addEventListener("click", () => byId("point").close());
  byId("point").addEventListener("close", () => {
    shown = null;
    if (chart) chart.chart.destroy();
    chart = null;
    byId("point-chart").replaceChildren();
  });
  onChange(draw);
  setInterval(refresh, REFRESH_MS);
}
