// The comparison with another run: the fields that differ and the first difference of each kind of message.

import { get } from "./api.js";
import { addExport } from "./export.js";
import { byId, element, page, plural } from "./page_state.js";
import { describeRun } from "./run_state.js";

let listed = "", found;

// The fields that differ, then the first differences of the messages.
const rows = () => [
  ["difference", "tti", "devices", "this run", "other run"],
  ...found.fields.map(([name, own, other]) => [name, "", "", own, other]),
  ...found.differences.map(({ kind, tti, devices, this: own, other }) => [kind, tti, devices.join(" "), own, other]),
];

export async function startCompare() {
  found = await get("api/compare");
  const { other, other_events: events, other_missed: missed } = found, { run } = page;
  page.other = { run: other, moment: null, points: [], events, missed };
  byId("other-figure").hidden = byId("compare").hidden = byId("this-caption").hidden = byId("curve-runs").hidden = false;
  document.querySelector("main").classList.add("comparing");
  // These panels show one run only.
  for (const title of ["events-title", "timeline-title", "traffic-title"]) byId(title).textContent += " of this run";
  byId("this-name").textContent = byId("compare-this").textContent = `this run: ${describeRun(run)}`;
  byId("other-name").textContent = byId("compare-other").textContent = `other run: ${describeRun(other)}`;
  addExport(byId("compare-title").parentElement, { name: "differences", title: "Two runs", rows });
}

export async function showCompare(onChooseTti) {
  found = await get("api/compare");
  Object.assign(page.other, { events: found.other_events, missed: found.other_missed });
  const text = JSON.stringify([found.fields, found.differences, found.compared]);
  if (text === listed) return;
  listed = text;
  byId("fields").textContent = found.fields.map(([name, own, other]) => `${name}: ${own}, other ${other}`).join(" · ");
  const count = (devices) => (devices.length ? `, of ${plural(devices.length, "device")}` : "");
  byId("differences").replaceChildren(...found.differences.map((difference, nth) => element("li", {},
    element("button", { textContent: `TTI ${difference.tti}`, onclick: () => onChooseTti(difference.tti) }),
    ` ${nth ? "then" : "first difference"}: ${difference.kind}${count(difference.devices)}`,
    element("span", { className: "this-run", textContent: `this: ${difference.this}` }),
    element("span", { className: "other-run", textContent: `other: ${difference.other}` }))));
  byId("compared").textContent = found.differences.length ? "" : `no difference in TTIs 0 to ${found.compared - 1}`;
}

// The same TTI of the other run, or null if that run has no such TTI.
export const otherMoment = async (tti) => (page.other ? get(`api/other/tti/${tti}`).catch(() => null) : null);
