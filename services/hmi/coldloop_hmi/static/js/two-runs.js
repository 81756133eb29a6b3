// Two replays side by side: one bar for both.
document.documentElement.dataset.theme =
  localStorage.getItem("theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
/** @type {(id: string) => PageElement} */
const byId = (id) => /** @type {any} */ (document.getElementById(id));
const send = (run, wish) =>
  fetch(`run/${run}/api/replay`, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(wish),
  });
const both = (wish) => Promise.all([send(1, wish), send(2, wish)]);

byId("play").addEventListener("click", () => both({ playing: true, speed: Number(byId("speed").value) }));
byId("pause").addEventListener("click", () => both({ playing: false }));
byId("speed").addEventListener("change", () => both({ speed: Number(byId("speed").value) }));
byId("align").addEventListener("click", async () => {
  const first = await (await fetch("run/1/api/replay")).json();
  await send(2, { tick: first.tick });
});
byId("view").addEventListener("change", () => {
  for (const run of ["run-1", "run-2"]) byId(run).contentWindow.location.hash = byId("view").value;
});
