// The curves over the run.

import { ttiText } from "./axis.js";
import { Chart } from "./chart.js";
import { byId, page, setText } from "./page_state.js";

const CHARTS = [
  { id: "p1", title: "Information P1", unit: "per α and TTI", series: [""], counted: true, value: (p) => [p.metrics[0]] },
  { id: "missed", title: "Missed events", unit: "%", series: [""], counted: true, value: (p) => [p.metrics[1]] },
  { id: "delay", title: "Detection delay", unit: "TTIs", series: [""], counted: true, value: (p) => [p.metrics[2]] },
  { id: "energy", title: "Energy", unit: "units per device and TTI", series: ["sensing", "sleep", "reports"], counted: true, value: (p) => p.metrics.slice(3, 6) },
  { id: "battery", title: "Battery", unit: "units", series: ["median", "5 %", "95 %"], value: ({ batteries: [low, median, high] }) => [median, low, high] },
  { id: "traffic", title: "Air traffic", unit: "bytes per TTI, logarithmic", series: ["control", "reports"], isLog: true, value: (p) => [p.control, p.uplink] },
];

export class Charts {
  constructor(box, onChoose) {
    this.charts = CHARTS.map((chart) => ({ ...chart, chart: new Chart(box, { ...chart, emptyText: "no value yet", onChoose }) }));
  }

  // Shows the points of the run and, in another colour, of the compared run.
  show() {
    const { now, run, other, points } = page;
    const isWarmingUp = now.next <= run.warm_up_end;
    setText(byId("curves-note"), isWarmingUp
      ? `information, missed events, delay and energy begin at TTI ${ttiText(run.warm_up_end)}, the end of the warm-up`
      : "up to each TTI; without the warm-up, except batteries and traffic");
    const end = Math.max(now.next - 1, other?.points.at(-1)?.tti ?? 0, 1);
    for (const { chart, value, counted } of this.charts) {
      const runs = [{ name: "this run", colour: "--accent", points: points.map((p) => [p.tti, value(p)]) }];
      if (other) runs.push({ name: "other run", colour: "--other", points: other.points.map((p) => [p.tti, value(p)]) });
      chart.figure.hidden = Boolean(counted && isWarmingUp);
      chart.show(runs, 0, end, page.follows ? null : page.tti);
    }
  }

  // Moves the rule of the shown TTI.
  moveRule() {
    for (const { chart } of this.charts) {
      const tti = page.follows ? null : page.tti;
      if (chart.tti === tti) continue;
      chart.tti = tti;
      chart.paint();
    }
  }
}
