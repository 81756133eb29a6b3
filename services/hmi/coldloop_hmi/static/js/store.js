// What the server has sent, the clock for its age, and the listeners to its changes.
import { fixedText, numberText, timeText } from "./numbers.js";
import { isListed, qualityIn, worse } from "./quality.js";

/** @type {PageState} */
export const state = /** @type {any} */ ({
  catalog: null,
  me: null,
  values: {},
  services: {},
  stale: [],
  quality: {},
  commands: 0,
  alarms: [],
  update: null,
  plant: { kind: "" },
  deviation: "",
  tick: 0,
  heard: 0,
  refused: "",
});
/** @type {((what: Change) => void)[]} */
const listeners = [];
const SILENT_MS = 1500,
  GIVEN_UP_MS = 5000,
  SEND_MS = 20000;

/** @param {(what: Change) => void} listener */
export function onChange(listener) {
  listeners.push(listener);
}

// Changes are drawn once a frame: a slow browser takes all that has come and shows the newest, instead of each late.
/** @type {Change | null} */
let changed = null,
  isBuilt = false;
export function drawAll() {
  isBuilt = true;
  tell({ names: null, alarms: true, update: true });
}
/** @param {Change} what */
function tell({ names, alarms, update }) {
  if (!isBuilt) return;
  if (changed === null) {
    changed = { names: new Set(), alarms: false, update: false };
    if (document.hidden) setTimeout(draw);
    else requestAnimationFrame(draw);
  }
  changed.names = names === null || changed.names === null ? null : new Set([...changed.names, ...names]);
  changed.alarms ||= alarms;
  changed.update ||= update;
}
function draw() {
  const what = changed;
  if (!what) return;
  changed = null;
  if (state.heard) document.body.dataset.tick = String(state.tick);
  for (const listener of listeners) listener(what);
}

/** @param {Record<string, any>} message */
export function take(message) {
  const reset = message.whole;
  if (reset) state.values = {};
  Object.assign(state.values, message.values);
  Object.assign(state, {
    services: message.services,
    plant: message.plant,
    deviation: message.deviation,
    stale: message.stale,
    quality: message.quality,
    commands: message.commands,
    tick: message.tick,
    heard: performance.now(),
  });
  if ("alarms" in message) state.alarms = message.alarms;
  if ("update" in message) state.update = message.update;
  if ("replay" in message) state.replay = message.replay;
  answered();
  tell({
    names: reset ? null : new Set(Object.keys(message.values)),
    alarms: "alarms" in message,
    update: "update" in message,
  });
}

// The page itself is silent: nothing of what it shows is current.
export function pageIsSilent() {
  return performance.now() - state.heard > SILENT_MS;
}

/** @param {string} name */
export function isStale(name) {
  return pageIsSilent() || isListed(state.stale, name);
}
/** @param {string} name */
export function qualityOf(name) {
  return worse(qualityIn(state.quality, name), pageIsSilent() ? "stale" : "good");
}

/**
 * The title of the tab: what an operator has to know who looks at another one.
 * @param {{alarms: Alarm[], stale: boolean, mode: string}} now
 */
export function titleOf({ alarms, stale, mode }) {
  const active = alarms.filter((one) => one.active && ["unacknowledged", "acknowledged"].includes(one.state)).length;
  const parts = [
    stale ? "NOT CURRENT" : "",
    active ? `${active} alarm${active === 1 ? "" : "s"}` : "",
    !stale && mode !== "MPC" ? mode : "",
  ];
  return [...parts.filter(Boolean), "Coldloop"].join(" · ");
}

/**
 * @param {string} name
 * @returns {SignalAbout | null}
 */
export function signal(name) {
  return state.catalog.signals[name] || null;
}

// Why there is no stream: an answer that says so is the server's, such as an expired login.
async function why() {
  state.refused = await ask("api/state").then(
    () => "",
    (error) => (error.status ? `The page's own server refuses: ${error.message}` : ""),
  );
  answered();
}
/** @type {(value?: unknown) => void} */
let answered = () => {};
const answer = new Promise((resolve) => {
  answered = resolve;
});

// A connection that has gone silent, as after a server's loss of power, reports no error: it is closed. Ends with the
// first message, or an error.
export function connect() {
  let /** @type {any} */ source = null,
    begun = 0;
  const open = () => {
    begun = performance.now();
    source = new EventSource("api/stream");
    const own = source,
      again = () => {
        own.close();
        if (own === source) {
          source = null;
          setTimeout(open, 500);
        }
      };
    own.onmessage = (event) => take(JSON.parse(event.data));
    own.onerror = () => {
      again();
      why();
    };
    own.giveUp = again;
  };
  open();
  setInterval(() => {
    if (source && performance.now() - Math.max(begun, state.heard) > GIVEN_UP_MS) source.giveUp();
    tell({ names: new Set(), alarms: false, update: false });
  }, 250);
  return answer;
}

/**
 * @param {string} name
 * @param {string} [as]
 * @returns {string}
 */
export function valueText(name, as) {
  const value = state.values[name],
    about = signal(name);
  if (value === undefined || value === null) return "–";
  const tick = state.catalog.tick_s;
  if (as === "time") return timeText(value * tick);
  if (as === "ticks") return `${fixedText(value * tick, 2)} s`;
  if (as === "pace") return paceText(value);
  if (about && about.words[value] !== undefined)
    return as === "mode" ? about.words[value].toUpperCase() : about.words[value];
  if (about?.counts)
    return about.counts === "time"
      ? `${timeText(value * tick)} (tick ${value})`
      : `${fixedText(value * tick, 2)} s (${value} ticks)`;
  const text = signalText(value, about);
  return about?.unit ? `${text} ${about.unit}` : text;
}

/**
 * A value with the digits of its signal, without its unit.
 * @param {any} value
 * @param {SignalAbout | null} about
 * @returns {string}
 */
export function signalText(value, about) {
  if (typeof value !== "number" || !about) return String(value);
  return about.decimals !== null
    ? fixedText(value, about.decimals)
    : about.digits
      ? numberText(value, about.digits)
      : String(value);
}

/** @param {number} value */
function paceText(value) {
  const factor = numberText(value);
  if (!state.values["plant.pace.session"]) return "no session";
  if (!state.values["plant.pace.realtime"]) return "lock-step";
  return state.values["plant.pace.paused"] ? `paused (× ${factor})` : `× ${factor}`;
}

/**
 * @param {string} path
 * @returns {Promise<any>}
 */
export async function ask(path) {
  const answer = await fetch(path);
  const document_ = await answer.json();
  if (!answer.ok) throw Object.assign(new Error(document_.error || answer.statusText), { status: answer.status });
  return document_;
}

/**
 * @param {string} path
 * @param {object} body
 * @returns {Promise<any>}
 */
export async function send(path, body) {
  const answer = await fetch(path, {
    method: "POST",
    signal: AbortSignal.timeout(SEND_MS),
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  const document_ = await answer.json();
  if (!answer.ok)
    throw Object.assign(new Error(document_.error || answer.statusText), {
      status: answer.status,
      preview: document_.token ? document_ : null,
    });
  return document_;
}
