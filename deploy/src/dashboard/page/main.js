// The page: starts its parts, and passes updates and choices on to them.

import { followAddress, linked, noteAddress } from "./address.js";
import { followRun, get } from "./api.js";
import { Charts } from "./charts.js";
import { command, pauseOrResume, startClock } from "./clock.js";
import { startActions } from "./device_actions.js";
import { otherMoment, showCompare, startCompare } from "./compare.js";
import { showDevice } from "./device_panel.js";
import { showLastEvents, showMiss, startEvents } from "./events_panel.js";
import { Histogram } from "./histogram.js";
import { startKeys } from "./keys.js";
import { MapPanel } from "./map_panel.js";
import { showMessages, startMessages } from "./messages.js";
import { byId, element, page, showNote } from "./page_state.js";
import { showAbout, showProblem, showRunState } from "./run_state.js";
import { refreshTheme } from "./theme.js";
import { TimelinePanel } from "./timeline_panel.js";

// Time between two updates with reduced motion, in milliseconds.
const CALM_INTERVAL = 500;

let receivedAt = -Infinity, mapPanel, charts, histogram, timelinePanel, requested = 0, isOtherRequested = false, isPaintScheduled = false;

// Shows the reason if a promise fails.
const report = (promise) => promise.catch((error) => showProblem(error.message));

function paint() {
  isPaintScheduled = false;
  if (!page.moment) return;
  page.paints += 1;
  mapPanel.paint();
  histogram.paint();
  charts.moveRule();
  timelinePanel.refresh();
  showLastEvents(chooseTti);
  showRunState();
  noteAddress();
  byId("scrubber").value = page.tti;
  byId("scrubber").setAttribute("aria-valuetext", `TTI ${page.tti}`);
  if (document.activeElement !== byId("tti")) byId("tti").value = page.tti;
  byId("follow").setAttribute("aria-pressed", page.follows);
}

function schedulePaint() {
  if (isPaintScheduled) return;
  isPaintScheduled = true;
  requestAnimationFrame(paint);
}

// Shows a TTI that is still in memory.
async function show(tti) {
  const { first, next } = page.now;
  if (next <= first) return;
  page.tti = Math.max(first, Math.min(tti, next - 1));
  // Answers can arrive out of order: only the newest request is shown.
  const own = ++requested;
  const [moment, other] = await Promise.all([get(`api/tti/${page.tti}`), otherMoment(page.tti)]);
  if (own !== requested) return;
  page.moment = moment;
  if (page.other) page.other.moment = other;
  schedulePaint();
  mapPanel.refreshHeat();
  report(showDevice());
  if (byId("filters").here.checked) report(showMessages());
}

function chooseTti(tti) {
  showNote("");
  page.follows = false;
  return report(show(tti));
}

function chooseDevice(device) {
  page.device = device;
  schedulePaint();
  report(showDevice());
}

// Shows the TTI and the device of an address.
async function showAddress({ tti, device }) {
  chooseDevice(device === null ? -1 : Math.min(device, page.run.devices - 1));
  const { first, next } = page.now;
  if (tti === null) return page.run.live ? follow() : chooseTti(first);
  await chooseTti(tti);
  if (tti < first) showNote(`TTI ${tti} is not in memory any more`);
  if (tti >= next) showNote(`the run has not reached TTI ${tti}`);
}

function receive(now) {
  page.now = now;
  page.updates += 1;
  byId("scrubber").min = now.first;
  byId("scrubber").max = Math.max(now.next - 1, now.first);
  showProblem(now.broken ?? (now.reachable ? "" : "The base station has left the bus. The page continues when it returns."));
  if (page.follows && now.next > now.first) {
    page.tti = now.next - 1;
    page.moment = now;
    receiveOther();
  }
  schedulePaint();
}

// With reduced motion, the page changes twice a second. The last update is not lost: the program repeats it.
function receiveLive(now) {
  const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (isCalm && !now.over && performance.now() < receivedAt + CALM_INTERVAL) return;
  receivedAt = performance.now();
  const wasOver = page.now.over;
  receive(now);
  // The program ends soon after the run: reads the curves and the device a last time.
  if (now.over && !wasOver) refreshOften();
}

// One request at a time, since updates can come faster than answers.
function receiveOther() {
  if (!page.other || isOtherRequested || page.tti >= page.other.run.ttis) return;
  isOtherRequested = true;
  otherMoment(page.tti).then((moment) => {
    isOtherRequested = false;
    if (page.follows) page.other.moment = moment;
  });
}

function follow() {
  showNote("");
  page.follows = true;
  timelinePanel.change((view) => { view.follows = true; });
  receive(page.now);
}

function bookmark() {
  if (page.bookmarks.includes(page.tti)) return;
  page.bookmarks.push(page.tti);
  page.bookmarks.sort((a, b) => a - b);
  byId("bookmarks").hidden = false;
  byId("bookmarks").replaceChildren(...page.bookmarks.map((tti) => element("button", { textContent: `TTI ${tti}`, onclick: () => chooseTti(tti) })));
}

function repaint() {
  refreshTheme();
  charts.show();
  schedulePaint();
  report(showDevice());
}

function listen() {
  byId("back").onclick = () => chooseTti(page.tti - 1);
  byId("forward").onclick = () => chooseTti(page.tti + 1);
  byId("scrubber").oninput = (event) => chooseTti(+event.target.value);
  byId("tti").onchange = (event) => chooseTti(+event.target.value);
  byId("follow").hidden = byId("timeline-follow").hidden = !page.run.live;
  byId("follow").onclick = follow;
  byId("bookmark").onclick = bookmark;
  // On a phone, these buttons show the rest of the controls.
  for (const button of document.querySelectorAll(".more")) {
    button.onclick = () => button.setAttribute("aria-expanded", byId(button.getAttribute("aria-controls")).classList.toggle("open"));
  }
  byId("next-miss").onclick = () => report(showMiss(true, chooseTti));
  byId("previous-miss").onclick = () => report(showMiss(false, chooseTti));
  byId("device").max = page.run.devices - 1;
  byId("device").onchange = ({ target }) => chooseDevice(target.value === "" ? -1 : Math.max(0, Math.min(+target.value, page.run.devices - 1)));
  byId("close-device").onclick = () => chooseDevice(-1);
  const clockKeys = page.run.controls ? { " ": pauseOrResume, s: () => command("step?n=1") } : {};
  startKeys({
    ArrowLeft: (count) => chooseTti(page.tti - count), ArrowRight: (count) => chooseTti(page.tti + count),
    n: () => report(showMiss(true, chooseTti)), p: () => report(showMiss(false, chooseTti)),
    l: () => page.run.live && follow(), b: bookmark, "?": () => byId("keys").showModal(), ...clockKeys,
  });
  addEventListener("resize", repaint);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
}

// Refreshes everything that the stream of updates does not contain.
let refreshTimer;
async function refreshOften() {
  clearTimeout(refreshTimer);
  try {
    page.points = await get("api/curves");
    if (page.other) {
      page.other.points = await get("api/other/curves");
      await showCompare(chooseTti);
    }
    await mapPanel.refreshHeat();
  } catch { /* the status line reports a lost connection */ }
  charts.show();
  if (page.follows && page.device >= 0) report(showDevice());
  schedulePaint();
  clearTimeout(refreshTimer);
  if (!page.now.over) refreshTimer = setTimeout(refreshOften, 1000);
}

// Keeps the table of messages at the latest TTI.
async function refreshMessages() {
  // New rows would take the focus away from the reader's.
  const isRead = byId("messages").contains(document.activeElement);
  const isDue = page.follows && !document.hidden && !isRead && byId("filters").here.checked;
  if (isDue) await report(showMessages());
  if (!page.now.over) setTimeout(refreshMessages, 400);
}

async function begin() {
  page.run = await get("api/run");
  page.onChooseTti = chooseTti;
  page.onPause = refreshOften;
  page.now = await get("api/now");
  page.moment = page.now;
  if (page.run.compared) await startCompare();
  showAbout();
  mapPanel = new MapPanel(chooseDevice);
  charts = new Charts(byId("charts"), chooseTti);
  histogram = new Histogram(byId("charts"));
  timelinePanel = new TimelinePanel({ onChooseDevice: chooseDevice, onChooseTti: chooseTti });
  startEvents();
  startMessages(report);
  listen();
  page.follows = page.run.live && linked.tti === null;
  if (page.run.controls) {
    startActions();
    report(startClock());
  }
  receive(page.now);
  followAddress(showAddress);
  await showAddress(linked);
  refreshOften();
  refreshMessages();
  if (page.run.live) followRun(receiveLive, (error) => {
    if (!page.now.over) showProblem(error.message);
    return page.now.over;
  });
}

begin().catch((error) => {
  byId("state").textContent = "not connected";
  showProblem(error.message);
});
