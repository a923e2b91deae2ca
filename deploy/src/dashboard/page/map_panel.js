// The panel of the map: the layer, the legend, the description of the shown TTI.

import { get } from "./api.js";
import { significant } from "./axis.js";
import { addExport } from "./export.js";
import { TINT, classColour } from "./map_ground.js";
import { DeviceMap } from "./map.js";
import { drawSymbol, symbolsOf } from "./map_symbols.js";
import { byId, element, page, setText } from "./page_state.js";
import { STATES } from "./states.js";
import { batteryColour, batteryShare, hiddenCanvas, ink } from "./theme.js";
import { isVisible, onAppear } from "./visibility.js";

// The layers of sums since TTI 0.
const SUMS = { misses: "missed events nearest to each device", looks: "TTIs in which each device has sensed" };

function nameDevices(devices) {
  return devices.length > 8 ? `${devices.slice(0, 8).join(", ")} … (${devices.length})` : devices.join(", ");
}

// What happened in a TTI, in one line.
export function describeMoment(moment) {
  const parts = [];
  if (moment.event) parts.push(`event ${moment.event.event} at (${moment.event.epicentre.x.toFixed(1)}, ${moment.event.epicentre.y.toFixed(1)}) m`);
  if (moment.reported?.length) parts.push(`reported: ${nameDevices(moment.reported)}`);
  if (moment.lost?.length) parts.push(`report lost: ${nameDevices(moment.lost)}`);
  if (moment.failed?.length) parts.push(`lacked energy to report: ${nameDevices(moment.failed)}`);
  for (const { device, text } of moment.woken ?? []) parts.push(`${device} woken, ${text}`);
  if (moment.ended) parts.push(moment.ended.delay === null ? `event missed: ${moment.ended.cause}` : `event ended, delay ${moment.ended.delay}, I ${significant(moment.ended.information)}`);
  return parts.join(" · ");
}

export class MapPanel {
  constructor(onChooseDevice) {
    const { run, other } = page;
    this.map = new DeviceMap(byId("map"), run);
    this.otherMap = other ? new DeviceMap(byId("other-map"), other.run) : null;
    this.heats = [null, null];
    this.requested = 0;
    for (const canvas of [byId("map"), byId("other-map")]) onAppear(canvas, () => this.paint());
    this.hasBelief = false;
    const layer = byId("layer");
    if (!run.groups) layer.querySelector("[value=cluster]").remove();
    if (run.classes.length < 2) layer.querySelector("[value=class]").remove();
    layer.selectedIndex = 0;
    layer.onchange = () => {
      this.paint();
      this.refreshHeat();
    };
    for (const canvas of [byId("map"), byId("other-map")]) canvas.onclick = (event) => onChooseDevice(this.map.nearest(event));
    addExport(byId("place-title").parentElement, { name: "map", title: "Devices", canvas: () => byId("map"), rows: () => this.rows(), legend: byId("legend") });
  }

  get layer() {
    return byId("layer").value;
  }

  // Gets the sums up to the shown TTI, of this and of the other run, if a layer shows them, and paints them.
  async refreshHeat() {
    const { tti, other } = page;
    if (!(this.layer in SUMS) || page.now.next <= page.now.first) return;
    // Only the latest TTI can still change.
    if (this.heats[0]?.tti === tti && tti < page.now.next - 1) return;
    const own = ++this.requested;
    // A TTI can leave the memory, and the other run can end earlier.
    const sums = (of) => get(`api/${of}heat/${tti}`).catch(() => null);
    const heats = await Promise.all([sums(""), other && sums("other/")]);
    if (own !== this.requested) return;
    this.heats = heats.map((heat) => heat && { ...heat, version: own });
    this.paint();
  }

  // The sums of the layer for both maps, on one scale.
  get layerHeats() {
    if (!(this.layer in SUMS)) return [null, null];
    const most = Math.max(0, ...this.heats.filter(Boolean).map((heat) => heat[this.layer].reduce((a, b) => Math.max(a, b), 0)));
    return this.heats.map((heat) => heat && { values: heat[this.layer], most, tti: heat.tti, version: heat.version });
  }

  paint() {
    const { moment, other, device } = page;
    if (!moment || !(isVisible(byId("map")) || isVisible(byId("other-map")))) return;
    const [heat, otherHeat] = this.layerHeats;
    this.map.paint(moment, device, this.layer, heat);
    const text = moment.states ? describeMoment(moment) : "before TTI 0: the devices have no states yet";
    setText(byId("description"), text || "no event in this TTI");
    byId("map").setAttribute("aria-label", `Map of ${page.run.devices} devices in TTI ${page.tti}. ${text}`);
    if (other?.moment) {
      this.otherMap.paint(other.moment, device, this.layer, otherHeat);
      setText(byId("other-description"), describeMoment(other.moment) || "no event in this TTI");
    }
    this.hasBelief ||= Boolean(moment.belief ?? other?.moment?.belief);
    this.showLegend(heat);
  }

  showLegend(heat) {
    const { run } = page, key = [this.layer, this.hasBelief, ink("--ink"), heat?.version].join();
    if (this.legendKey === key) return;
    this.legendKey = key;
    const entry = (mark, text) => element("span", {}, mark, text);
    const mark = (text, colour) => {
      const made = element("i", { className: "mark", textContent: text });
      made.style.color = ink(colour);
      return made;
    };
    const entries = [
      entry(batteryPicture(), "battery, empty to full"),
      ...Object.entries(STATES).map(([state, { name }]) => entry(symbolPicture(state), name)),
      entry(mark("✶", "--event"), "event, with d_max around it"),
    ];
    if (this.hasBelief) entries.push(entry(mark("●", "--belief"), "the base station's belief about the event's place"));
    if (this.layer === "cluster") entries.push(entry(mark("■", "--faint"), "tint, and number if it fits: cluster"));
    if (this.layer === "class") {
      run.classes.forEach((name, nth) => {
        const square = mark("■", "--ink");
        square.style.color = classColour(nth);
        square.style.opacity = TINT;
        entries.push(entry(square, `class ${name}`));
      });
    }
    if (this.layer in SUMS) {
      const sums = heat ? `, TTI 0 to ${heat.tti}: ${heat.most ? `darkest ${heat.most}` : "none so far"}` : "";
      entries.push(entry(mark("■", "--event"), SUMS[this.layer] + sums));
    }
    byId("legend").replaceChildren(...entries);
  }

  rows() {
    const { run, moment } = page, symbols = symbolsOf(moment), heat = this.heats[0]?.tti === moment.tti ? this.heats[0] : null;
    return [
      ["device", "x_m", "y_m", "class", "cluster", "state", "battery_units", "plan_senses", ...(heat ? ["sensing_ttis", "near_events", "near_misses"] : [])],
      ...run.positions.map(({ x, y }, device) => [
        device, x, y, run.classes[run.device_classes[device]], run.groups?.[device] ?? "", symbols[device],
        significant(batteryShare(moment, device) * run.e_max[device]), moment.on[device], ...(heat ? [heat.looks[device], heat.events[device], heat.misses[device]] : []),
      ]),
    ];
  }
}

function batteryPicture() {
  const { canvas, draw } = hiddenCanvas(20, 16);
  for (let x = 0; x < 20; x++) {
    draw.fillStyle = batteryColour(x / 19);
    draw.fillRect(x, 3, 1, 10);
  }
  canvas.className = "symbol";
  canvas.setAttribute("aria-hidden", "true");
  return canvas;
}

function symbolPicture(symbol) {
  const { canvas, draw } = hiddenCanvas(20, 16);
  drawSymbol(draw, symbol, 10, symbol === "reporting" ? 9 : 8, 4, ink("--field"));
  canvas.className = "symbol";
  canvas.setAttribute("aria-hidden", "true");
  return canvas;
}
