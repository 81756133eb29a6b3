// Starts the page: views, theme, links, the state of the stream.

import { initAlarms, redrawAlarms } from "./alarms.js";
import { initCommands, showUser } from "./commands.js";
import { initDetail } from "./detail.js";
import { byId, element, elements, indexed } from "./dom.js";
import { fixedText, numberText } from "./numbers.js";
import { initPoint } from "./point.js";
import { initReplay } from "./replay.js";
import { ask, connect, drawAll, isStale, onChange, pageIsSilent, signal, state, titleOf, valueText } from "./store.js";
import { hideTrends, initTrends, recolourStrips, recolourTrends, refreshStrips, showTrends } from "./trends.js";
import { bindAll, bindNames, controlledBar, inputBar, loadBar, measuredBar } from "./values.js";
import { initWhy, pick, recolourWhy, showWhy } from "./why.js";

const VIEWS = ["overview", "trends", "why", "alarms", "commands", "detail"];
const NAMES = { plant: "plant", control_plc: "control", optimizer_plc: "optimiser" };

function theme(name) {
  document.documentElement.dataset.theme = name;
  recolourTrends();
  recolourStrips();
  recolourWhy();
}

function show() {
  const view = VIEWS.includes(location.hash.slice(1)) ? location.hash.slice(1) : "overview";
  for (const one of VIEWS) byId(one).hidden = one !== view;
  for (const link of elements("nav a")) {
    if (link.hash === `#${view}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (view === "trends") showTrends();
  else hideTrends();
  if (view === "why") showWhy();
  if (view === "alarms") redrawAlarms();
  if (view === "overview") refreshStrips();
}

function links() {
  const holder = byId("links");
  for (const service of state.catalog.services)
    holder.append(
      element(
        "span",
        { class: "link", "data-service": service },
        element("i"),
        NAMES[service],
        element("span", { class: "age" }),
      ),
    );
  onChange(() => {
    const silent = pageIsSilent(),
      dead = [];
    for (const one of holder.children) {
      const about = state.services[one.dataset.service] || { live: false, age_s: null, reason: "" };
      const live = about.live && !silent;
      one.classList.toggle("live", live);
      one.classList.toggle("dead", !live);
      const age =
        about.age_s === null
          ? "never"
          : `${(about.age_s + (silent ? (performance.now() - state.heard) / 1000 : 0)).toFixed(1)} s`;
      one.querySelector(".age").textContent = age;
      one.title = live
        ? `${one.dataset.service} answers; age ${age}`
        : `${one.dataset.service}: ${about.reason || "silent"}`;
      if (!live) dead.push(`${one.dataset.service} is silent (${about.reason || "no answer"})`);
    }
    const banner = byId("banner");
    const text = !silent
      ? dead.join("; ")
      : `${state.refused || "The page's own server does not answer"}: nothing here is current. Trying again.`;
    banner.hidden = !text;
    if (banner.textContent !== text) banner.textContent = text;
  });
}

function bars() {
  const { controlled, measured, inputs, load } = state.catalog.process;
  byId("controlled").after(...controlled.map(controlledBar));
  byId("measured").after(...measured.map(measuredBar));
  byId("measured").hidden = !measured.length;
  byId("inputs").after(...inputs.map((one) => inputBar(one, one.label)));
  byId("load").hidden = !load;
  if (load) byId("load").after(loadBar(load));
}

const nextIn = () =>
  `${fixedText((state.values["plant.load status.next_tick"] - state.tick) * state.catalog.tick_s, 0)} s`;

function overview() {
  const { load } = state.catalog.process,
    decimals = signal("plant.load status.watts")?.decimals;
  const loadText = (value, places = decimals ?? 4) => `${fixedText(value, Math.max(0, places))} ${load?.unit}`;
  const tau = byId("tau-u"),
    facts = byId("load-facts");
  onChange(({ update, names }) => {
    if (update || names === null) {
      const found = state.update;
      tau.textContent = found ? `${fixedText(found.period_s, 2)} s` : "–";
      byId("tau-u-q").textContent = found ? `q = ${found.q}, J = ${numberText(found.update.j_effective)}` : "";
      byId("tau-u-sentence").replaceChildren(...(found ? indexed(found.sentence) : ["No update yet."]));
    }
    const values = state.values,
      upcoming = values["plant.load status.upcoming"];
    const note = byId("tau-u-note"),
      inUse = !state.stale.includes("update");
    note.hidden = inUse;
    if (!inUse) note.textContent = "Of the last update: MPC is not active now.";
    const ofLoad = () => [
      [
        "expected next",
        state.replay
          ? "–"
          : upcoming
            ? [loadText(values["plant.load status.next_watts"]), nextIn()].join(" in ")
            : "as now",
        "plant.",
        "control_plc.process.",
      ],
      [
        "estimated mismatch",
        state.update ? loadText(state.update.update.load_mismatch) : "–",
        "optimizer_plc.",
        "update",
      ],
    ];
    const rows = [...(load ? ofLoad() : []), ["plant against model", state.deviation || "–", "optimizer_plc."]];
    const shortage = values["control_plc.plan.shortage"];
    if (load && shortage)
      rows.unshift([
        "load",
        [
          loadText(Math.abs(shortage), (decimals ?? 4) - 1),
          shortage > 0 ? "more than can be held" : "less than is needed",
        ].join(" "),
        "control_plc.",
        "update",
      ]);
    const text = JSON.stringify(rows);
    if (facts.dataset.text !== text) {
      facts.dataset.text = text;
      facts.replaceChildren(
        ...rows.flatMap(([name, value, ...sources]) => [
          element("dt", { text: name }),
          element("dd", { class: "value", text: value, "data-sources": sources.join(" ") }),
        ]),
      );
    }
    for (const one of elements("dd", facts))
      one.classList.toggle("stale", one.dataset.sources.split(" ").some(isStale));
    const mode = state.values["control_plc.ladder.mode"];
    const title = titleOf({
      alarms: state.alarms,
      stale: isStale("control_plc."),
      mode: valueText("control_plc.ladder.mode", "mode"),
    });
    if (document.title !== title) document.title = title;
    byId("drive-chip").classList.toggle("abnormal-mode", mode !== undefined && mode !== 1);
    for (const one of elements("#strips, #charts")) one.classList.toggle("stale", isStale("control_plc.process."));
  });
  setInterval(refreshStrips, 1000);
}

// One drawing for each kind of cold box. If another one is found later, the page reloads. Other processes may bring
// one.
const MIMICS = { refrigerator: "static/mimic-refrigerator.svg" };
async function mimic(kind) {
  const own = state.catalog.process.mimic;
  if (!own) {
    document.body.dataset.plant = "not-drawn";
    byId("mimic").remove();
    byId("strips").setAttribute(
      "aria-label",
      "Controlled outputs, load and updating period over the last five minutes",
    );
    return;
  }
  const text = await (await fetch(MIMICS[kind] || own)).text();
  byId("mimic").append(
    document.importNode(new DOMParser().parseFromString(text, "image/svg+xml").documentElement, true),
  );
  if (own === "mimic.svg") bindNames(byId("mimic"));
  document.body.dataset.plant = kind;
  onChange(() => {
    if ((MIMICS[state.plant.kind] || "") !== (MIMICS[kind] || "")) location.reload();
  });
}

async function start() {
  [state.catalog, state.me] = await Promise.all([ask("api/catalog"), ask("api/me"), connect()]);
  await mimic(state.plant.kind);
  theme(localStorage.getItem("theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
  byId("theme").addEventListener("click", () => {
    const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    localStorage.setItem("theme", next);
    theme(next);
  });
  bars();
  initDetail();
  for (const one of [...elements("header"), byId("overview"), byId("commands")]) bindAll(one);
  links();
  overview();
  initTrends((time) => {
    location.hash = "#why";
    pick(`?at=${time}`);
  });
  initPoint(document);
  initWhy();
  initCommands(redrawAlarms);
  initAlarms();
  initReplay();
  showUser();
  drawAll();
  if (state.refused && !state.me.role) byId("login-open").click();
  show();
  addEventListener("hashchange", () => {
    show();
    byId("view").focus({ preventScroll: true });
    byId("view").scrollTop = 0;
  });
}

start();
