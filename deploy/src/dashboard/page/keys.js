// The keys of the page.

import { byId } from "./page_state.js";

export function startKeys(acts) {
  addEventListener("keydown", (event) => {
    if (event.target.closest("input, select, dialog, tr") || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    // A focused button keeps its own use of the space bar.
    if (!acts[key] || (key === " " && event.target.closest("button"))) return;
    event.preventDefault();
    acts[key](event.shiftKey ? 10 : 1);
  });
  byId("help").onclick = () => byId("keys").showModal();
}
