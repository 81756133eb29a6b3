// Explanation of the updating period of one update.

import { leastSpread, makeChart } from "./charts.js";
import { byId, element, indexed, shape } from "./dom.js";
import { numberText, timeText } from "./numbers.js";
import { ask, onChange, state } from "./store.js";

let following = true,
  /** @type {any} */ shown = null,
  /** @type {any} */ charts = null,
  /** @type {Ends} */ window_ = [0, 1],
  asked = 0;

function quantities(found) {
  const u = found.update,
    before = found.before;
  const rows = [
    [
      "q",
      found.q_before === null ? `${found.q}` : `${found.q_before} → ${found.q}`,
      "number of the period in the ladder, before → now",
    ],
    ["n", before ? `${before.iterations} → ${u.iterations}` : `${u.iterations}`, "iterations done, before → now"],
    [
      "τ_u",
      found.period_before_s === null ? `${found.period_s} s` : `${found.period_before_s} → ${found.period_s} s`,
      "updating period",
    ],
    ["J_k", before ? numberText(before.j_effective, 6) : "–", "cost reached at the instant before"],
    ["J⁺_k", before ? numberText(before.j_hot_start, 6) : "–", "shifted profile, at the predicted state"],
    ["Ĵ_{k+1}", before ? numberText(before.j_delivered, 6) : "–", "delivered profile, as predicted"],
    ["J_{k+1}", numberText(u.j_effective, 6), "the same profile, at the state that was reached"],
    ["E", numberText(u.efficiency, 6), "efficiency of the solver, Ĵ_{k+1} / J⁺_k"],
    ["D", numberText(u.mismatch, 6), "model mismatch"],
    ["K", numberText(u.contraction, 6), "contraction, E D"],
    ["ΔE/Δn", found.increments ? numberText(found.increments.efficiency) : "–", ""],
    ["ΔD/Δn", found.increments ? numberText(found.increments.mismatch) : "–", ""],
    ["ΔK/Δn", found.increments ? numberText(found.increments.contraction) : "–", ""],
    [
      "Γ",
      numberText(u.gamma),
      !found.increments ? "" : u.contraction >= 1 ? "= ΔK/Δn, as K ≥ 1" : "= Δt_r/Δn, as K < 1",
    ],
    ["branch", found.branch, "what decided"],
  ];
  byId("why-quantities").replaceChildren(
    ...rows.map(([name, value, meaning]) =>
      element(
        "tr",
        {},
        element("td", {}, ...indexed(name)),
        element("td", { class: "number", text: value }),
        element("td", { class: "minor" }, ...indexed(meaning)),
      ),
    ),
  );
}

function alternatives(found) {
  const rows = found.alternatives.map((one) =>
    element(
      "tr",
      { class: one.q === found.q ? "chosen" : "" },
      element("td", { class: "number", text: `${one.q}${one.q === found.q ? " (chosen)" : ""}` }),
      element("td", { class: "number", text: `${one.period_s} s` }),
      element("td", { class: "number", text: numberText(one.contraction, 6) }),
      element("td", {
        class: "number",
        text: one.response_s === null ? "does not fall" : `${numberText(one.response_s)} s`,
      }),
    ),
  );
  byId("why-alternatives").replaceChildren(
    ...(rows.length
      ? rows
      : [
          element(
            "tr",
            {},
            element("td", {
              colspan: "4",
              class: "minor",
              text: ["up", "down", "level"].includes(found.branch)
                ? "K is 1 to the precision of the registers: no estimate for other q."
                : "Algorithm 1 did not decide here.",
            }),
          ),
        ]),
  );
}

function budget(found) {
  const { preparation, answer, period, iterations, iteration, slack } = found.budget;
  const end = Math.max(period, answer),
    width = 600,
    at = (time) => 10 + ((width - 20) * time) / end;
  const drawing = shape("svg", {
    viewBox: `0 0 ${width} 62`,
    role: "img",
    "aria-label": `Preparation until ${preparation} s, ${iterations} iterations until ${answer} s, period ${period} s`,
  });
  const block = (from, to, kind) =>
    drawing.append(
      shape("rect", { class: kind, x: at(from), y: 16, width: Math.max(0, at(to) - at(from)), height: 20 }),
    );
  block(0, preparation, "preparation");
  for (let i = 0; i < iterations; i += 1)
    block(preparation + i * iteration, preparation + (i + 1) * iteration, "iteration");
  if (slack >= 0) block(answer, period, "slack");
  else block(period, answer, "late");
  const word = (time, text, y, anchor = "middle") =>
    drawing.append(shape("text", { x: at(time), y, "text-anchor": anchor }, text));
  word(0, "measured", 11, "start");
  word(preparation, `prepared ${numberText(preparation, 3)} s`, 50, "start");
  word(answer, `answer ${numberText(answer, 3)} s`, 11, "end");
  word(
    end,
    slack >= 0
      ? `slack ${numberText(slack, 3)} s, takes effect at ${numberText(period, 3)} s`
      : `late by ${numberText(-slack, 3)} s`,
    50,
    "end",
  );
  byId("why-budget").replaceChildren(drawing);
}

async function curves(found) {
  const { controlled, sample_s } = state.catalog.process;
  const from = found.time_s - 6 * sample_s,
    to = found.time_s + (found.prediction ? 40 : 12) * sample_s;
  let trend;
  try {
    trend = await ask(`api/trend?names=${controlled.map((one) => one.name)}&seconds=${to - from}&end=${to}&points=400`);
  } catch {
    return;
  }
  window_ = [from, to];
  if (!charts) {
    charts = controlled.map(({ name, unit, bar }) => {
      const box = element("div", { class: "chart" });
      byId("why-charts").append(box);
      return {
        name,
        ...makeChart(box, [{ label: name, stroke: "trend" }], {
          title: `${name} ${unit}`,
          spread: leastSpread(bar) / 2,
          axis: true,
          range: () => window_,
        }),
      };
    });
  }
  for (const one of charts) {
    const predictions = found.prediction ? [{ time: found.prediction.time, curves: [found.prediction[one.name]] }] : [];
    one.show([trend.time, trend.series[one.name]], {
      band: trend.bands[one.name],
      bandName: "band",
      doubtful: trend.doubtful,
      gaps: trend.gaps,
      predictions,
      planned: true,
      now: found.time_s,
    });
  }
  const dashed = found.prediction
    ? "Dashed: the trajectory that was predicted."
    : "The predicted trajectory of this update is not kept any more.";
  const came = found.came === null ? "not known yet" : numberText(found.came, 5);
  byId("why-cost").textContent =
    `Cost at the end of this period: predicted ${numberText(found.predicted, 5)}, came ${came}. ${dashed} ` +
    "Vertical line: the updating instant.";
}

/** @param {string} query */
export async function showUpdate(query) {
  const mine = ++asked;
  let found;
  try {
    found = await ask(`api/explanation${query}`);
  } catch (/** @type {any} */ error) {
    if (!shown) byId("why-sentence").textContent = error.message;
    return;
  }
  if (mine !== asked) return;
  shown = found;
  byId("why-number").value = found.update.update;
  byId("why-time").textContent = `updating instant ${timeText(found.time_s)}, tick ${found.update.tick}`;
  byId("why-sentence").replaceChildren(...indexed(found.sentence));
  byId("why-before").disabled = found.neighbours[0] === null;
  byId("why-after").disabled = found.neighbours[1] === null;
  quantities(found);
  alternatives(found);
  budget(found);
  await curves(found);
}

function follow(on) {
  following = on;
  byId("why-follow").setAttribute("aria-pressed", String(on));
}

/** @param {string} query */
export function pick(query) {
  follow(false);
  showUpdate(query);
}

export function initWhy() {
  byId("why-before").addEventListener("click", () => pick(`?update=${shown.neighbours[0]}`));
  byId("why-after").addEventListener("click", () => pick(`?update=${shown.neighbours[1]}`));
  byId("why-number").addEventListener("change", () => pick(`?update=${byId("why-number").value}`));
  byId("why-follow").addEventListener("click", () => {
    follow(!following);
    if (following) showUpdate("");
  });
  let last = 0;
  onChange(({ update }) => {
    if (update && following && !byId("why").hidden && performance.now() - last > 800) {
      last = performance.now();
      showUpdate("");
    }
  });
}

export function showWhy() {
  if (following || !shown) showUpdate("");
}
export function recolourWhy() {
  if (charts) {
    for (const one of charts) one.chart.destroy();
    byId("why-charts").replaceChildren();
    charts = null;
    if (shown) curves(shown);
  }
}
