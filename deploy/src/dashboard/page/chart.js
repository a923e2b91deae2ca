// One chart: lines over TTIs with axes, a legend, and a readout for mouse, touch and keyboard.

import { decades, shortNumber, tickText, ticks, ticksAbove, ttiText } from "./axis.js";
import { addExport } from "./export.js";
import { element } from "./page_state.js";
import { hiddenCanvas, ink, outlinedText, prepareCanvas } from "./theme.js";
import { isVisible, onAppear, sizeOf } from "./visibility.js";

const DASHES = [[], [7, 3], [2, 2.5]];
const MARGIN = { left: 44, right: 10, top: 8, bottom: 20 };
// Values above this quantile of their line are a peak if the highest one is `PEAK` times as high. Few values have no peak.
const USUAL = 0.95, PEAK = 3, FEW = 40;

// The value up to which the axis reaches: the highest one, or only the usual ones of every line if a short peak would flatten them.
function axisReach(lines, canCut) {
  const sorted = lines.map((values) => Float64Array.from(values).sort());
  const most = Math.max(0, ...sorted.map((values) => values.at(-1) ?? 0));
  const usual = Math.max(0, ...sorted.map((values) => (values.length < FEW ? values.at(-1) : values[Math.floor(USUAL * (values.length - 1))]) ?? 0));
  const hasPeak = canCut && usual > 0 && most > PEAK * usual;
  return { reach: hasPeak ? 1.5 * usual : most, peak: hasPeak ? most : null };
}

export class Chart {
  // `series` has a name for each line. `isLog` keeps usual values apart below a high peak, such as the first plan.
  // `onChoose` receives the TTI of a click. `decorate` paints below the lines.
  constructor(box, { id, title, unit, series, isLog, emptyText, onChoose, decorate }) {
    Object.assign(this, { title, unit, series, isLog, emptyText, onChoose, decorate, runs: [], start: 0, end: 1, tti: null, pointer: null });
    this.legend = element("div", { className: "legend" });
    this.canvas = element("canvas", { tabIndex: 0 });
    this.canvas.setAttribute("role", "img");
    this.readout = element("output", { className: "readout", hidden: true });
    this.note = element("p", { className: "note", hidden: true });
    const heading = element("h3", {}, title, element("span", { className: "unit", textContent: ` ${unit}` }));
    const plot = element("div", { className: "plot" }, this.canvas, this.readout, this.note);
    this.figure = element("figure", { id: `chart-${id}`, className: "chart" }, element("header", {}, heading), plot, this.legend);
    box.append(this.figure);
    addExport(this.figure.querySelector("header"), { name: id, title: `${title}, ${unit}`, canvas: () => this.picture(), rows: () => this.rows() });
    this.listen();
    onAppear(this.canvas, () => this.paint());
  }

  listen() {
    const { canvas } = this;
    const follow = (event) => this.point(event.clientX - canvas.getBoundingClientRect().left);
    canvas.addEventListener("pointermove", follow);
    canvas.addEventListener("pointerdown", follow);
    canvas.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && this.point(null));
    canvas.addEventListener("blur", () => this.point(null));
    canvas.addEventListener("click", (event) => {
      const tti = this.ttiAt(event.clientX - canvas.getBoundingClientRect().left);
      this.onChoose(Math.round(tti));
    });
    canvas.addEventListener("keydown", (event) => {
      const points = this.runs[0]?.points ?? [];
      const at = this.pointer === null ? points.length - 1 : this.nearest(points, this.pointer);
      const step = event.shiftKey ? 10 : 1;
      const target = { ArrowLeft: at - step, ArrowRight: at + step, Home: 0, End: points.length - 1 }[event.key];
      if (event.key === "Escape") this.point(null);
      else if (event.key === "Enter" && this.pointer !== null) this.onChoose(Math.round(this.pointer));
      else if (target !== undefined && points.length) {
        this.pointer = points[Math.max(0, Math.min(target, points.length - 1))][0];
        this.paint();
      } else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // Each run has a name, a colour of the style sheet, and points: a TTI and a value for each line.
  show(runs, start, end, tti) {
    Object.assign(this, { runs, start, end: Math.max(end, start + 1), tti, ground: null });
    this.paint();
  }

  point(x) {
    this.pointer = x === null ? null : Math.max(this.start, Math.min(this.ttiAt(x), this.end));
    this.paint();
  }

  get width() {
    return sizeOf(this.canvas).width - MARGIN.left - MARGIN.right;
  }

  ttiAt(x) {
    return this.start + ((x - MARGIN.left) / this.width) * (this.end - this.start);
  }

  x(tti) {
    return MARGIN.left + ((tti - this.start) / (this.end - this.start)) * this.width;
  }

  nearest(points, tti) {
    let low = 0, high = points.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (points[middle][0] <= tti) low = middle;
      else high = middle;
    }
    return high > 0 && Math.abs(points[high][0] - tti) < Math.abs(points[low][0] - tti) ? high : low;
  }

  // The curves and the axes, which change less often than the pointer.
  paintGround(width, height) {
    const { canvas, draw } = hiddenCanvas(width, height);
    const lines = this.runs.flatMap(({ points }) => this.series.map((_, nth) => points.map(([, all]) => all[nth]).filter((value) => value !== null && value !== undefined)));
    const hasValues = lines.some((values) => values.length), bottom = height - MARGIN.bottom;
    const { reach, peak } = this.most ? { reach: this.most, peak: null } : axisReach(lines, !this.isLog);
    const marks = this.isLog && reach >= 10 ? decades(reach) : ticksAbove(reach, height), end = marks.at(-1);
    const size = this.isLog ? Math.log1p : (value) => value;
    const y = (value) => bottom - (size(value) / size(end)) * (bottom - MARGIN.top);
    draw.font = "11px system-ui, sans-serif";
    draw.lineWidth = 1;
    draw.textBaseline = "middle";
    draw.textAlign = "right";
    for (const value of hasValues ? marks : [0]) {
      draw.strokeStyle = ink("--line");
      draw.beginPath();
      draw.moveTo(MARGIN.left, Math.round(y(value)) + 0.5);
      draw.lineTo(width - MARGIN.right, Math.round(y(value)) + 0.5);
      draw.stroke();
      draw.fillStyle = ink("--faint");
      draw.fillText(tickText(value), MARGIN.left - 6, y(value));
    }
    this.decorate?.(draw, bottom);
    this.paintTtis(draw, width, bottom);
    draw.save();
    draw.beginPath();
    draw.rect(MARGIN.left, MARGIN.top - 4, width - MARGIN.left, bottom + 5 - MARGIN.top);
    draw.clip();
    for (const { points, colour } of this.runs) {
      draw.strokeStyle = ink(colour);
      draw.lineWidth = 1.7;
      draw.lineJoin = "round";
      this.series.forEach((_, nth) => {
        draw.beginPath();
        draw.setLineDash(DASHES[nth]);
        let isDown = false;
        for (const [tti, all] of points) {
          const value = all[nth];
          const isKnown = value !== null && value !== undefined;
          if (isKnown) draw[isDown ? "lineTo" : "moveTo"](this.x(tti), y(value));
          isDown = isKnown;
        }
        draw.stroke();
      });
    }
    draw.restore();
    if (peak !== null) this.paintPeak(draw, width, peak);
    this.y = y;
    return { canvas, hasValues };
  }

  // The value of a peak that the axis cuts off.
  paintPeak(draw, width, peak) {
    const [tti] = this.runs.flatMap(({ points }) => points).find(([, all]) => all.includes(peak)), x = this.x(tti), isRight = x > width / 2;
    draw.textAlign = isRight ? "right" : "left";
    draw.textBaseline = "top";
    outlinedText(draw, isRight ? `${shortNumber(peak)} ▲` : `▲ ${shortNumber(peak)}`, x + (isRight ? 4 : -4), MARGIN.top - 3);
  }

  paintTtis(draw, width, bottom) {
    draw.textBaseline = "top";
    draw.fillStyle = draw.strokeStyle = ink("--faint");
    draw.lineWidth = 1;
    draw.beginPath();
    draw.moveTo(MARGIN.left, bottom + 0.5);
    draw.lineTo(width - MARGIN.right, bottom + 0.5);
    // The first TTI has at least the digits of a tick.
    const name = draw.measureText("TTI").width + 10;
    const spacing = Math.max(50, draw.measureText(tickText(this.start)).width + 16);
    for (const tti of ticks(this.start, this.end, Math.max(2, Math.floor(width / spacing)), true)) {
      const x = Math.round(this.x(tti)) + 0.5;
      draw.moveTo(x, bottom);
      draw.lineTo(x, bottom + 4);
      const text = tickText(tti), half = draw.measureText(text).width / 2;
      draw.textAlign = "center";
      draw.fillText(text, Math.max(name + half, Math.min(x, width - half)), bottom + 6);
    }
    draw.stroke();
    draw.textAlign = "left";
    draw.fillText("TTI", 4, bottom + 6);
  }

  paint() {
    if (!isVisible(this.canvas)) return;
    const { draw, width, height } = prepareCanvas(this.canvas);
    if (width < 60) return;
    const key = [width, height, devicePixelRatio, ink("--line")].join();
    if (this.ground?.key !== key) this.ground = { ...this.paintGround(width, height), key };
    draw.drawImage(this.ground.canvas, 0, 0, width, height);
    if (this.tti !== null && this.ground.hasValues) this.paintRule(draw, height, this.tti, "--faint", []);
    this.note.hidden = this.ground.hasValues;
    this.note.textContent = this.emptyText;
    this.paintReadout(draw, height);
  }

  paintRule(draw, height, tti, colour, dash) {
    if (tti < this.start || tti > this.end) return;
    draw.strokeStyle = ink(colour);
    draw.lineWidth = 1;
    draw.setLineDash(dash);
    draw.beginPath();
    draw.moveTo(Math.round(this.x(tti)) + 0.5, MARGIN.top);
    draw.lineTo(Math.round(this.x(tti)) + 0.5, height - MARGIN.bottom);
    draw.stroke();
    draw.setLineDash([]);
  }

  // The values nearest to `tti`, or the latest ones, of each run.
  valuesAt(tti) {
    return this.runs.map((run) => {
      const point = run.points.length ? run.points[tti === null ? run.points.length - 1 : this.nearest(run.points, tti)] : null;
      return { ...run, tti: point?.[0], values: point?.[1] ?? [] };
    });
  }

  paintReadout(draw, height) {
    const isPointing = this.pointer !== null && this.ground.hasValues;
    const found = this.valuesAt(isPointing ? this.pointer : this.tti);
    this.showLegend(found);
    this.readout.hidden = !isPointing;
    if (!isPointing) return;
    const tti = found[0].tti ?? this.pointer;
    this.paintRule(draw, height, tti, "--ink", [3, 3]);
    for (const { values, colour } of found) {
      for (const value of values.filter((value) => value !== null && value !== undefined)) {
        draw.beginPath();
        draw.arc(this.x(tti), Math.max(this.y(value), MARGIN.top), 3, 0, 2 * Math.PI);
        draw.fillStyle = ink(colour);
        draw.fill();
      }
    }
    const lines = found.flatMap(({ name, values }) => this.series.map((line, nth) =>
      `${[this.runs.length > 1 ? name : "", line].filter(Boolean).join(" ")} ${shortNumber(values[nth])}`.trim()));
    this.readout.textContent = [`TTI ${ttiText(Math.round(tti))}`, ...lines].join("\n");
    const { width } = sizeOf(this.canvas), isRight = this.x(tti) > width / 2;
    this.readout.style.left = isRight ? "auto" : `${this.x(tti) + 8}px`;
    this.readout.style.right = isRight ? `${width - this.x(tti) + 8}px` : "auto";
  }

  // Names of lines with their dash patterns and the values of each run, in its colour.
  showLegend(found) {
    const text = this.series.map((line, nth) => `${line} ${found.map(({ name, values }) => `${found.length > 1 ? name : ""} ${shortNumber(values[nth])}`).join(", ")}`).join("; ");
    const hasValues = found.some(({ values }) => values.some((value) => value !== null && value !== undefined));
    const place = `TTI ${ttiText(found[0]?.tti ?? 0)}`, key = text + place + ink("--line");
    if (this.legendKey === key) return;
    this.legendKey = key;
    this.canvas.setAttribute("aria-label", `${this.title}, ${this.unit}: ${text}`);
    this.legend.replaceChildren(...(hasValues ? this.series : []).map((line, nth) => element("span", {}, ...(line ? [swatch(DASHES[nth]), line] : [place]), ...found.map(({ colour, values }) => {
      const value = element("b", { textContent: shortNumber(values[nth]) });
      if (found.length > 1) value.style.color = ink(colour);
      return value;
    }))));
  }

  // A copy of the chart with its legend, for a file: a line for the runs and one for the curves.
  picture() {
    const hasTwoRuns = this.runs.length > 1, line = 22;
    const { width, height } = sizeOf(this.canvas), { canvas, draw } = hiddenCanvas(width, height + (hasTwoRuns ? 2 : 1) * line);
    draw.drawImage(this.canvas, 0, 0, width, height);
    draw.font = "12px system-ui, sans-serif";
    draw.textBaseline = "middle";
    let x = 8, y = height + line / 2;
    const write = (text, colour) => {
      draw.fillStyle = ink(colour);
      draw.fillText(text, x, y);
      x += draw.measureText(text).width + 14;
    };
    if (hasTwoRuns) {
      for (const { name, colour } of this.runs) write(name, colour);
      [x, y] = [8, y + line];
    }
    this.series.forEach((name, nth) => {
      if (!name) return;
      draw.strokeStyle = ink("--ink");
      draw.setLineDash(DASHES[nth]);
      draw.beginPath();
      draw.moveTo(x, y);
      draw.lineTo(x + 22, y);
      draw.stroke();
      x += 27;
      write(name, "--ink");
    });
    return canvas;
  }

  rows() {
    const header = ["tti", ...this.runs.flatMap(({ name }) => this.series.map((line) => [this.runs.length > 1 ? name : "", line || this.title].filter(Boolean).join(" ")))];
    const byTti = new Map();
    this.runs.forEach(({ points }, run) => points.forEach(([tti, values]) => {
      const row = byTti.get(tti) ?? new Array(header.length - 1).fill("");
      values.forEach((value, nth) => { row[run * this.series.length + nth] = value ?? ""; });
      byTti.set(tti, row);
    }));
    return [header, ...[...byTti].sort(([a], [b]) => a - b).map(([tti, row]) => [tti, ...row])];
  }
}

// A short line with a dash pattern, for legends.
function swatch(dash) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 22 8");
  svg.setAttribute("class", "swatch");
  svg.setAttribute("aria-hidden", "true");
  const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
  line.setAttribute("d", "M0 4H22");
  line.setAttribute("stroke", ink("--ink"));
  line.setAttribute("stroke-width", "2");
  line.setAttribute("stroke-dasharray", dash.join(" "));
  svg.append(line);
  return svg;
}
