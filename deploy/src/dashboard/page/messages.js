// The table of messages around the shown TTI, or of a search.

import { get } from "./api.js";
import { addExport } from "./export.js";
import { byId, element, page, setText } from "./page_state.js";

// TTIs before the shown one whose messages are listed too: the grant of a quiet TTI can be that old.
const TTIS_BEFORE = 20;
const COLUMNS = ["tti", "plane", "kind", "whose", "bytes", "text"];

let rows = [], requested = 0;

export async function showMessages() {
  const form = byId("filters"), query = new URLSearchParams();
  for (const name of ["plane", "kind", "device", "cluster", "state"]) if (form[name].value) query.set(name, form[name].value);
  if (!form.emulation.checked) query.set("hide_emu", "true");
  if (!form.quiet.checked) query.set("hide_quiet", "true");
  const isHere = form.here.checked;
  const since = isHere ? Math.max(page.tti - TTIS_BEFORE, 0) : form.since.value, until = isHere ? page.tti : form.until.value;
  if (since !== "") query.set("since", since);
  if (until !== "") query.set("until", until);
  const own = ++requested;
  const found = await get(`api/messages?${query}`).catch((error) => {
    byId("refused").textContent = error.message;
    return null;
  });
  if (!found || own !== requested) return;
  // The shown TTI comes first; within a TTI, the order of the messages stays.
  rows = isHere ? found.sort((a, b) => b.tti - a.tti || a.id - b.id) : found;
  setText(byId("refused"), rows.length ? "" : isHere ? `no such message in TTIs ${since} to ${until}` : "no messages match");
  // A run that is followed has moved on meanwhile: its latest messages count as shown.
  const shown = page.follows && rows.length ? rows[0].tti : page.tti;
  const lines = rows.map((row) => {
    const line = element("tr", { tabIndex: -1 }, ...COLUMNS.map((name) => element("td", { textContent: row[name] })));
    line.dataset.id = row.id;
    line.dataset.plane = row.plane;
    if (row.tti === shown) line.className = "shown";
    return line;
  });
  if (isHere && rows.length && rows[0].tti !== shown) {
    lines.unshift(element("tr", { className: "gap" }, element("td", { colSpan: COLUMNS.length, textContent: `no message in TTI ${page.tti}; earlier ones follow` })));
  }
  if (rows.length) lines.at(-rows.length).tabIndex = 0;
  byId("messages").tBodies[0].replaceChildren(...lines);
}

async function showMessage(id) {
  const { message, hex } = await get(`api/message/${id}`);
  byId("decoded").textContent = JSON.stringify(message, null, 2);
  byId("hex").textContent = hex.replace(/(..)/g, "$1 ").replace(/(.{48})/g, "$1\n");
  byId("detail").showModal();
}

export function startMessages(report) {
  const form = byId("filters"), body = byId("messages").tBodies[0];
  form.onsubmit = (event) => {
    event.preventDefault();
    report(showMessages());
  };
  form.emulation.onchange = form.quiet.onchange = form.here.onchange = form.plane.onchange = () => form.requestSubmit();
  form.cluster.closest("label").hidden = !page.run.groups;
  // Both fields mean a search in other TTIs than the shown one.
  form.since.oninput = form.until.oninput = () => { form.here.checked = false; };
  const open = (event) => {
    const line = event.target.closest("tr[data-id]");
    if (line) report(showMessage(line.dataset.id));
  };
  body.addEventListener("click", open);
  // One row has a tab stop; the arrows choose another.
  body.addEventListener("keydown", (event) => {
    const line = event.target.closest("tr"), next = { ArrowDown: line.nextSibling, ArrowUp: line.previousSibling }[event.key];
    if (event.key === "Enter") open(event);
    if (!next) return;
    line.tabIndex = -1;
    next.tabIndex = 0;
    next.focus();
    event.preventDefault();
  });
  addExport(byId("traffic-title").parentElement, { name: "messages", title: "Messages", rows: () => [COLUMNS, ...rows.map((row) => COLUMNS.map((name) => row[name]))] });
}
