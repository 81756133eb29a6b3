// The bar of a replay: play, speed, position.
import { byId } from "./dom.js";
import { timeText } from "./numbers.js";
import { onChange, send, state } from "./store.js";

export function initReplay() {
  if (!state.catalog.replay) return;
  const position = byId("replay-position");
  byId("replay").hidden = false;
  document.body.classList.add("replaying");
  const ask = (body) => send("api/replay", body).catch(() => {});
  byId("replay-play").addEventListener("click", () => ask({ playing: !state.replay?.playing }));
  byId("replay-speed").addEventListener("change", () => ask({ speed: Number(byId("replay-speed").value) }));
  position.addEventListener("change", () => ask({ tick: Number(position.value) }));
  position.addEventListener("input", () => {
    position.dataset.held = "1";
    byId("replay-time").textContent = timeText(Number(position.value) * state.catalog.tick_s);
  });
  position.addEventListener("change", () => {
    delete position.dataset.held;
  });
  onChange(() => {
    if (!state.replay) return;
    byId("replay-name").textContent = state.replay.name;
    byId("replay-play").textContent = state.replay.playing ? "❚❚ Pause" : "▶ Play";
    position.max = state.replay.last_tick;
    if (position.dataset.held) return;
    position.value = state.tick;
    byId("replay-time").textContent =
      `${timeText(state.tick * state.catalog.tick_s)} of ${timeText(state.replay.last_tick * state.catalog.tick_s)}`;
  });
}
