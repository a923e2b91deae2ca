// Curves over the run, and the history of a device.

import { colour, ink, sharp } from "./map.js";

const CHARTS = [
  ["P1 so far", (p) => [p.metrics[0]]],
  ["missed, %", (p) => [p.metrics[1]]],
  ["delay, TTIs", (p) => [p.metrics[2]]],
  ["energy per device-TTI: sensing, sleep, report", (p) => p.metrics.slice(3, 6)],
  ["battery: 5, 50, 95 %", (p) => p.batteries],
  ["bytes per TTI: control, reports", (p) => [p.control, p.uplink]],
];
const DASHES = [[], [6, 3], [2, 2]];

export class Charts {
  constructor(box, go) {
    this.all = CHARTS.map(([title, value]) => {
      const figure = document.createElement("figure");
      const caption = document.createElement("figcaption"), name = document.createElement("span"), last = document.createElement("b");
      const canvas = document.createElement("canvas");
      name.textContent = title;
      caption.append(name, last);
      figure.append(caption, canvas);
      box.append(figure);
      canvas.addEventListener("click", (event) => {
        const { left, width } = canvas.getBoundingClientRect();
        go(Math.round(((event.clientX - left) / width) * this.end));
      });
      return { canvas, value, last };
    });
    this.end = 1;
  }

  // Paints the curves of a run, and the curves of the compared run in another colour.
  paint(points, others, end, tti) {
    this.end = Math.max(end, 1);
    for (const { canvas, value, last } of this.all) {
      const { draw, width, height } = sharp(canvas);
      const rows = points.map((p) => [p.tti, value(p)]), compared = others.map((p) => [p.tti, value(p)]);
      const known = [...compared, ...rows].flatMap(([, values]) => values).filter((v) => v !== null && v !== undefined);
      const most = Math.max(...known, 1e-9);
      const x = (k) => (k / this.end) * width, y = (v) => height - 2 - (v / most) * (height - 6);
      draw.strokeStyle = ink("--line");
      draw.strokeRect(0.5, 0.5, width - 1, height - 1);
      for (const [all, tint] of [[compared, ink("--alarm")], [rows, ink("--accent")]]) {
        for (let i = 0; i < (all[0]?.[1].length ?? 0); i++) {
          draw.beginPath();
          draw.setLineDash(DASHES[i]);
          draw.strokeStyle = tint;
          draw.lineWidth = 1.6;
          let pen = false;
          for (const [k, values] of all) {
            if (values[i] === null || values[i] === undefined) { pen = false; continue; }
            pen ? draw.lineTo(x(k), y(values[i])) : draw.moveTo(x(k), y(values[i]));
            pen = true;
          }
          draw.stroke();
        }
      }
      draw.setLineDash([]);
      draw.beginPath();
      draw.moveTo(x(tti), 0);
      draw.lineTo(x(tti), height);
      draw.strokeStyle = ink("--alarm");
      draw.lineWidth = 1;
      draw.stroke();
      const values = rows.length ? rows.at(-1)[1] : [];
      last.textContent = values.map((v) => (v === null || v === undefined ? "–" : +v.toPrecision(3))).join(" · ");
    }
  }
}

// Battery as a line, states as a band below it.
export function history(canvas, told, most, tti) {
  const { draw, width, height } = sharp(canvas);
  const count = told.batteries.length, band = 18;
  const x = (i) => (i / Math.max(count, 1)) * width, y = (v) => 4 + (1 - v / most) * (height - band - 8);
  const tints = { 1: ink("--accent"), 2: ink("--alarm"), 3: ink("--alarm"), 4: ink("--line"), 0: ink("--ink") };
  for (let i = 0; i < count; i++) {
    draw.fillStyle = tints[told.states[i]];
    draw.fillRect(x(i), height - band, Math.max(width / count, 1), band);
  }
  draw.beginPath();
  told.batteries.forEach((v, i) => (i ? draw.lineTo(x(i), y(v)) : draw.moveTo(x(i), y(v))));
  draw.strokeStyle = ink("--ink");
  draw.lineWidth = 1.4;
  draw.stroke();
  draw.strokeStyle = ink("--alarm");
  draw.strokeRect(x(tti - told.from), 0, 1, height);
}

export const ramp = () => `linear-gradient(to right, ${[0, 0.25, 0.5, 0.75, 1].map(colour).join(", ")})`;
