// Commands in two steps, preview and confirmation, with their results. Login.
import { byId, element, elements } from "./dom.js";
import { numberText, timeText } from "./numbers.js";
import { ask, isStale, onChange, send, signal, state } from "./store.js";
import { bindAll, inputBar } from "./values.js";

let onUser = () => {};

// What has come of a command: in the line above the alarms until the next one. It covers nothing. The list is the
// server's.
const WORDS = { applied: "applied: ", refused: "refused because ", uncertain: "UNCERTAIN: " };
function note(asked, what, detail) {
  say(what, asked, `${WORDS[what]}${detail}`);
  return refreshLog();
}

// All commands of all users of this page, and who was the last: for those who may operate.
const MOST_LOGGED = 200,
  OUTCOMES = { done: "applied", refused: "refused", uncertain: "uncertain" };
let logged = -1,
  told = "";
async function refreshLog() {
  if (!state.me.operates) return;
  logged = state.commands;
  let entries;
  try {
    ({ entries } = await ask("api/audit"));
  } catch {
    return;
  } // logged out meanwhile
  const commands = entries.filter((one) => one.what === "command").slice(0, MOST_LOGGED),
    last = commands.find((one) => one.outcome === "done");
  const utc = (one) => one.utc.replace("T", " ").replace("Z", "");
  byId("outcome-table")
    .querySelector("tbody")
    .replaceChildren(
      ...commands.map((one) =>
        element(
          "tr",
          {},
          element("td", { text: utc(one) }),
          element("td", { text: one.who }),
          element("td", { class: OUTCOMES[one.outcome], text: `${OUTCOMES[one.outcome]}: ${one.detail}` }),
        ),
      ),
    );
  byId("last-command").hidden = !last;
  if (!last) {
    told ||= "none";
    return;
  }
  byId("last-command").textContent = `Last command: ${last.who}, ${utc(last).slice(11, 19)} UTC: ${last.detail}`;
  // others' are seen at once
  if (told && last.who !== state.me.user && last.utc !== told) say("applied", `${last.who}`, last.detail);
  told = last.utc;
}

function say(what, asked, came) {
  const time = timeText(state.tick * state.catalog.tick_s);
  const line = byId("outcome-line");
  line.replaceChildren(
    element("span", { class: "label", text: time }),
    ` ${asked}: `,
    element("span", { class: what, text: came }),
  );
  line.className = what;
  line.title = `${asked}: ${came}`;
  line.hidden = false;
}

// Enter in a field prepares, as its button does; it never confirms.
// Asks for the number in a field; for nothing when it has none: an empty field is not a zero.
const enters = (field, button) =>
  field.addEventListener("keydown", (event) => {
    if (event.key === "Enter") {
      event.preventDefault();
      button.click();
    }
  });
function numberIn(field, then) {
  if (field.value === "") field.focus();
  else then(Number(field.value));
}

// `atOnce` is for what does not touch the process, such as acknowledging an alarm. One command at a time: another one
// waits until it is over. The same one again, as by a double click, and the second click of a double click on Confirm
// are no commands.
const TOO_SOON_MS = 400,
  MOST_WAITING = 8;
let current = null,
  closed = -Infinity;
const waiting = [];
/**
 * @param {{kind: string} & Record<string, any>} body
 * @param {boolean} atOnce
 * @returns {Promise<void>}
 */
export function command(body, atOnce = false) {
  const text = JSON.stringify(body);
  if (performance.now() < closed + TOO_SOON_MS || text === current || waiting.some((one) => one.text === text))
    return Promise.resolve();
  if (waiting.length >= MOST_WAITING) {
    say("refused", kindOf(body), `${MOST_WAITING} commands wait already; this one is not sent`);
    return Promise.resolve();
  }
  return new Promise((resolve) => {
    waiting.push({ body, atOnce, text, resolve });
    if (current === null) takeTurns();
    else say("waiting", kindOf(body), "waits until the command before it is over");
  });
}

async function takeTurns() {
  document.body.classList.add("commanding");
  while (waiting.length) {
    const { body, atOnce, text, resolve } = waiting.shift();
    current = text;
    try {
      await oneCommand(body, atOnce);
    } finally {
      current = null;
      resolve();
    }
  }
  setTimeout(
    () => {
      if (current === null) document.body.classList.remove("commanding");
    },
    Math.max(0, closed + TOO_SOON_MS - performance.now()),
  );
}

const kindOf = (body) => body.kind.replaceAll("_", " ");

async function oneCommand(body, atOnce) {
  let prepared;
  try {
    prepared = await send("api/commands", body);
  } catch (/** @type {any} */ error) {
    await failed(body.kind, error, "refused");
    return;
  }
  for (let asks = !atOnce, changed = ""; ; asks = true) {
    if (asks && !(await confirmed(prepared, changed))) {
      say("cancelled", prepared.text, "not confirmed; nothing was done");
      return;
    }
    try {
      const {
        asked,
        applied,
        refused_because: refused,
        uncertain_because: uncertain,
      } = await send(`api/commands/${prepared.token}`, {});
      await note(asked, uncertain ? "uncertain" : refused ? "refused" : "applied", uncertain || refused || applied);
      return;
    } catch (/** @type {any} */ error) {
      if (!error.preview) {
        await failed(prepared.text, error, "uncertain");
        return;
      }
      // what it was asked for has changed: it is asked again, as it is now
      say("refused", prepared.text, error.message);
      prepared = error.preview;
      changed = error.message;
    }
  }
}

// Without a status there was no answer: a prepared command is not done, the result of a confirmed one is unknown.
async function failed(asked, error, unanswered) {
  if (error.status) await note(asked, "refused", error.message);
  else await note(asked, unanswered, "the page's own server did not answer; check its effect before repeating it");
  if (error.status === 401) await refreshUser().catch(() => {});
}

// Enter does not confirm by itself: a held key or a double click must not confirm an unread question.
function confirmed({ text, now }, changed) {
  const dialog = byId("confirm");
  byId("confirm-changed").textContent = changed;
  byId("confirm-text").textContent = `${text}?`;
  byId("confirm-now").textContent = now ? `Now: ${now}.` : "";
  dialog.showModal();
  byId("confirm-no").focus();
  byId("confirm-yes").disabled = true;
  setTimeout(() => {
    byId("confirm-yes").disabled = false;
  }, TOO_SOON_MS);
  return new Promise((resolve) => {
    let answer = false;
    dialog.onclose = () => {
      closed = performance.now();
      resolve(answer);
    };
    byId("confirm-yes").onclick = () => {
      answer = true;
      dialog.close();
    };
    byId("confirm-no").onclick = () => dialog.close();
  });
}

// A field shows the present value until it is edited: sending it by mistake then changes nothing. Returns what
// makes it follow again.
function follow(field, name, others = []) {
  let touched = false;
  for (const one of [field, ...others])
    one.addEventListener("input", () => {
      touched = true;
    });
  onChange(() => {
    const value = state.values[name];
    if (touched || typeof value !== "number") return;
    const decimals = signal(name)?.decimals ?? null,
      text = decimals === null ? numberText(value, 7) : String(Number(value.toFixed(decimals)));
    for (const one of [field, ...others]) if (one.value !== text && one !== document.activeElement) one.value = text;
  });
  return (sent) => {
    if (Number(field.value) === sent) touched = false;
  };
}

async function playFile() {
  const field = byId("load-file"),
    [file] = field.files;
  if (!file) {
    note("load file", "refused", "no file is chosen");
    field.focus();
    return;
  }
  let content;
  try {
    content = await file.text();
  } catch {
    note("load file", "refused", `${file.name} cannot be read any more: choose it again`);
    return;
  }
  await command({ kind: "load_file", content });
}

function faceplates() {
  const holder = byId("faceplates");
  for (const one of state.catalog.process.inputs) {
    const input = one.name;
    const value = element("input", {
      type: "number",
      step: "any",
      id: `setpoint-${input}`,
      "aria-label": `New setpoint of ${input} in ${one.unit}`,
    });
    const button = element("button", {
      type: "button",
      text: "Write",
      onclick: () => numberIn(value, (wanted) => command({ kind: "setpoint", input, value: wanted })),
    });
    enters(value, button);
    const plate = element(
      "div",
      { class: "faceplate" },
      inputBar(one, input),
      element(
        "div",
        { class: "row" },
        element("span", { class: "label", text: "setpoint" }),
        element("span", { class: "value", "data-signal": `control_plc.operator.${one.register}` }),
        element("span", { class: "spacer" }),
        value,
        button,
      ),
    );
    holder.append(plate);
  }
  bindAll(holder);
}

// The pressed button shows the operator's mode.
function showMode() {
  const about = signal("control_plc.operator.mode"),
    asked = about?.words[state.values["control_plc.operator.mode"]];
  for (const one of elements("[data-mode]"))
    one.setAttribute("aria-pressed", String(Boolean(asked?.startsWith(one.dataset.mode)) && !isStale("control_plc.")));
}

async function refreshUser() {
  state.me = await ask("api/me");
  showUser();
}

export function showUser() {
  byId("login-open").hidden = Boolean(state.me.user);
  byId("logout").hidden = !state.me.user;
  byId("logout").textContent = `Log out ${state.me.user}`;
  for (const one of elements(".operate-only")) one.hidden = !state.me.operates;
  for (const one of elements(".view-only")) one.hidden = state.me.operates;
  for (const one of elements("#commands button:not(#login-open-2), #commands input, #commands select"))
    one.disabled = !state.me.operates;
  byId("outcome-line").hidden = !state.me.operates && !byId("outcome-line").title;
  byId("last-command").hidden = true;
  logged = -1;
  onUser();
}

function login() {
  const dialog = byId("login");
  byId("login-error").textContent = state.me.can_log_in
    ? ""
    : "No users are set up: python -m coldloop_hmi.users makes them.";
  dialog.showModal();
  byId("login-user").focus();
}

function loadPanel() {
  const { load } = state.catalog.process,
    slider = byId("load-slider"),
    number = byId("load-number");
  byId("load-panel").hidden = !load;
  if (!load) return;
  const { word, unit, span, bar } = load;
  byId("load-word").textContent = `${word[0].toUpperCase()}${word.slice(1)}`;
  byId("load-unit").textContent = unit;
  Object.assign(slider, { min: bar[0], max: bar[1], step: (bar[1] - bar[0]) / 400 });
  Object.assign(number, { min: span[0], max: span[1], ariaLabel: `New load in ${unit}` });
  slider.addEventListener("input", () => {
    number.value = slider.value;
  });
  number.addEventListener("input", () => {
    slider.value = number.value;
  });
  const followLoad = follow(number, "plant.load status.watts", [slider]);
  enters(number, byId("load-set"));
  byId("load-set").addEventListener("click", () =>
    numberIn(number, (watts) => command({ kind: "load", watts }).then(() => followLoad(watts))),
  );
  byId("load-play").addEventListener("click", playFile);
}

/** @param {() => void} userChanged */
export function initCommands(userChanged) {
  onUser = userChanged;
  faceplates();
  for (const one of elements("[data-command]"))
    one.addEventListener("click", () => command(JSON.parse(one.dataset.command)));
  loadPanel();
  const followFactor = follow(byId("factor"), "plant.pace.factor");
  enters(byId("factor"), byId("factor-set"));
  enters(byId("fault-value"), byId("fault-set"));
  byId("factor-set").addEventListener("click", () =>
    numberIn(byId("factor"), (factor) => command({ kind: "factor", factor }).then(() => followFactor(factor))),
  );
  byId("training").hidden = !state.catalog.training;
  for (const output of state.catalog.outputs) byId("fault-output").append(element("option", { text: output }));
  byId("fault-set").addEventListener("click", () =>
    numberIn(byId("fault-value"), (value) =>
      command({
        kind: "sensor_fault",
        output: byId("fault-output").value,
        fault: Number(byId("fault-kind").value),
        value,
      }),
    ),
  );
  for (const id of ["login-open", "login-open-2"]) byId(id).addEventListener("click", login);
  byId("login-cancel").addEventListener("click", () => byId("login").close());
  byId("logout").addEventListener("click", async () => {
    try {
      await send("api/logout", {});
      await refreshUser();
    } catch {
      note("log out", "refused", "the page's own server did not answer: still logged in");
    }
  });
  byId("login-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await send("api/login", { user: byId("login-user").value, password: byId("login-password").value });
      byId("login-password").value = "";
      byId("login").close();
      await refreshUser();
    } catch (/** @type {any} */ error) {
      byId("login-error").textContent = error.message;
    }
  });
  onChange(showMode);
  onChange(() => {
    if (state.me.operates && state.commands !== logged) refreshLog();
  });
  setInterval(() => refreshUser().catch(() => {}), 15000);
}
