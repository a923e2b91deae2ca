// States and batteries of many devices, in tiles that are requested when the timeline shows them.

import { getBytes } from "./api.js";

// Columns and rows of a tile.
export const TILE_COLUMNS = 256;
export const TILE_ROWS = 32;
// The most TTIs in a column.
export const MAX_STEP = 512;

// Flags of a column, as in `timeline.rs`.
export const SENSING = 1, REPORTING = 2, ASLEEP = 4, UNPOWERED = 8, REPORTED = 16, WAKE_UP_SENT = 32, FAILED = 64, OUT = 128;

// The state that a column with these flags shows: the rarest one.
export function stateOf(flags) {
  if (flags & FAILED) return "failed";
  if (flags & WAKE_UP_SENT) return "woken";
  if (flags & (REPORTED | REPORTING)) return "reporting";
  if (flags & OUT) return "out";
  if (flags & SENSING) return "sensing";
  return flags & UNPOWERED ? "unpowered" : "asleep";
}

// Reads an answer: the end of its TTIs, and three planes of bytes, row by row.
function decode(bytes) {
  const head = new DataView(bytes), columns = head.getUint32(16, true), rows = head.getUint32(20, true);
  const [flags, sensing, battery] = [0, 1, 2].map((nth) => new Uint8Array(bytes, 24 + nth * rows * columns, rows * columns));
  return { end: Number(head.getBigUint64(8, true)), columns, rows, flags, sensing, battery };
}

// The flags of a device in each TTI from `from` up to but excluding `end`.
export const deviceFlags = async (device, from, end) => decode(await getBytes(`api/timeline?from=${from}&end=${end}&rows=${device}`)).flags;

const MAX_TILES = 60;
const MAX_REQUESTS = 2;
// Time between two requests for the end of a live run, in milliseconds.
const TAIL_INTERVAL = 120;

// Ids as ranges: [0, 1, 2, 9] becomes "0-2,9".
export function rangeText(ids) {
  const ranges = [];
  for (const id of ids) {
    const last = ranges.at(-1);
    if (last && last[1] === id - 1) last[1] = id;
    else ranges.push([id, id]);
  }
  return ranges.map(([first, last]) => (first === last ? `${first}` : `${first}-${last}`)).join(",");
}

export class TimelineData {
  constructor(onChange) {
    this.onChange = onChange;
    this.requests = 0;
    this.reset([]);
  }

  // Starts again with these devices as rows.
  reset(devices) {
    this.devices = devices;
    this.tiles = new Map();
  }

  // The tiles of a window: TTIs, rows and TTIs per column. Requests the missing ones. The run is known up to `next`.
  tilesOf({ from, end, firstRow, lastRow, step }, available) {
    const span = TILE_COLUMNS * step, found = [];
    for (let x = Math.floor(Math.max(from, available.first) / span); x * span < Math.min(end, available.next); x += 1) {
      for (let band = Math.floor(firstRow / TILE_ROWS); band * TILE_ROWS <= Math.min(lastRow, this.devices.length - 1); band += 1) {
        const tile = this.tile(step, x, band);
        found.push(tile);
        if (this.isIncomplete(tile, available)) this.request(tile, available);
      }
    }
    return found;
  }

  tile(step, x, band) {
    const key = `${step} ${x} ${band}`;
    let tile = this.tiles.get(key);
    if (!tile) {
      const devices = this.devices.slice(band * TILE_ROWS, (band + 1) * TILE_ROWS);
      const plane = () => new Uint8Array(TILE_COLUMNS * devices.length);
      tile = { step, band, devices, from: x * TILE_COLUMNS * step, until: 0, flags: plane(), sensing: plane(), battery: plane(), version: 0, requested: -Infinity };
    }
    // The tile that was used last comes last.
    this.tiles.delete(key);
    this.tiles.set(key, tile);
    if (this.tiles.size > MAX_TILES) this.tiles.delete(this.tiles.keys().next().value);
    return tile;
  }

  // Also true if the last TTI was the latest one: messages that came later can belong to it.
  isIncomplete(tile, { next, messages }) {
    const wasOpen = tile.until === tile.seen?.next && messages !== tile.seen.messages;
    return wasOpen || tile.until < Math.min(next, tile.from + TILE_COLUMNS * tile.step);
  }

  async request(tile, available) {
    const now = performance.now();
    if (tile.isRequested || this.requests >= MAX_REQUESTS || now - tile.requested < TAIL_INTERVAL) return;
    const { next, messages } = available;
    Object.assign(tile, { isRequested: true, requested: now, seen: { next, messages } });
    this.requests += 1;
    // The last known TTI can still have been open, so its column is requested again.
    const column = tile.until ? Math.floor((tile.until - 1 - tile.from) / tile.step) : 0;
    const from = tile.from + column * tile.step, end = Math.min(next, tile.from + TILE_COLUMNS * tile.step);
    try {
      this.fill(tile, column, await getBytes(`api/timeline?from=${from}&end=${end}&step=${tile.step}&rows=${rangeText(tile.devices)}`));
    } catch (error) {
      // TTIs that are not available any more stay empty.
      tile.error = error.message;
    } finally {
      tile.isRequested = false;
      this.requests -= 1;
      this.onChange();
    }
  }

  // Copies an answer into a tile from this column on.
  fill(tile, column, bytes) {
    const answer = decode(bytes), { columns, rows } = answer;
    for (const plane of ["flags", "sensing", "battery"]) {
      for (let row = 0; row < rows; row += 1) {
        tile[plane].set(answer[plane].subarray(row * columns, (row + 1) * columns), row * TILE_COLUMNS + column);
      }
    }
    tile.until = answer.end;
    tile.version += 1;
  }
}
