// The ground of the map: cells tinted by cluster, class or a heat layer, cluster numbers, and a scale bar.

import { ticks } from "./axis.js";
import { batteryColour, batteryShare, hiddenCanvas, ink, outlinedText } from "./theme.js";

// Steps of the golden angle keep the hues of neighbouring clusters apart.
const clusterColour = (cluster) => `hsl(${(cluster * 137.5) % 360} 55% 50%)`;
// Colours that differ in lightness too (Okabe and Ito); further classes repeat them.
const CLASS_COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00"];
export const classColour = (nth) => CLASS_COLOURS[nth % CLASS_COLOURS.length];
// Opacity of the tints of clusters and classes.
export const TINT = 0.3;

export class MapGround {
  constructor(map) {
    this.map = map;
  }

  // The painted ground; the same canvas until something on it changes.
  canvas(width, height, layer, heat, moment) {
    const version = layer === "battery" ? moment.tti : heat?.version;
    const key = [width, height, devicePixelRatio, ink("--line"), layer, version].join();
    if (this.key !== key) {
      this.key = key;
      this.painted = this.paint(width, height, layer, heat, moment);
    }
    return this.painted;
  }

  // The heat of each device from 0 to 1, or null.
  heat(layer, heat, moment) {
    if (layer !== "battery") return heat?.values.map((value) => value / Math.max(heat.most, 1)) ?? null;
    return moment.states ? Array.from({ length: this.map.run.devices }, (_, device) => batteryShare(moment, device)) : null;
  }

  paint(width, height, layer, heat, moment) {
    const { canvas, draw } = hiddenCanvas(width, height), { run } = this.map;
    const heats = this.heat(layer, heat, moment);
    const tints = layer === "class" ? run.device_classes : layer === "cluster" ? run.groups : null;
    draw.strokeStyle = ink("--line");
    draw.lineWidth = run.devices > 600 ? 0.5 : 1;
    run.cells.forEach((corners, device) => {
      if (!corners.length) return;
      draw.beginPath();
      for (const corner of corners) draw.lineTo(...this.map.place(corner, width, height));
      draw.closePath();
      if (heats) draw.fillStyle = layer === "battery" ? batteryColour(heats[device]) : ink("--event");
      else if (tints) draw.fillStyle = layer === "class" ? classColour(tints[device]) : clusterColour(tints[device]);
      if (heats && layer !== "battery") draw.globalAlpha = 0.85 * heats[device];
      else if (tints) draw.globalAlpha = TINT;
      if (heats || tints) draw.fill();
      draw.globalAlpha = 1;
      draw.stroke();
    });
    return canvas;
  }

  // The mean position of the devices of each cluster.
  findCentres() {
    const { run } = this.map, centres = new Map();
    run.groups.forEach((group, device) => {
      const sum = centres.get(group) ?? { x: 0, y: 0, count: 0 };
      centres.set(group, { x: sum.x + run.positions[device].x, y: sum.y + run.positions[device].y, count: sum.count + 1 });
    });
    return centres;
  }

  // A number that would cover another one is left out, and all of them if hardly any fits. It stays above a device of this size.
  paintClusterNumbers(draw, width, height, size) {
    this.centres ??= this.findCentres();
    const { centres } = this;
    const spacing = width / Math.sqrt(centres.size);
    if (spacing < 18) return;
    const high = spacing < 40 ? 9 : spacing < 60 ? 11 : 13, taken = [];
    draw.font = `600 ${high}px system-ui, sans-serif`;
    draw.textAlign = "center";
    draw.textBaseline = "middle";
    for (const [group, { x, y, count }] of centres) {
      const at = this.map.place({ x: x / count, y: y / count }, width, height), gap = 1.7 * size + 8;
      const isOnDevice = this.map.devices.places.some(([px, py]) => Math.hypot(px - at[0], py - at[1]) < gap);
      if (isOnDevice) at[1] += at[1] > 2 * gap ? -gap : gap;
      const wide = draw.measureText(group).width;
      if (taken.some((other) => Math.abs(other.x - at[0]) < (other.wide + wide) / 2 + 2 && Math.abs(other.y - at[1]) < high)) continue;
      taken.push({ x: at[0], y: at[1], wide });
      outlinedText(draw, group, ...at);
    }
  }
}

// A bar of a round length in metres below the area.
export function paintScaleBar(draw, map, width, height) {
  const metres = map.run.area[0], perMetre = map.perMetre(width, height);
  const length = ticks(0, metres, 4).find((value) => value > 0) ?? metres;
  const x = 16, y = height - 6, text = `${length} m`;
  draw.font = "600 12px system-ui, sans-serif";
  draw.textAlign = "left";
  draw.textBaseline = "bottom";
  draw.beginPath();
  draw.moveTo(x, y - 5);
  draw.lineTo(x, y);
  draw.lineTo(x + length * perMetre, y);
  draw.lineTo(x + length * perMetre, y - 5);
  // An event's circle can cross the bar.
  for (const [colour, lineWidth] of [["--field", 5], ["--ink", 1.5]]) {
    Object.assign(draw, { strokeStyle: ink(colour), lineWidth });
    draw.stroke();
  }
  outlinedText(draw, text, x + 5, y - 2);
}
