// The comparison with another run: the fields that differ and the first difference of each kind of message.

import { get } from "./api.js";
import { byId, element, page } from "./page_state.js";

let listed = "";

export async function startCompare() {
  const { other } = await get("api/compare"), { run } = page;
  page.other = { run: other, moment: null, points: [] };
  byId("other-figure").hidden = byId("compare").hidden = byId("this-caption").hidden = byId("curve-runs").hidden = false;
  document.querySelector("main").classList.add("comparing");
  // These panels show one run only.
  for (const title of ["events-title", "timeline-title", "traffic-title"]) byId(title).textContent += " of this run";
  const name = (run, text) => `${text}: ${run.run} (${run.policy}, seed ${run.seed})`;
  byId("this-name").textContent = name(run, "this run");
  byId("other-name").textContent = name(other, "other run");
  byId("compare-this").textContent = name(run, "this run");
  byId("compare-other").textContent = name(other, "other run");
}

export async function showCompare(onChooseTti) {
  const found = await get("api/compare"), text = JSON.stringify([found.fields, found.differences, found.compared]);
  if (text === listed) return;
  listed = text;
  byId("fields").textContent = found.fields.map(([name, own, other]) => `${name}: ${own}, other ${other}`).join(" · ");
  const count = (devices) => (devices.length ? `, of ${devices.length} devices` : "");
  byId("differences").replaceChildren(...found.differences.map((difference, nth) => element("li", {},
    element("button", { textContent: `TTI ${difference.tti}`, onclick: () => onChooseTti(difference.tti) }),
    ` ${nth ? "then" : "first difference"}: ${difference.kind}${count(difference.devices)}`,
    element("span", { className: "this-run", textContent: `this: ${difference.this}` }),
    element("span", { className: "other-run", textContent: `other: ${difference.other}` }))));
  byId("compared").textContent = found.differences.length ? "" : `no difference in TTIs 0 to ${found.compared - 1}`;
}

// The same TTI of the other run, or null if that run has no such TTI.
export const otherMoment = async (tti) => (page.other ? get(`api/other/tti/${tti}`).catch(() => null) : null);
