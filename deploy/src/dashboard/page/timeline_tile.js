// The picture of a tile of the timeline: for each device a band of states above a small area chart of its battery.

import { ASLEEP, TILE_COLUMNS, UNPOWERED, stateOf } from "./timeline_data.js";
import { STATES } from "./states.js";
import { ink, rgb } from "./theme.js";

// Height of a row and of its parts, in pixels.
export const ROW = 20;
const STATE_TOP = 1, STATE_BOTTOM = 9, BATTERY_TOP = 10, BATTERY_BOTTOM = 19;

// The top and the bottom of a state's band. Devices that cannot act have a lower one, so that states differ in shape too.
function bandOf(flags) {
  const state = stateOf(flags);
  if (state === "out") return [STATE_BOTTOM - 2, STATE_BOTTOM];
  return [state === "unpowered" && !(flags & ASLEEP) ? STATE_BOTTOM - 4 : STATE_TOP, STATE_BOTTOM];
}

// The bands of all flags, since a tile has thousands of cells.
const BANDS = Array.from({ length: 256 }, (_, flags) => bandOf(flags));

const mix = (from, to, share) => from.map((value, nth) => Math.round(value + (to[nth] - value) * share));
const packed = ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;

// The colours of the state band, by flags and share of S1.
class Palette {
  constructor() {
    const colour = (state) => rgb(STATES[state].colour), [asleep, sensing, unpowered] = ["asleep", "sensing", "unpowered"].map(colour);
    const marks = Object.fromEntries(["reporting", "woken", "failed", "out"].map((state) => [state, packed(colour(state))]));
    this.marks = Array.from({ length: 256 }, (_, flags) => marks[stateOf(flags)]);
    [this.battery, this.emptyBattery] = [packed(rgb("--battery")), packed(rgb("--field"))];
    this.levels = [asleep, unpowered].map((base) => Array.from({ length: 256 }, (_, share) => packed(mix(base, sensing, share / 255))));
  }

  state(flags, sensing) {
    return this.marks[flags] ?? this.levels[flags & UNPOWERED ? 1 : 0][sensing];
  }
}

let palette, paletteKey;

// The picture of a tile; painted again only after a change.
export function tilePicture(tile) {
  const key = ink("--paper") + ink("--asleep");
  if (paletteKey !== key) [palette, paletteKey] = [new Palette(), key];
  if (tile.paintedVersion === tile.version && tile.paintedKey === key) return tile.canvas;
  Object.assign(tile, { paintedVersion: tile.version, paintedKey: key });
  tile.canvas ??= Object.assign(document.createElement("canvas"), { width: TILE_COLUMNS, height: tile.devices.length * ROW });
  const draw = tile.canvas.getContext("2d");
  const image = draw.createImageData(TILE_COLUMNS, tile.devices.length * ROW), pixels = new Uint32Array(image.data.buffer);
  const known = Math.ceil((tile.until - tile.from) / tile.step);
  for (let row = 0; row < tile.devices.length; row += 1) {
    for (let column = 0; column < known; column += 1) {
      const cell = row * TILE_COLUMNS + column, flags = tile.flags[cell];
      if (!flags) continue;
      const top = row * ROW, colour = palette.state(flags, tile.sensing[cell]);
      const [bandTop, bandBottom] = BANDS[flags];
      for (let y = bandTop; y < bandBottom; y += 1) pixels[(top + y) * TILE_COLUMNS + column] = colour;
      // A full battery fills the band; any energy shows at least one pixel.
      const level = Math.ceil((tile.battery[cell] / 255) * (BATTERY_BOTTOM - BATTERY_TOP));
      for (let y = BATTERY_TOP; y < BATTERY_BOTTOM; y += 1) {
        pixels[(top + y) * TILE_COLUMNS + column] = y < BATTERY_BOTTOM - level ? palette.emptyBattery : palette.battery;
      }
    }
  }
  draw.putImageData(image, 0, 0);
  return tile.canvas;
}
