// The chosen device: its battery and states around the shown TTI, and its ledger.

import { get } from "./api.js";
import { significant, ttiText } from "./axis.js";
import { Chart } from "./chart.js";
import { showActions } from "./device_actions.js";
import { addExport } from "./export.js";
import { symbolsOf } from "./map_symbols.js";
import { byId, element, page } from "./page_state.js";
import { STATES, bandEntry, nameOfCode } from "./states.js";
import { ink } from "./theme.js";
import { deviceFlags, stateOf } from "./timeline_data.js";

const TTIS_BEFORE = 300, TTIS_AFTER = 100;

let chart, ledger = [], requested = 0;

// Paints the states as a band at the foot of the chart.
function paintStates(draw, { from, band }, bottom) {
  band.forEach((state, nth) => {
    if (!state) return;
    const x = Math.round(chart.x(from + nth)), height = { unpowered: 5, out: 3 }[state] ?? 10;
    draw.fillStyle = ink(STATES[state].colour);
    draw.fillRect(x, bottom - height, Math.max(Math.round(chart.x(from + nth + 1)) - x, 1), height);
  });
}

function ledgerRows(totals) {
  return [
    ["initial", significant(totals.initial)], ["+ harvested", significant(totals.harvested)], ["− sensing", significant(totals.sensing)], ["− sleep", significant(totals.sleep)],
    ["− reports", significant(totals.report)], ["− overflow", significant(totals.overflow)], ["= battery", significant(totals.battery)],
    ["TTIs of δ = 1", totals.sensing_ttis], ["of these without energy", totals.failed_ttis], ["TTIs unpowered", totals.unpowered_ttis],
  ];
}

export async function showDevice() {
  const { device, run, now, tti } = page;
  byId("one").hidden = byId("chosen").hidden = device < 0;
  byId("device").value = device < 0 ? "" : device;
  if (device < 0 || now.next <= now.first) return;
  const own = ++requested, from = Math.max(now.first, tti - TTIS_BEFORE), end = Math.min(now.next, tti + TTIS_AFTER);
  const [history, flags] = await Promise.all([get(`api/device/${device}?from=${from}&end=${end}&at=${tti}`), deviceFlags(device, from, end)]);
  if (own !== requested) return;
  const cluster = run.groups ? ` · cluster ${run.groups[device]}` : "", deviceClass = run.classes.length > 1 ? ` · class ${run.classes[run.device_classes[device]]}` : "";
  // Only a live run has hosts.
  const host = page.clock?.hosts.find(({ first, last }) => first <= device && device <= last);
  byId("one-title").textContent = `Device ${device}`;
  // The codes do not tell why a device reports; the shown moment does.
  const code = history.states[tti - history.from], { moment } = page;
  const state = code === "3" && moment?.states && moment.tti === tti ? STATES[symbolsOf(moment)[device]].name : nameOfCode(code);
  byId("one-facts").textContent = `${state}${cluster}${deviceClass} · at (${run.positions[device].x.toFixed(1)}, ${run.positions[device].y.toFixed(1)}) m${host ? ` · host ${host.host}, ${host.name}` : ""}`;
  byId("chosen-facts").textContent = `Device ${device}: ${state}${cluster}${deviceClass}`;
  byId("show-one").onclick = () => byId("one").scrollIntoView();
  if (run.controls) showActions(now.states[device]);
  if (!chart) {
    const rows = () => [["device", "entry", "value"], ...ledger];
    addExport(byId("ledger-title").parentElement, { name: "ledger", title: "Energy ledger", rows });
  }
  chart ??= new Chart(byId("history"), {
    id: "device", title: "Battery and states", unit: "units", series: [""], emptyText: "no history", onChoose: page.onChooseTti, decorate: (draw, bottom) => paintStates(draw, chart.history, bottom),
  });
  // TTIs that have left the memory have no flags.
  chart.history = { from, band: Array.from(flags, (of) => (of ? stateOf(of) : null)) };
  const seen = Object.keys(STATES).filter((name) => chart.history.band.includes(name));
  byId("state-legend").replaceChildren(...seen.map(bandEntry));
  chart.most = run.e_max[device];
  chart.show([{ name: `device ${device}`, colour: "--ink", points: history.batteries.map((battery, nth) => [history.from + nth, [battery]]) }], history.from, history.from + history.batteries.length - 1, tti);
  ledger = [];
  if (!history.totals) {
    byId("ledger").replaceChildren();
    return;
  }
  byId("ledger-title").textContent = `Energy since TTI 0, up to TTI ${ttiText(tti)}`;
  const rows = ledgerRows(history.totals);
  ledger = rows.map((row) => [device, ...row]);
  byId("ledger").replaceChildren(...rows.flatMap(([name, value]) => [element("dt", { textContent: name }), element("dd", { textContent: value })]));
}
