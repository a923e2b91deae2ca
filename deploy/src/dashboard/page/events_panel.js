// The last events of the run, and the jumps to missed events.

import { get } from "./api.js";
import { addExport } from "./export.js";
import { byId, element, page, showNote } from "./page_state.js";

let listed = "";

// Shows the events that ended last, up to the shown TTI.
export function showLastEvents(onChooseTti) {
  // Unchanged entries stay in place: a click could miss an entry that is being replaced.
  const { last_events: events } = page.moment, text = JSON.stringify(events);
  if (text === listed) return;
  listed = text;
  byId("ticker").replaceChildren(...events.map(({ tti, text, missed, who }) => element("li", { className: missed ? "missed" : "" },
    element("button", { textContent: `TTI ${tti}`, onclick: () => onChooseTti(tti) }), ` ${text}${who.length ? ` (${who.join("; ")})` : ""}`)));
  byId("no-events").hidden = events.length > 0;
}

// Shows the first TTI of the next missed event, or of the previous one.
export async function showMiss(isNext, onChooseTti) {
  const miss = await get(`api/miss?${isNext ? "after" : "before"}=${page.tti}`);
  if (miss) await onChooseTti(miss.start);
  const place = miss?.start < page.run.warm_up_end ? ", in the warm-up, not counted" : "";
  showNote(miss ? `missed event ${miss.event}${place}: ${miss.cause}` : `no missed event ${isNext ? "after" : "before"} TTI ${page.tti}`);
}

export function startEvents() {
  addExport(byId("events-title").parentElement, {
    name: "events", title: "Events",
    rows: async () => {
      const names = ["event", "start", "last", "delay", "cause", "reports", "wake_ups", "information", "counted"];
      const events = await get(`api/events?from=${page.now.first}&end=${page.now.next}`);
      return [[...names, "x_m", "y_m"], ...events.map((event) => [...names.map((name) => event[name] ?? ""), event.epicentre.x, event.epicentre.y])];
    },
  });
}
