// The alarm line that is always in sight, the list of alarms, the history, the audit.

import { command } from "./commands.js";
import { byId, element, elements } from "./dom.js";
import { numberText, secondsOf, timeText } from "./numbers.js";
import { ask, isStale, onChange, state } from "./store.js";

const LETTERS = { 4: "C", 3: "H", 2: "M", 1: "L" };
const WAITING = ["unacknowledged", "returned"];

function badge(alarm) {
  const quiet = !["unacknowledged", "acknowledged", "returned"].includes(alarm.state);
  return element("span", {
    class: `shape ${quiet ? "idle" : `p${alarm.priority}`}`,
    "aria-hidden": "true",
    text: LETTERS[alarm.priority] || "",
  });
}

// What is acknowledged is what was seen: an alarm that is raised again meanwhile is left.
const seenOf = (alarms) =>
  Object.fromEntries(alarms.filter((one) => WAITING.includes(one.state)).map((one) => [one.name, one.times]));

function line() {
  const holder = byId("alarm-line"),
    active = state.alarms.filter((one) => ["unacknowledged", "acknowledged", "returned"].includes(one.state));
  const waiting = active.filter((one) => WAITING.includes(one.state)).length;
  const hidden = state.alarms.filter((one) => ["shelved", "out of service"].includes(one.state)).length;
  const link = (one) =>
    element(
      "a",
      { class: `alarm ${WAITING.includes(one.state) ? "unacknowledged" : ""}`, href: "#alarms" },
      badge(one),
      element("span", {
        text: `${one.name}${one.cause ? ` (${one.cause})` : ""}, ${state.catalog.alarm_states[one.state]}`,
      }),
    );
  const ofStation = (state.plant.alarms || []).map((name) =>
    element(
      "a",
      { class: "alarm of-station", href: "#alarms" },
      badge({ state: "acknowledged", priority: 3 }),
      element("span", { text: `station: ${name}` }),
    ),
  );
  const parts = [
    ...active.filter((one) => one.state !== "returned").map(link),
    ...ofStation,
    ...active.filter((one) => one.state === "returned").map(link),
  ];
  if (!parts.length) parts.push(element("span", { class: "minor", text: "No alarms" }));
  const station = (state.plant.alarms || []).length;
  const counts = [
    `${active.length} alarm${active.length === 1 ? "" : "s"}`,
    `${waiting} unacknowledged`,
    ...(hidden ? [`${hidden} suppressed`] : []),
    ...(station ? [`${station} of the station`] : []),
  ].join(", ");
  holder.replaceChildren(
    element("span", { class: "alarms" }, ...parts),
    element("span", { class: "count", text: counts }),
  );
  if (waiting)
    holder.append(
      element("button", {
        type: "button",
        class: "quiet operate-only",
        text: "Acknowledge all",
        hidden: !state.me.operates,
        onclick: () => command({ kind: "alarm", alarm: 65535, action: 1, seen: seenOf(state.alarms) }, true),
      }),
    );
}

function actions(alarm) {
  const does = state.catalog.alarm_actions,
    act =
      (name, time = 0) =>
      () =>
        command({ kind: "alarm", alarm: alarm.number, action: does[name], time_s: time });
  const button = (text, onclick) =>
    element("button", { type: "button", text, onclick, "aria-label": `${text}: ${alarm.name}` });
  const box = element("div", { class: "buttons" });
  if (WAITING.includes(alarm.state))
    box.append(
      button("Acknowledge", () =>
        command({ kind: "alarm", alarm: alarm.number, action: does.acknowledge, seen: seenOf([alarm]) }, true),
      ),
    );
  if (alarm.state === "shelved") box.append(button("Unshelve", act("unshelve")));
  else if (alarm.state !== "out of service") {
    const time = element(
      "select",
      { "aria-label": `Shelve ${alarm.name} for` },
      ...[
        ["15 min", 900],
        ["1 h", 3600],
        ["8 h", 28800],
      ].map(([text, value]) => element("option", { value, text })),
    );
    box.append(
      button("Shelve", () => act("shelve", Number(time.value))()),
      time,
    );
  }
  box.append(
    alarm.state === "out of service"
      ? button("In service", act("in service"))
      : button("Out of service", act("out of service")),
  );
  return box;
}

/**
 * What an alarm is now, in words.
 * @param {{state: string, active: boolean, shelved_until_s?: number}} one
 * @param {Record<string, string>} texts
 */
export function stateText(one, texts) {
  const until = one.state === "shelved" ? ` until ${timeText(Number(one.shelved_until_s))}` : "";
  return `${texts[one.state] || one.state}${one.active ? ", active" : ""}${until}`;
}

function row(one) {
  return element(
    "tr",
    { class: WAITING.includes(one.state) ? "unacknowledged" : "", "data-alarm": one.name },
    element("td", {}, badge(one), ` ${one.priority_word}`),
    element("td", { text: one.name }),
    element("td", {
      class: "alarm-state",
      text: stateText(one, state.catalog.alarm_states),
    }),
    element("td", { text: one.cause }),
    element("td", { class: "number", text: one.times ? timeText(one.raised_s) : "" }),
    element("td", { class: "number", text: one.times }),
    element("td", {}, state.me.operates ? actions(one) : ""),
  );
}

// Shelving counts plant time: the real time is shown where it differs.
function shelvingNote() {
  const factor = state.values["plant.pace.factor"],
    real = state.values["plant.pace.realtime"],
    paused = state.values["plant.pace.paused"];
  const quarter = numberText(900 / factor, 3);
  const text =
    !state.values["plant.pace.session"] || (real && !paused && factor === 1)
      ? ""
      : !real
        ? "Shelving counts plant time, which advances as it is granted."
        : paused
          ? "Shelving counts plant time, which is paused."
          : `Shelving counts plant time: at factor ${factor}, 15 min are over in ${quarter} s by the clock.`;
  const note = byId("shelving-note");
  note.hidden = !text;
  if (note.textContent !== text) note.textContent = text;
}

// Only changed rows are replaced: a button must not vanish while it is clicked.
const rows = new Map();
function table() {
  const body = byId("alarm-table").querySelector("tbody");
  state.alarms.forEach((one, place) => {
    const text = JSON.stringify([one, state.me.operates]),
      known = rows.get(one.number);
    if (!known || known.text !== text) {
      const made = row(one);
      if (known) known.row.replaceWith(made);
      rows.set(one.number, { row: made, text });
    }
    const own = rows.get(one.number).row;
    if (body.children[place] !== own) body.insertBefore(own, body.children[place] || null);
  });
}

let eventPage = 0; // 0 has the newest
const turn = (pages) => () => {
  eventPage = Math.max(0, eventPage + pages);
  history();
};
async function history() {
  if (byId("alarms").hidden) return;
  const [from, to] = ["event-from", "event-to"].map((id) => {
    const time = secondsOf(byId(id).value);
    byId(id).setCustomValidity(Number.isNaN(time) ? "a time such as 1:02:03" : "");
    return time || (time === 0 ? 0 : "");
  });
  const [search, service] = ["event-search", "event-service"].map((id) => encodeURIComponent(byId(id).value));
  const query = `search=${search}&service=${service}&from=${from}&to=${to}`;
  byId("event-csv").href = `api/events.csv?${query}`;
  try {
    const { found, first, pages, events } = await ask(`api/events?${query}&page=${eventPage}`);
    if (eventPage && eventPage >= pages) {
      eventPage = Math.max(0, pages - 1);
      history();
      return;
    }
    byId("event-count").textContent =
      `${found} events${pages > 1 ? `, ${first} to ${first + events.length - 1} of them, the newest first` : ""}`;
    byId("event-newer").disabled = !eventPage;
    byId("event-older").disabled = eventPage >= pages - 1;
    byId("event-table")
      .querySelector("tbody")
      .replaceChildren(
        ...events.map((one) =>
          element(
            "tr",
            {},
            element("td", { text: timeText(one.time_s) }),
            element("td", { text: one.utc.replace("T", " ").replace("Z", "") }),
            element("td", { text: one.service }),
            element("td", { text: one.sentence }),
          ),
        ),
      );
  } catch {
    /* the banner says it */
  }
  if (!state.me.operates) return;
  try {
    const { entries } = await ask("api/audit");
    byId("audit-table")
      .querySelector("tbody")
      .replaceChildren(
        ...entries
          .slice(0, 200)
          .map((one) =>
            element(
              "tr",
              {},
              element("td", { text: one.utc.replace("T", " ").replace("Z", "") }),
              element("td", { text: one.who || "nobody" }),
              element("td", { text: one.what }),
              element("td", { text: one.outcome, class: one.outcome === "done" ? "" : "refused" }),
              element("td", { text: one.detail }),
            ),
          ),
      );
  } catch {
    /* logged out meanwhile */
  }
}

let shownStation = "";
function stationNote() {
  const note = byId("station-note"),
    active = state.plant.alarms || [];
  note.hidden = state.plant.kind !== "refrigerator";
  const named = active.length ? active.join(", ") : "no alarms";
  note.textContent = `Compression station and nitrogen: ${named}. They clear by themselves; see the history.`;
  note.classList.toggle("refused", active.length > 0);
}

export function initAlarms() {
  for (const service of state.catalog.services)
    byId("event-service").append(element("option", { value: service, text: service }));
  for (const id of ["event-search", "event-from", "event-to", "event-service"])
    byId(id).addEventListener("input", () => {
      eventPage = 0;
      history();
    });
  byId("event-newer").addEventListener("click", turn(-1));
  byId("event-older").addEventListener("click", turn(1));
  onChange(({ alarms, names }) => {
    const station = JSON.stringify(state.plant.alarms || []);
    if (alarms || names === null || station !== shownStation) {
      shownStation = station;
      line();
      table();
      stationNote();
    }
    shelvingNote();
    byId("alarm-line").classList.toggle("stale", isStale("control_plc."));
    for (const one of elements(".of-station")) one.classList.toggle("stale", isStale("plant.station."));
    byId("alarm-table").classList.toggle("stale", isStale("control_plc."));
  });
  setInterval(history, 1500);
}

export function redrawAlarms() {
  line();
  table();
  history();
}
