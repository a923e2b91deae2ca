// The visible part of the timeline: its TTIs and its rows; zoom and pan.

import { MAX_STEP } from "./timeline_data.js";
import { ROW } from "./timeline_tile.js";

// Width of the device names and height of the axis and the events, in pixels.
export const GUTTER = 84;
export const HEAD = 46;
const MAX_PIXELS = 28;

export class TimelineWindow {
  constructor() {
    // Pixels of a TTI, and the TTI at the left edge.
    Object.assign(this, { scale: 3, from: 0, follows: true, width: 600, height: 300, scroll: 0 });
  }

  get ttis() {
    return (this.width - GUTTER) / this.scale;
  }

  // TTIs in a column: a power of two, at which a column has at least one pixel.
  get step() {
    let step = 1;
    while (step * this.scale < 1 && step < MAX_STEP) step *= 2;
    return step;
  }

  x(tti) {
    return GUTTER + (tti - this.from) * this.scale;
  }

  tti(x) {
    return this.from + (x - GUTTER) / this.scale;
  }

  row(y) {
    return Math.floor((y - HEAD + this.scroll) / ROW);
  }

  y(row) {
    return HEAD + row * ROW - this.scroll;
  }

  visible(rows) {
    return {
      from: Math.floor(this.from), end: Math.ceil(this.from + this.ttis), step: this.step,
      firstRow: Math.max(0, this.row(HEAD)), lastRow: Math.min(rows - 1, this.row(this.height)),
    };
  }

  zoom(factor, x, { first, next }) {
    const anchor = this.follows ? next : this.tti(x);
    const least = Math.max(1 / MAX_STEP, Math.min(1, (this.width - GUTTER) / Math.max(next - first, 1)) * 0.9);
    this.scale = Math.max(least, Math.min(this.scale * factor, MAX_PIXELS));
    if (!this.follows) this.from = anchor - (x - GUTTER) / this.scale;
    this.keepInside({ first, next });
  }

  pan(ttis, available) {
    this.follows = false;
    this.from += ttis;
    this.keepInside(available);
  }

  // Shows all TTIs.
  fit({ first, next }) {
    this.follows = false;
    this.scale = Math.max(1 / MAX_STEP, Math.min((this.width - GUTTER - 10) / Math.max(next - first, 1), MAX_PIXELS));
    this.from = first;
  }

  shows(tti) {
    return tti >= this.from && tti < this.from + this.ttis;
  }

  // Moves the window so that it shows a TTI.
  reveal(tti, available) {
    if (this.shows(tti)) return;
    this.from = tti - this.ttis / 2;
    this.keepInside(available);
  }

  keepInside({ first, next }) {
    const room = 24 / this.scale, last = Math.max(first, next + room - this.ttis);
    this.from = this.follows ? last : Math.max(first, Math.min(this.from, last));
  }
}
