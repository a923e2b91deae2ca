// The histogram of the batteries in the shown TTI.

import { shortNumber, tickText, ticks, ticksAbove } from "./axis.js";
import { addExport } from "./export.js";
import { symbolsOf } from "./map_symbols.js";
import { element, page, plural } from "./page_state.js";
import { STATES, colourBox, stateEntry } from "./states.js";
import { batteryShare, ink, prepareCanvas } from "./theme.js";
import { isVisible, onAppear } from "./visibility.js";

const BINS = 20;
// The states in a bar, from the bottom to the top, named as in the map.
const PARTS = ["out", "unpowered", "failed", "sensing", "reporting", "woken", "asleep"];
const nameOf = (state) => STATES[state].name;
const MARGIN = { left: 44, right: 10, top: 8, bottom: 20 };

export class Histogram {
  constructor(box) {
    this.canvas = element("canvas", { tabIndex: 0 });
    this.canvas.setAttribute("role", "img");
    this.readout = element("output", { className: "readout", hidden: true });
    this.legend = element("div", { className: "legend" });
    const header = element("header", {}, element("h3", {}, "Batteries", element("span", { className: "unit", textContent: " devices by level, in the shown TTI" })));
    box.append(element("figure", { id: "histogram", className: "chart" }, header, element("div", { className: "plot" }, this.canvas, this.readout), this.legend));
    addExport(header, { name: "batteries", title: "Batteries", canvas: () => this.canvas, rows: () => this.rows(), legend: this.legend });
    this.bin = null;
    onAppear(this.canvas, () => this.paint());
    const point = (event) => {
      const width = this.canvas.clientWidth - MARGIN.left - MARGIN.right;
      this.choose(Math.floor(((event.clientX - this.canvas.getBoundingClientRect().left - MARGIN.left) / width) * BINS));
    };
    this.canvas.addEventListener("pointermove", point);
    this.canvas.addEventListener("pointerdown", point);
    this.canvas.addEventListener("pointerleave", () => this.choose(null));
    this.canvas.addEventListener("blur", () => this.choose(null));
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step) return;
      this.choose((this.bin ?? (step > 0 ? -1 : BINS)) + step);
      event.preventDefault();
      event.stopPropagation();
    });
  }

  choose(bin) {
    this.bin = bin === null ? null : Math.max(0, Math.min(bin, BINS - 1));
    this.paint();
  }

  // Numbers of devices in equal steps up to the largest E_max, for each state.
  count(moment) {
    const counts = Object.fromEntries(PARTS.map((state) => [state, new Array(BINS).fill(0)])), { e_max } = page.run, most = Math.max(...e_max);
    symbolsOf(moment).forEach((state, device) => {
      counts[state][Math.min(BINS - 1, Math.floor(batteryShare(moment, device) * (e_max[device] / most) * BINS))] += 1;
    });
    return counts;
  }

  paint() {
    if (!page.moment?.states) this.legend.textContent = "no value yet";
    if (!page.moment?.states || !isVisible(this.canvas)) return;
    const { draw, width, height } = prepareCanvas(this.canvas);
    if (width < 60) return;
    const most = Math.max(...page.run.e_max), bottom = height - MARGIN.bottom, inner = width - MARGIN.left - MARGIN.right;
    this.counts = this.count(page.moment);
    this.bins = sumBins(this.counts);
    this.otherBins = page.other?.moment ? sumBins(this.count(page.other.moment)) : null;
    const marks = ticksAbove(Math.max(...this.bins, ...(this.otherBins ?? [])), height, true), tallest = marks.at(-1);
    const x = (bin) => MARGIN.left + (bin / BINS) * inner, y = (count) => bottom - (count / tallest) * (bottom - MARGIN.top);
    draw.font = "11px system-ui, sans-serif";
    draw.textAlign = "right";
    draw.textBaseline = "middle";
    for (const count of marks) {
      draw.strokeStyle = ink("--line");
      draw.beginPath();
      draw.moveTo(MARGIN.left, Math.round(y(count)) + 0.5);
      draw.lineTo(width - MARGIN.right, Math.round(y(count)) + 0.5);
      draw.stroke();
      draw.fillStyle = ink("--faint");
      draw.fillText(tickText(count), MARGIN.left - 6, y(count));
    }
    for (let bin = 0; bin < BINS; bin += 1) {
      draw.globalAlpha = this.bin === null || this.bin === bin ? 1 : 0.45;
      let below = 0;
      for (const state of PARTS) {
        const above = below + this.counts[state][bin];
        draw.fillStyle = ink(STATES[state].colour);
        draw.fillRect(x(bin) + 1, y(above), inner / BINS - 2, y(below) - y(above));
        below = above;
      }
    }
    draw.globalAlpha = 1;
    draw.strokeStyle = ink("--other");
    draw.lineWidth = 2;
    draw.beginPath();
    this.otherBins?.forEach((count, bin) => { draw.lineTo(x(bin), y(count)); draw.lineTo(x(bin + 1), y(count)); });
    draw.stroke();
    draw.fillStyle = ink("--faint");
    draw.textBaseline = "top";
    for (const level of ticks(0, most, 5)) {
      draw.textAlign = level === most ? "right" : "center";
      draw.fillText(tickText(level), level === most ? width - 4 : x((level / most) * BINS), bottom + 6);
    }
    draw.textAlign = "left";
    draw.fillText("units", 4, bottom + 6);
    this.paintReadout(x, most);
  }

  paintReadout(x, most) {
    const totals = PARTS.map((state) => [state, this.counts[state].reduce((sum, count) => sum + count, 0)]).filter(([, total]) => total);
    const text = totals.map(([state, total]) => `${nameOf(state)}: ${total}`).join(", ");
    const key = `${text} ${Boolean(this.otherBins)}`;
    if (this.legendKey !== key) {
      this.legendKey = key;
      this.legend.replaceChildren(...totals.map(([state, total]) => {
        const entry = stateEntry(state, `${nameOf(state)} `);
        entry.append(element("b", { textContent: total }));
        return entry;
      }), ...(this.otherBins ? [element("span", {}, colourBox("--other", "flat"), "other run, all states")] : []));
    }
    this.canvas.setAttribute("aria-label", `Devices by battery level: ${this.bins.join(", ")} in ${BINS} steps up to ${most} units; ${text}`);
    this.readout.hidden = this.bin === null;
    if (this.bin === null) return;
    const range = `${shortNumber((this.bin / BINS) * most)} to ${shortNumber(((this.bin + 1) / BINS) * most)} units`;
    const lines = this.otherBins ? [`this run ${this.bins[this.bin]}`, `other run ${this.otherBins[this.bin]}`] : [plural(this.bins[this.bin], "device")];
    this.readout.textContent = [range, ...lines].join("\n");
    const isRight = this.bin > BINS / 2;
    this.readout.style.left = isRight ? "auto" : `${x(this.bin + 1) + 4}px`;
    this.readout.style.right = isRight ? `${this.canvas.clientWidth - x(this.bin) + 4}px` : "auto";
  }

  rows() {
    const most = Math.max(...page.run.e_max), states = PARTS.map(nameOf);
    return [["from units", "to units", "devices", ...states], ...this.bins.map((count, bin) =>
      [(bin / BINS) * most, ((bin + 1) / BINS) * most, count, ...PARTS.map((state) => this.counts[state][bin])])];
  }
}

const sumBins = (counts) => Array.from({ length: BINS }, (_, bin) => PARTS.reduce((sum, state) => sum + counts[state][bin], 0));
