// The devices on the map. Few of thousands change between two updates, so only these and their neighbours are painted.

import { drawSymbol, symbolsOf } from "./map_symbols.js";
import { batteryColour, batteryShare, hiddenCanvas, ink } from "./theme.js";

// Battery levels with separate colours.
const LEVELS = 32;
// The share of changed devices from which all are painted.
const MANY = 0.4;
const SYMBOLS_BELOW = ["asleep", "unpowered", "out", "sensing"];

export class DeviceLayer {
  constructor(map) {
    this.map = map;
  }

  // A canvas with all devices in the states of a moment.
  canvas(moment, width, height, size) {
    const key = [width, height, devicePixelRatio, size, ink("--ink"), ink("--accent")].join();
    const symbols = symbolsOf(moment), looks = symbols.map((symbol, device) => `${symbol}${Math.round(batteryShare(moment, device) * LEVELS)}`);
    if (this.key !== key) this.start(key, width, height, size);
    const changed = this.looks ? looks.flatMap((look, device) => (look === this.looks[device] ? [] : [device])) : null;
    Object.assign(this, { symbols, looks });
    if (!changed || changed.length > MANY * looks.length) this.paintAll();
    else if (changed.length) this.paintAround(changed);
    return this.layer.canvas;
  }

  start(key, width, height, size) {
    Object.assign(this, { key, width, height, size, looks: null, pictures: new Map(), layer: hiddenCanvas(width, height), edge: Math.ceil(4 * size + 6) });
    this.places = this.map.run.positions.map((position) => this.map.place(position, width, height));
    this.cells = new Map();
    this.places.forEach(([x, y], device) => this.cells.set(this.cell(x, y), [...(this.cells.get(this.cell(x, y)) ?? []), device]));
  }

  // Cells as wide as a picture: pictures that overlap are in the same cell or in neighbouring ones.
  cell(x, y) {
    return Math.floor(x / this.edge) * 4096 + Math.floor(y / this.edge);
  }

  paintAll() {
    this.layer.draw.clearRect(0, 0, this.width, this.height);
    this.paint(this.places.keys());
  }

  paintAround(changed) {
    const { draw } = this.layer, { edge } = this, near = new Set();
    draw.save();
    draw.beginPath();
    for (const device of changed) {
      const [x, y] = this.places[device];
      draw.rect(x - edge / 2, y - edge / 2, edge, edge);
      for (const dx of [-edge, 0, edge]) {
        for (const dy of [-edge, 0, edge]) for (const other of this.cells.get(this.cell(x + dx, y + dy)) ?? []) near.add(other);
      }
    }
    draw.clip();
    draw.clearRect(0, 0, this.width, this.height);
    this.paint([...near].sort((a, b) => a - b));
    draw.restore();
  }

  // Active devices come last, so that no other device hides them.
  paint(devices) {
    const active = [];
    for (const device of devices) {
      if (SYMBOLS_BELOW.includes(this.symbols[device])) this.stamp(device);
      else active.push(device);
    }
    for (const device of active) this.stamp(device);
  }

  stamp(device) {
    const [x, y] = this.places[device];
    this.layer.draw.drawImage(this.picture(this.looks[device], this.symbols[device]), x - this.edge / 2, y - this.edge / 2, this.edge, this.edge);
  }

  picture(look, symbol) {
    if (!this.pictures.has(look)) {
      const { canvas, draw } = hiddenCanvas(this.edge, this.edge);
      drawSymbol(draw, symbol, this.edge / 2, this.edge / 2, this.size, batteryColour(look.slice(symbol.length) / LEVELS));
      this.pictures.set(look, canvas);
    }
    return this.pictures.get(look);
  }
}
