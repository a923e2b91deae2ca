// The map: the ground, the devices by battery and state, the event and the belief about it.

import { MapGround, paintScaleBar } from "./map_ground.js";
import { DeviceLayer } from "./map_devices.js";
import { ink, prepareCanvas } from "./theme.js";

const EDGE = 10;
// Pixels below the area, for the scale bar.
const FOOT = 28;

export class DeviceMap {
  constructor(canvas, run) {
    this.canvas = canvas;
    this.run = run;
    this.ground = new MapGround(this);
    this.devices = new DeviceLayer(this);
    canvas.style.aspectRatio = `${run.area[0]} / ${run.area[1]}`;
  }

  // Pixels of a metre.
  perMetre(width, height) {
    return Math.min((width - 2 * EDGE) / this.run.area[0], (height - EDGE - FOOT) / this.run.area[1]);
  }

  place({ x, y }, width, height) {
    const perMetre = this.perMetre(width, height), left = (width - this.run.area[0] * perMetre) / 2;
    return [left + x * perMetre, height - FOOT - y * perMetre];
  }

  // The device nearest to a pointer.
  nearest(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const distances = this.run.positions.map((position) => {
      const [px, py] = this.place(position, box.width, box.height);
      return Math.hypot(px - x, py - y);
    });
    return distances.reduce((best, distance, device) => (distance < distances[best] ? device : best), 0);
  }

  paint(moment, chosen, layer, heat) {
    const { draw, width, height } = prepareCanvas(this.canvas);
    if (width < 2 * EDGE) return;
    this.draw = draw;
    this.at = (point) => this.place(point, width, height);
    draw.drawImage(this.ground.canvas(width, height, layer, heat, moment), 0, 0, width, height);
    // Before TTI 0 no device has a state.
    if (moment.states) this.paintMoment(draw, moment, chosen, layer, width, height);
    else this.paintPlaces();
    paintScaleBar(draw, this, width, height);
  }

  paintMoment(draw, moment, chosen, layer, width, height) {
    this.paintBelief(moment.belief ?? []);
    if (moment.event) this.paintRange(moment, this.perMetre(width, height) * this.run.d_max);
    const size = Math.max(2, Math.min(8, width / 9 / Math.sqrt(this.run.devices)));
    draw.drawImage(this.devices.canvas(moment, width, height, size), 0, 0, width, height);
    if (layer === "cluster" && this.run.groups) this.ground.paintClusterNumbers(draw, width, height, size);
    if (chosen >= 0) this.paintChosen(chosen, size);
    if (moment.event) this.paintEpicentre(moment.event.epicentre);
  }

  // The places of devices without a state.
  paintPlaces() {
    const { draw } = this;
    draw.fillStyle = ink("--faint");
    for (const position of this.run.positions) {
      const [x, y] = this.at(position);
      draw.fillRect(x - 2, y - 2, 4, 4);
    }
  }

  paintBelief(places) {
    const { draw } = this, most = Math.max(...places.map((place) => place.share));
    for (const place of places) {
      draw.beginPath();
      draw.arc(...this.at(place), 2 + 4 * Math.sqrt(place.share / most), 0, 2 * Math.PI);
      draw.globalAlpha = 0.25 + 0.55 * (place.share / most);
      draw.fillStyle = ink("--belief");
      draw.fill();
    }
    draw.globalAlpha = 1;
  }

  // The circle of d_max around the event, and a line to each device that was active.
  paintRange(moment, radius) {
    const { draw } = this, centre = this.at(moment.event.epicentre);
    draw.beginPath();
    draw.arc(...centre, radius, 0, 2 * Math.PI);
    draw.strokeStyle = ink("--event");
    draw.setLineDash([4, 4]);
    draw.lineWidth = 1.5;
    draw.stroke();
    const link = (device, colour, dash) => {
      draw.beginPath();
      draw.setLineDash(dash);
      draw.moveTo(...this.at(this.run.positions[device]));
      draw.lineTo(...centre);
      draw.strokeStyle = ink(colour);
      draw.stroke();
    };
    for (const device of moment.reported ?? []) link(device, "--event", []);
    for (const { device } of moment.woken ?? []) link(device, "--woken", [2, 3]);
    draw.setLineDash([]);
  }

  paintChosen(device, size) {
    const { draw } = this;
    draw.beginPath();
    draw.arc(...this.at(this.run.positions[device]), 2.4 * size + 2, 0, 2 * Math.PI);
    draw.strokeStyle = ink("--ink");
    draw.lineWidth = 2;
    draw.stroke();
  }

  paintEpicentre(epicentre) {
    const { draw } = this, [x, y] = this.at(epicentre);
    draw.beginPath();
    for (let i = 0; i < 16; i++) {
      const far = i % 2 ? 4 : 10, turn = (i * Math.PI) / 8;
      draw.lineTo(x + far * Math.sin(turn), y - far * Math.cos(turn));
    }
    draw.closePath();
    draw.fillStyle = ink("--event");
    draw.fill();
    draw.strokeStyle = ink("--paper");
    draw.lineWidth = 1;
    draw.stroke();
  }
}
