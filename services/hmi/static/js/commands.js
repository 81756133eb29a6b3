// Commands in two steps: what would be done, then confirm; and what came of it. Login.
import { ask, element, send, state, timeText } from "./store.js";
import { bindAll } from "./values.js";

const byId = (id) => document.getElementById(id);
let onUser = () => {};

function note(asked, outcome, refused) {
  const body = byId("outcome-table").querySelector("tbody");
  body.prepend(element("tr", {}, element("td", { class: "number", text: timeText(state.tick * state.catalog.tick_s) }), element("td", { text: asked }), element("td", { class: refused ? "refused" : "", text: `${refused ? "refused because " : "applied: "}${outcome}` })));
  while (body.children.length > 50) body.lastChild.remove();
  const banner = byId("toast") || document.body.appendChild(element("div", { id: "toast", role: "status" }));
  banner.textContent = `${asked}: ${refused ? "refused because " : "applied: "}${outcome}`;
  banner.className = refused ? "refused" : "";
  clearTimeout(note.timer);
  note.timer = setTimeout(() => banner.remove(), 8000);
}

// `atOnce` is for what does not touch the process, such as acknowledging an alarm.
export async function command(body, atOnce = false) {
  let prepared;
  try { prepared = await send("api/commands", body); } catch (error) { note(body.kind, error.message, true); if (error.status === 401) await refreshUser(); return; }
  if (!atOnce && !(await confirmed(prepared.text))) return;
  try {
    const outcome = await send(`api/commands/${prepared.token}`, {});
    note(outcome.asked, outcome.refused_because || outcome.applied, Boolean(outcome.refused_because));
  } catch (error) { note(prepared.text, error.message, true); if (error.status === 401) await refreshUser(); }
}

function confirmed(text) {
  const dialog = byId("confirm");
  byId("confirm-text").textContent = `${text}?`;
  dialog.showModal();
  byId("confirm-yes").focus();
  return new Promise((resolve) => {
    const end = (answer) => () => { dialog.close(); resolve(answer); };
    byId("confirm-yes").onclick = end(true);
    byId("confirm-no").onclick = end(false);
    dialog.oncancel = () => resolve(false);
  });
}

function faceplates() {
  const holder = byId("faceplates");
  const units = { CV155: "%", NCR22_A: "W", CV156: "%" };
  for (const [input, field] of [["CV155", "cv155"], ["NCR22_A", "ncr22"], ["CV156", "cv156"]]) {
    const limits = `optimizer_plc.operating limits.input_low.${input} optimizer_plc.operating limits.input_high.${input}`;
    const value = element("input", { type: "number", step: "any", id: `setpoint-${input}`, "aria-label": `New setpoint of ${input} in ${units[input]}` });
    const button = element("button", { type: "button", text: "Write", onclick: () => { if (value.value) command({ kind: "setpoint", input, value: Number(value.value) }); else value.focus(); } });
    const plate = element("div", { class: "faceplate" },
      element("div", { class: "bar", "data-name": input, "data-signal": `control_plc.process.u.${input}`, "data-bounds": limits, "data-low": input === "NCR22_A" ? -10 : 15, "data-high": input === "NCR22_A" ? 160 : 65 }),
      element("div", { class: "row" }, element("span", { class: "label", text: "setpoint" }), element("span", { class: "value", "data-signal": `control_plc.operator.${field}` }), element("span", { class: "spacer" }), value, button));
    holder.append(plate);
  }
  bindAll(holder);
}

export async function refreshUser() {
  state.me = await ask("api/me");
  byId("login-open").hidden = Boolean(state.me.user);
  byId("logout").hidden = !state.me.user;
  byId("logout").textContent = `Log out ${state.me.user}`;
  for (const one of document.querySelectorAll(".operate-only")) one.hidden = !state.me.operates;
  for (const one of document.querySelectorAll(".view-only")) one.hidden = state.me.operates;
  for (const one of document.querySelectorAll("#commands button:not(#login-open-2), #commands input, #commands select")) one.disabled = !state.me.operates;
  onUser();
}

function login() {
  const dialog = byId("login");
  byId("login-error").textContent = state.me.can_log_in ? "" : "No users are set up: python -m hmi.users makes them.";
  dialog.showModal();
  byId("login-user").focus();
}

export function initCommands(userChanged) {
  onUser = userChanged;
  faceplates();
  for (const one of document.querySelectorAll("[data-command]")) one.addEventListener("click", () => command(JSON.parse(one.dataset.command)));
  const slider = byId("load-slider"), number = byId("load-number");
  slider.addEventListener("input", () => { number.value = slider.value; });
  number.addEventListener("input", () => { slider.value = number.value; });
  byId("load-set").addEventListener("click", () => command({ kind: "load", watts: Number(number.value) }));
  byId("load-play").addEventListener("click", async () => { const [file] = byId("load-file").files; if (file) command({ kind: "load_file", content: await file.text() }); });
  byId("factor-set").addEventListener("click", () => command({ kind: "factor", factor: Number(byId("factor").value) }));
  byId("training").hidden = !state.catalog.training;
  for (const output of state.catalog.outputs) byId("fault-output").append(element("option", { text: output }));
  byId("fault-set").addEventListener("click", () => command({ kind: "sensor_fault", output: byId("fault-output").value, fault: Number(byId("fault-kind").value), value: Number(byId("fault-value").value) }));
  for (const id of ["login-open", "login-open-2"]) byId(id).addEventListener("click", login);
  byId("login-cancel").addEventListener("click", () => byId("login").close());
  byId("logout").addEventListener("click", async () => { await send("api/logout", {}); await refreshUser(); });
  byId("login-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await send("api/login", { user: byId("login-user").value, password: byId("login-password").value });
      byId("login-password").value = "";
      byId("login").close();
      await refreshUser();
    } catch (error) { byId("login-error").textContent = error.message; }
  });
  setInterval(refreshUser, 15000);
}
