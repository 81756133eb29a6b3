// Every register of every service, made from the catalogue.
import { byId, element, elements } from "./dom.js";
import { state } from "./store.js";
import { bindAll } from "./values.js";

export function initDetail() {
  const holder = byId("detail-tables");
  const blocks = new Map();
  for (const [name, about] of Object.entries(state.catalog.signals)) {
    const key = `${about.service}: ${about.block}`;
    if (!blocks.has(key)) blocks.set(key, []);
    blocks.get(key).push([name, about]);
  }
  for (const [key, rows] of blocks) {
    const body = element(
      "tbody",
      {},
      ...rows.map(([name, about]) =>
        element(
          "tr",
          { "data-search": `${name} ${about.description}`.toLowerCase() },
          element("td", { class: "number", text: about.address }),
          element("td", { text: about.label }),
          element("td", { class: "value", "data-signal": name }),
          element("td", { class: "description", text: about.description }),
          element("td", { class: "minor", text: about.writer || "read-only" }),
        ),
      ),
    );
    holder.append(element("details", {}, element("summary", { text: key }), element("table", {}, body)));
  }
  bindAll(holder);
  byId("detail-search").addEventListener("input", () => {
    const wanted = byId("detail-search").value.toLowerCase();
    for (const block of holder.children) {
      let any = false;
      for (const row of elements("tr", block)) {
        row.hidden = Boolean(wanted) && !row.dataset.search.includes(wanted);
        any ||= !row.hidden;
      }
      block.hidden = !any;
      block.open = Boolean(wanted) && any;
    }
  });
}
