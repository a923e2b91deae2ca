// The panel of the timeline: its filter, its buttons, and mouse, touch and keyboard.

import { addExport } from "./export.js";
import { byId, element, page, plural } from "./page_state.js";
import { bandEntry, colourBox } from "./states.js";
import { Timeline, cellText } from "./timeline.js";
import { filterDevices } from "./timeline_filter.js";
import { GUTTER, HEAD } from "./timeline_window.js";
import { ROW } from "./timeline_tile.js";

export class TimelinePanel {
  constructor({ onChooseDevice, onChooseTti }) {
    Object.assign(this, { onChooseDevice, onChooseTti, pointers: new Map() });
    this.canvas = byId("timeline");
    this.timeline = new Timeline(byId("timeline-scroll"), this.canvas, byId("timeline-spacer"));
    page.timeline = this.timeline;
    const form = byId("timeline-filter");
    form.cluster.closest("label").hidden = !page.run.groups;
    form.class.closest("label").hidden = page.run.classes.length < 2;
    form.class.append(...page.run.classes.map((name, nth) => element("option", { value: nth, textContent: name })));
    form.oninput = () => this.filter();
    form.onsubmit = (event) => event.preventDefault();
    form.onreset = () => setTimeout(() => this.filter());
    addExport(byId("timeline-title").parentElement, { name: "timeline", title: "Timeline", canvas: () => this.canvas, rows: () => this.timeline.rows(), legend: byId("timeline-legend") });
    const entry = (colour, text) => element("span", {}, colourBox(colour), text);
    byId("timeline-legend").prepend(
      ...["sensing", "asleep", "unpowered", "out", "reporting", "woken", "failed"].map(bandEntry),
      entry("--battery", "battery"), entry("--detected", "event detected"), entry("--alarm", "event missed"),
    );
    byId("timeline-in").onclick = () => this.zoom(1.6);
    byId("timeline-out").onclick = () => this.zoom(1 / 1.6);
    byId("timeline-fit").onclick = () => this.change((view) => view.fit(page.now));
    byId("timeline-follow").onclick = () => this.change((view) => { view.follows = true; });
    this.listen();
    this.filter();
  }

  get view() {
    return this.timeline.window;
  }

  change(act) {
    act(this.view);
    this.showReadout(null);
    byId("timeline-follow").setAttribute("aria-pressed", this.view.follows);
    this.timeline.schedule();
  }

  // Zooms about `x`; without it, about the shown TTI, or else about the middle of the plot.
  zoom(factor, x = this.view.shows(page.tti) ? this.view.x(page.tti) : (GUTTER + this.canvas.clientWidth) / 2) {
    this.change((view) => view.zoom(factor, x, page.now));
  }

  filter() {
    const form = byId("timeline-filter"), note = byId("timeline-note");
    try {
      const devices = filterDevices(form);
      note.textContent = devices.length ? `${plural(devices.length, "device")}${form.state.value ? ` in this state in TTI ${page.tti}` : ""}` : "no device matches";
      note.className = "note";
      this.timeline.showDevices(devices);
    } catch (error) {
      note.textContent = error.message;
      note.className = "note alarm";
    }
  }

  // Repaints after an update, a choice or a change of the theme.
  refresh() {
    if (!page.follows && this.view.follows) this.change((view) => { view.follows = false; });
    this.timeline.follow();
  }

  position(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  listen() {
    const { canvas, pointers } = this, scroll = byId("timeline-scroll");
    canvas.addEventListener("wheel", (event) => {
      const [x] = this.position(event);
      if (event.ctrlKey || event.metaKey) this.zoom(1.0018 ** -event.deltaY, x);
      else if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.change((view) => view.pan((event.deltaX || event.deltaY) / view.scale, page.now));
      else return;
      event.preventDefault();
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, this.position(event));
      this.moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        pointers.delete(event.pointerId);
        if (kind === "pointerup" && this.moved < 5) this.chooseAt(...this.position(event));
      });
    }
    canvas.addEventListener("pointerleave", () => this.showReadout(null));
    scroll.addEventListener("keydown", (event) => {
      const rows = Math.floor((scroll.clientHeight - HEAD) / ROW);
      const acts = {
        "+": () => this.zoom(1.6), "=": () => this.zoom(1.6), "-": () => this.zoom(1 / 1.6),
        ArrowUp: () => this.chooseRow(-1), ArrowDown: () => this.chooseRow(1), PageUp: () => this.chooseRow(-rows), PageDown: () => this.chooseRow(rows),
        Home: () => this.chooseRow(-Infinity), End: () => this.chooseRow(Infinity),
      };
      if (!acts[event.key] || event.ctrlKey || event.metaKey) return;
      acts[event.key]();
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // One pointer pans, two zoom.
  move(event) {
    const { pointers } = this, before = pointers.get(event.pointerId), at = this.position(event);
    if (!before) {
      this.showReadout(this.timeline.cellAt(...at), at);
      return;
    }
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, position]) => position);
    pointers.set(event.pointerId, at);
    this.moved += Math.abs(at[0] - before[0]) + Math.abs(at[1] - before[1]);
    if (others.length) {
      const [x] = others[0], wide = Math.max(Math.abs(before[0] - x), 10);
      this.zoom(Math.max(Math.abs(at[0] - x), 10) / wide, (at[0] + x) / 2);
    } else if (this.moved >= 5) {
      this.change((view) => view.pan((before[0] - at[0]) / view.scale, page.now));
      if (event.pointerType === "mouse") byId("timeline-scroll").scrollTop -= at[1] - before[1];
    }
  }

  chooseAt(x, y) {
    const cell = this.timeline.cellAt(x, y), device = this.timeline.devices[this.view.row(y)];
    if (y < HEAD) this.onChooseTti(Math.floor(this.view.tti(x)));
    else if (device !== undefined) this.onChooseDevice(device);
    if (cell) this.onChooseTti(cell.last);
    this.showReadout(cell, [x, y]);
  }

  // Chooses a device some rows away from the chosen one and scrolls to it.
  chooseRow(rows) {
    const { devices } = this.timeline, scroll = byId("timeline-scroll");
    if (!devices.length) return;
    const row = Math.max(0, Math.min(devices.indexOf(page.device) + rows, devices.length - 1));
    const top = row * ROW, tall = scroll.clientHeight - HEAD;
    if (top < scroll.scrollTop) scroll.scrollTop = top;
    else if (top + ROW > scroll.scrollTop + tall) scroll.scrollTop = top + ROW - tall;
    this.onChooseDevice(devices[row]);
    const cell = this.timeline.cell(row, page.tti);
    if (cell) this.canvas.setAttribute("aria-label", cellText(cell).replaceAll("\n", ", "));
    this.showReadout(cell, [this.view.x(page.tti), HEAD + row * ROW - scroll.scrollTop]);
  }

  showReadout(cell, [x, y] = [0, 0]) {
    const readout = byId("timeline-readout");
    readout.hidden = !cell;
    if (!cell) return;
    readout.textContent = cellText(cell);
    const isRight = x > this.canvas.clientWidth / 2, isLow = y > this.canvas.clientHeight / 2;
    readout.style.left = isRight ? "auto" : `${x + 14}px`;
    readout.style.right = isRight ? `${this.canvas.clientWidth - x + 14}px` : "auto";
    readout.style.top = isLow ? "auto" : `${y + 14}px`;
    readout.style.bottom = isLow ? `${this.canvas.clientHeight - y + 14}px` : "auto";
  }
}
