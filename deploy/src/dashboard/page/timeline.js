// The timeline of all devices: one row for each, painted for the visible rows only.

import { get } from "./api.js";
import { shortNumber, significant, ticks, ttiText } from "./axis.js";
import { page } from "./page_state.js";
import { STATES, nameOfCode } from "./states.js";
import { ASLEEP, FAILED, OUT, REPORTED, REPORTING, SENSING, TILE_COLUMNS, TILE_ROWS, TimelineData, UNPOWERED, WAKE_UP_SENT } from "./timeline_data.js";
import { ROW, tilePicture } from "./timeline_tile.js";
import { GUTTER, HEAD, TimelineWindow } from "./timeline_window.js";
import { ink, prepareCanvas } from "./theme.js";
import { isVisible, onAppear } from "./visibility.js";

const EVENT_TOP = 26, EVENT_BOTTOM = 42;
// Time between two requests for events, in milliseconds.
const EVENT_INTERVAL = 400;

const FLAG_NAMES = [
  [SENSING, STATES.sensing.name], [REPORTING, nameOfCode(3)], [ASLEEP, STATES.asleep.name], [UNPOWERED, STATES.unpowered.name],
  [REPORTED, "report arrived"], [WAKE_UP_SENT, "wake-up sent"], [FAILED, STATES.failed.name], [OUT, STATES.out.name],
];

export class Timeline {
  constructor(scroll, canvas, spacer) {
    Object.assign(this, { scroll, canvas, spacer, devices: [], events: [], paints: 0 });
    this.window = new TimelineWindow();
    this.data = new TimelineData(() => this.schedule());
    scroll.addEventListener("scroll", () => this.schedule(), { passive: true });
    new ResizeObserver(() => this.schedule()).observe(scroll);
    onAppear(scroll, () => this.schedule());
  }

  showDevices(devices) {
    this.devices = devices;
    this.data.reset(devices);
    this.spacer.style.height = `${HEAD + devices.length * ROW + 4}px`;
    this.schedule();
  }

  schedule() {
    if (this.isScheduled) return;
    this.isScheduled = true;
    requestAnimationFrame(() => {
      this.isScheduled = false;
      this.paint();
    });
  }

  // Moves with the run, or to a TTI that the reader has chosen elsewhere.
  follow() {
    if (!page.follows && this.revealed !== page.tti) this.window.reveal(page.tti, page.now);
    this.revealed = page.tti;
    this.schedule();
  }

  paint() {
    if (!page.now || !isVisible(this.scroll)) return;
    const { draw, width, height } = prepareCanvas(this.canvas);
    if (width < GUTTER) return;
    // A new width, also the first one, keeps the shown TTI in the window.
    const wasShown = this.window.shows(page.tti);
    Object.assign(this.window, { width, height, scroll: this.scroll.scrollTop });
    if (wasShown && !page.follows) this.window.reveal(page.tti, page.now);
    this.paints += 1;
    this.window.keepInside(page.now);
    const visible = this.window.visible(this.devices.length);
    draw.imageSmoothingEnabled = false;
    draw.save();
    draw.beginPath();
    draw.rect(GUTTER, HEAD, width - GUTTER, height - HEAD);
    draw.clip();
    for (const tile of this.data.tilesOf(visible, page.now)) {
      const known = Math.ceil((tile.until - tile.from) / tile.step);
      if (known <= 0) continue;
      const x = this.window.x(tile.from), wide = TILE_COLUMNS * tile.step * this.window.scale;
      draw.drawImage(tilePicture(tile), x, this.window.y(tile.band * TILE_ROWS), wide, tile.devices.length * ROW);
    }
    draw.restore();
    this.paintChosen(draw, width);
    this.paintNames(draw, visible);
    this.paintHead(draw, width, visible);
    this.paintRule(draw, height);
    this.refreshEvents(visible);
  }

  paintNames(draw, { firstRow, lastRow }) {
    draw.font = "11px system-ui, sans-serif";
    draw.textAlign = "right";
    draw.textBaseline = "middle";
    for (let row = firstRow; row <= lastRow; row += 1) {
      const isChosen = this.devices[row] === page.device;
      draw.fillStyle = ink(isChosen ? "--ink" : "--faint");
      draw.font = `${isChosen ? "600 " : ""}11px system-ui, sans-serif`;
      draw.fillText(`device ${this.devices[row]}`, GUTTER - 8, this.window.y(row) + ROW / 2);
    }
  }

  paintChosen(draw, width) {
    const row = this.devices.indexOf(page.device);
    if (row < 0) return;
    draw.strokeStyle = ink("--ink");
    draw.lineWidth = 1.5;
    draw.strokeRect(1, this.window.y(row) + 0.5, width - 2, ROW);
  }

  // The axis of TTIs and, below it, the events: missed ones filled, others as outlines.
  paintHead(draw, width, { from, end }) {
    draw.fillStyle = ink("--field");
    draw.fillRect(0, 0, width, HEAD);
    draw.strokeStyle = draw.fillStyle = ink("--faint");
    draw.font = "11px system-ui, sans-serif";
    draw.textBaseline = "top";
    draw.textAlign = "right";
    draw.fillText("TTI", GUTTER - 8, 5);
    draw.fillText("events", GUTTER - 8, EVENT_TOP + 2);
    draw.lineWidth = 1;
    draw.beginPath();
    for (const tti of ticks(Math.max(from, 0), end, Math.max(2, Math.floor(width / 110)), true)) {
      const x = Math.round(this.window.x(tti)) + 0.5;
      if (x < GUTTER || x > width) continue;
      draw.moveTo(x, 18);
      draw.lineTo(x, 24);
      draw.textAlign = x > width - 40 ? "right" : "center";
      draw.fillText(ttiText(tti), x, 5);
    }
    draw.moveTo(0, HEAD - 0.5);
    draw.lineTo(width, HEAD - 0.5);
    draw.stroke();
    draw.save();
    draw.beginPath();
    draw.rect(GUTTER, 0, width - GUTTER, HEAD);
    draw.clip();
    for (const { start, last, delay } of this.events) this.paintEvent(draw, start, last, delay === null);
    draw.restore();
  }

  paintEvent(draw, start, last, isMissed) {
    const x = this.window.x(start), wide = Math.max((last + 1 - start) * this.window.scale, 1.5);
    draw.fillStyle = ink(isMissed ? "--alarm" : "--detected");
    if (isMissed) draw.fillRect(x, EVENT_TOP, wide, EVENT_BOTTOM - EVENT_TOP);
    else draw.fillRect(x, EVENT_TOP + 5, wide, EVENT_BOTTOM - EVENT_TOP - 10);
  }

  paintRule(draw, height) {
    const x = this.window.x(page.tti + 0.5);
    if (x < GUTTER || page.follows) return;
    draw.strokeStyle = ink("--ink");
    draw.lineWidth = 1;
    draw.beginPath();
    draw.moveTo(Math.round(x) + 0.5, 18);
    draw.lineTo(Math.round(x) + 0.5, height);
    draw.stroke();
  }

  // Gets the events of the window and of some TTIs around it.
  async refreshEvents({ from, end }) {
    const now = performance.now(), margin = Math.ceil((end - from) / 2);
    // Messages that come after the latest TTI was asked for can still end its event.
    const isSettled = this.eventsEnd < this.eventsSeen?.next || this.eventsSeen?.messages === page.now.messages;
    const isCovered = isSettled && this.eventsFrom <= Math.max(from, 0) && this.eventsEnd >= Math.min(end, page.now.next);
    if (isCovered || this.isAsking || now - (this.asked ?? 0) < EVENT_INTERVAL) return;
    Object.assign(this, { isAsking: true, asked: now });
    const [first, last] = [Math.max(0, from - margin), end + margin], { next, messages } = page.now;
    try {
      this.events = await get(`api/events?from=${first}&end=${last}`);
      Object.assign(this, { eventsFrom: first, eventsEnd: Math.min(last, next), eventsSeen: { next, messages } });
      this.schedule();
    } catch { /* the status line reports a lost connection */ } finally {
      this.isAsking = false;
    }
  }

  // The device, the TTIs and the cell at a position, or null.
  cellAt(x, y) {
    if (x < GUTTER || y < HEAD) return null;
    return this.cell(this.window.row(y), Math.floor(this.window.tti(x)));
  }

  cell(row, tti) {
    const device = this.devices[row], { step } = this.window;
    if (device === undefined || tti < 0) return null;
    const tile = this.data.tiles.get(`${step} ${Math.floor(tti / (TILE_COLUMNS * step))} ${Math.floor(row / TILE_ROWS)}`);
    if (!tile || tti >= tile.until) return null;
    const at = (row % TILE_ROWS) * TILE_COLUMNS + Math.floor((tti - tile.from) / step), start = tti - ((tti - tile.from) % step);
    return {
      device, from: start, last: Math.min(start + step, tile.until) - 1, battery: (tile.battery[at] / 255) * page.run.e_max[device],
      sensing: tile.sensing[at] / 255, states: FLAG_NAMES.filter(([flag]) => tile.flags[at] & flag).map(([, name]) => name),
    };
  }

  // Rows of a CSV file with the visible cells.
  rows() {
    const { from, end, step, firstRow, lastRow } = this.window.visible(this.devices.length), rows = [];
    for (let row = firstRow; row <= lastRow; row += 1) {
      for (let tti = Math.max(0, from - (from % step)); tti < end; tti += step) {
        const cell = this.cell(row, tti);
        if (cell) rows.push([cell.device, cell.from, cell.last, cell.states.join("; "), significant(cell.sensing), significant(cell.battery)]);
      }
    }
    return [["device", "from_tti", "last_tti", "states", "share_sensing", "battery_units"], ...rows];
  }
}

export function cellText({ device, from, last, states, sensing, battery }) {
  const ttis = from === last ? `TTI ${ttiText(from)}` : `TTIs ${ttiText(from)} to ${ttiText(last)}, S1 in ${Math.round(100 * sensing)} %`;
  return [`device ${device}`, ttis, ...states, `battery ${shortNumber(battery)} units`].join("\n");
}
