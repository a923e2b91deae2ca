// The page: its contents, and the actions of its reader.

import { get, live, post } from "./api.js";
import { Charts, history, ramp } from "./charts.js";
import { Map } from "./map.js";

const by = (id) => document.getElementById(id);
const page = { run: null, now: null, tti: 0, follows: true, moment: null, device: -1, points: [], marks: [], updates: 0, other: null };
// For tests, and for a look from the console.
window.reveille = page;
let map, otherMap, charts, asked = 0, otherIsRequested = false;

function tell(text, isAlarm = false) {
  by("state").textContent = text;
  by("state").className = isAlarm ? "alarm" : "";
}

function names(devices) {
  return devices.length > 8 ? `${devices.slice(0, 8).join(", ")} … (${devices.length})` : devices.join(", ");
}

function happened(moment) {
  const said = [];
  if (moment.event) said.push(`event ${moment.event.event}`);
  if (moment.reported?.length) said.push(`reported: ${names(moment.reported)}`);
  if (moment.lost?.length) said.push(`lost: ${names(moment.lost)}`);
  if (moment.failed?.length) said.push(`lacked energy to report: ${names(moment.failed)}`);
  for (const { device, text } of moment.woken ?? []) said.push(`${device} woken, ${text}`);
  if (moment.ended) said.push(moment.ended.delay === null ? "missed" : `ended, delay ${moment.ended.delay}, I ${moment.ended.information.toFixed(3)}`);
  return said.join(" · ");
}

function paint() {
  if (!page.moment) return;
  map.paint(page.moment, page.device);
  charts.paint(page.points, page.other?.points ?? [], Math.max(page.now.next, 1), page.tti);
  if (page.other?.moment) {
    otherMap.paint(page.other.moment, page.device);
    by("other-happened").textContent = `${page.other.run.run}: ${happened(page.other.moment) || "no events"}`;
  }
  by("happened").textContent = happened(page.moment);
  by("map").setAttribute("aria-label", `Map of ${page.run.devices} devices in TTI ${page.tti}. ${happened(page.moment)}`);
  by("scrubber").value = page.tti;
  if (document.activeElement !== by("tti")) by("tti").value = page.tti;
  by("follow").setAttribute("aria-pressed", page.follows);
}

// Shows a TTI that is still in memory.
async function show(tti) {
  const { first, next } = page.now;
  page.tti = Math.max(first, Math.min(tti, next - 1));
  if (next <= first) return;
  // Answers can arrive out of order: only the newest request is shown.
  const own = ++asked;
  const [moment, otherMoment] = await Promise.all([get(`api/tti/${page.tti}`), getOther(page.tti)]);
  if (own !== asked) return;
  page.moment = moment;
  if (page.other) page.other.moment = otherMoment;
  paint();
  if (page.device >= 0) refresh(showDevice);
  if (by("filters").here.checked) showMessages();
}

// The same TTI of the other run, or null if that run has no such TTI.
async function getOther(tti) {
  return page.other ? get(`api/other/tti/${tti}`).catch(() => null) : null;
}

// Lists the first differences between the two runs.
async function compare() {
  const told = await get("api/compare");
  if (JSON.stringify(told) === by("differences").dataset.told) return;
  by("differences").dataset.told = JSON.stringify(told);
  const names = (devices) => (devices.length ? `, of ${devices.length} devices` : "");
  by("fields").textContent = told.fields.map(([name, own, other]) => `${name}: ${own}, other ${other}`).join(" · ");
  by("differences").replaceChildren(...told.differences.map((difference, nth) => {
    const line = document.createElement("li"), jump = document.createElement("button");
    jump.textContent = `TTI ${difference.tti}`;
    jump.onclick = () => go(difference.tti);
    line.append(jump, ` ${nth ? "then" : "first difference"}: ${difference.kind}${names(difference.devices)}`);
    for (const [name, text] of [["this", difference.this], ["other", difference.other]]) {
      const said = document.createElement("span");
      said.textContent = `${name}: ${text}`;
      line.append(said);
    }
    return line;
  }));
  const end = told.compared;
  by("compared").textContent = told.differences.length ? "" : `no difference in TTIs 0 to ${end - 1}`;
}

function go(tti) {
  page.follows = false;
  return show(tti).catch((error) => tell(error.message, true));
}

function see(now) {
  page.now = now;
  page.updates += 1;
  by("scrubber").min = now.first;
  by("scrubber").max = Math.max(now.next - 1, now.first);
  const end = now.over ? (now.next < page.run.ttis ? "interrupted or failed" : "finished") : "running";
  tell(`${end} · TTI ${now.next} of ${page.run.ttis} · ${now.events} events counted, ${now.missed} missed · ${now.messages} messages`);
  // Unchanged entries stay in place: a click could miss an entry that is being replaced.
  const told = JSON.stringify(now.ticker);
  if (told !== by("ticker").dataset.told) {
    by("ticker").dataset.told = told;
    showTicker(now);
  }
  if (now.broken) tell(now.broken, true);
  if (page.follows && now.next > now.first) {
    page.tti = now.next - 1;
    page.moment = now;
    // One request at a time, since updates can come faster than answers.
    if (page.other && !otherIsRequested && page.tti < page.other.run.ttis) {
      otherIsRequested = true;
      getOther(page.tti).then((moment) => {
        otherIsRequested = false;
        if (page.follows) page.other.moment = moment;
      });
    }
    requestAnimationFrame(paint);
  }
}

function showTicker(now) {
  by("ticker").replaceChildren(...now.ticker.map(({ tti, text, who }) => {
    const line = document.createElement("li"), jump = document.createElement("button");
    jump.textContent = `TTI ${tti}`;
    jump.onclick = () => go(tti);
    line.append(jump, ` ${text}${who.length ? ` (${who.join(", ")})` : ""}`);
    return line;
  }));
}

// Refreshes a view, or shows why that failed.
const refresh = (show) => show().catch((error) => tell(error.message, true));

async function showDevice() {
  const device = page.device;
  const from = Math.max(page.now.first, page.tti - 300), end = Math.min(page.now.next, page.tti + 100);
  const told = await get(`api/device/${device}?from=${from}&end=${end}&at=${page.tti}`);
  // Another device was chosen during the request.
  if (device !== page.device) return;
  by("device").value = device;
  by("one").hidden = false;
  by("one-title").textContent = `Device ${page.device}, TTIs ${told.from} to ${told.from + told.batteries.length - 1}`;
  history(by("history"), told, page.run.e_max[page.device], page.tti);
  const share = (states) => Math.round((100 * [...told.states].filter((s) => states.includes(s)).length) / told.states.length);
  by("ledger").textContent = `battery ${told.batteries[page.tti - told.from]?.toFixed(2)} · S1 ${share("1")} % · S3 ${share("23")} % · S4 ${share("4")} % · unpowered ${share("0")} % of these TTIs`;
  const sums = told.totals;
  if (!sums) return;
  const unit = (value) => +value.toPrecision(4);
  by("ledger").textContent += ` — since TTI 0: ${unit(sums.initial)} initial + ${unit(sums.harvested)} harvested − ${unit(sums.sensing)} sensing − ${unit(sums.sleep)} sleep − ${unit(sums.report)} reports − ${unit(sums.overflow)} overflow = ${unit(sums.battery)}; sensed in ${sums.sensing_ttis} TTIs, lacked energy to report in ${sums.failed_ttis}, unpowered in ${sums.unpowered_ttis}`;
}

async function showMessages() {
  const form = by("filters"), wanted = new URLSearchParams();
  for (const name of ["plane", "kind", "device", "cluster", "state"]) if (form[name].value) wanted.set(name, form[name].value);
  const here = form.here.checked;
  const since = here ? Math.max(page.tti - 5, 0) : form.since.value, until = here ? page.tti : form.until.value;
  if (since !== "") wanted.set("since", since);
  if (until !== "") wanted.set("until", until);
  const rows = await get(`api/messages?${wanted}`).catch((error) => {
    by("refused").textContent = error.message;
    return null;
  });
  if (!rows) return;
  by("refused").textContent = rows.length ? "" : "no messages match";
  const body = by("messages").tBodies[0];
  body.replaceChildren(...rows.map((row) => {
    const line = document.createElement("tr");
    line.tabIndex = 0;
    line.dataset.id = row.id;
    for (const name of ["tti", "plane", "kind", "whose", "bytes", "text"]) {
      const cell = document.createElement("td");
      cell.textContent = row[name];
      line.append(cell);
    }
    return line;
  }));
}

async function showMessage(id) {
  const { message, hex } = await get(`api/message/${id}`);
  by("decoded").textContent = JSON.stringify(message, null, 2);
  by("hex").textContent = hex.replace(/(..)/g, "$1 ").replace(/(.{48})/g, "$1\n");
  by("detail").showModal();
}

// Returns a pace in milliseconds; the clock reports it as "Max" or in microseconds per TTI.
const milliseconds = ({ RealTime: micros }) => (micros ? micros / 1000 : 0);

function stands({ status, text }) {
  by("said").textContent = text;
  if (document.activeElement !== by("pace")) by("pace").value = milliseconds(status.pace);
  by("pause").textContent = status.paused || status.until < status.ttis ? "Resume" : "Pause";
  return status.paused || status.until >= status.ttis;
}

// Sends the clock a command, and polls its status until the command is carried out.
let driven = 0;
async function drive(command) {
  // A newer command ends the polling of an older one.
  const own = ++driven;
  try {
    let done = stands(await post(`api/clock/${command}`));
    while (!done && own === driven) {
      await new Promise((go) => setTimeout(go, 100));
      done = stands(await get("api/clock"));
    }
  } catch (error) {
    by("said").textContent = error.message;
  }
}

function mark() {
  if (page.marks.includes(page.tti)) return;
  page.marks.push(page.tti);
  page.marks.sort((a, b) => a - b);
  by("marks").replaceChildren(...page.marks.map((tti) => {
    const button = document.createElement("button");
    button.textContent = `TTI ${tti}`;
    button.onclick = () => go(tti);
    return button;
  }));
}

function repaint() {
  paint();
  if (page.device >= 0) refresh(showDevice);
}

function choose(device) {
  page.device = device;
  repaint();
}

function follow() {
  page.follows = true;
  see(page.now);
}

const pause = () => drive(by("pause").textContent === "Pause" ? "pause" : "resume");

function listen() {
  by("back").onclick = () => go(page.tti - 1);
  by("forward").onclick = () => go(page.tti + 1);
  by("scrubber").oninput = (event) => go(+event.target.value);
  by("tti").onchange = (event) => go(+event.target.value);
  by("follow").onclick = follow;
  by("mark").onclick = mark;
  by("pause").onclick = pause;
  by("step").onclick = () => drive("step?n=1");
  by("run-to").onclick = () => drive(`run-to?n=${+by("target").value || 0}`);
  by("set-pace").onclick = () => drive(`pace?n=${Math.round(1000 * by("pace").value)}`);
  by("map").onclick = (event) => {
    choose(map.near(event));
  };
  by("device").max = page.run.devices - 1;
  by("device").onchange = (event) => choose(Math.max(0, Math.min(+event.target.value, page.run.devices - 1)));
  by("filters").onsubmit = (event) => {
    event.preventDefault();
    refresh(showMessages);
  };
  by("messages").tBodies[0].addEventListener("click", (event) => {
    const line = event.target.closest("tr");
    if (line) refresh(() => showMessage(line.dataset.id));
  });
  by("messages").tBodies[0].addEventListener("keydown", (event) => {
    if (event.key === "Enter") refresh(() => showMessage(event.target.dataset.id));
  });
  addEventListener("keydown", (event) => {
    if (event.target.closest("input, select, dialog, tr") || event.ctrlKey || event.metaKey || event.altKey) return;
    const many = event.shiftKey ? 10 : 1;
    const does = {
      ArrowLeft: () => go(page.tti - many),
      ArrowRight: () => go(page.tti + many),
      " ": () => page.run.controls && pause(),
      s: () => page.run.controls && drive("step?n=1"),
      l: follow,
      b: mark,
    }[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!does || (event.key === " " && event.target.closest("button"))) return;
    event.preventDefault();
    does();
  });
  addEventListener("resize", repaint);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
}

async function curves() {
  try {
    page.points = await get("api/curves");
    if (page.other) {
      page.other.points = await get("api/other/curves");
      await compare();
    }
  } catch { /* the stream reports it */ }
  if (!page.now?.over) setTimeout(curves, 1000);
  if (page.follows && page.device >= 0) refresh(showDevice);
  if (page.follows && by("filters").here.checked) refresh(showMessages);
  paint();
}

async function begin() {
  page.run = await get("api/run");
  const { run, policy, devices, seed, preset } = page.run;
  document.title = `${run} · Reveille`;
  by("run").textContent = run;
  by("about").textContent = `${policy} · ${devices} devices · seed ${seed} · preset ${preset}`;
  by("clock").hidden = !page.run.controls;
  by("legend").innerHTML = `<span>battery <i style="background:${ramp()}"></i> full</span><span>● S1 senses</span><span>▲ S3 reports</span><span>■ S4 sleeps</span><span>✕ unpowered</span><span>✶ event, d_max around it</span><span>• believed position of the event (base station)</span>`;
  map = new Map(by("map"), page.run);
  charts = new Charts(by("charts"), go);
  page.now = await get("api/now");
  if (page.run.compared) {
    page.other = { run: (await get("api/compare")).other, moment: null, points: [] };
    otherMap = new Map(by("other"), page.other.run);
    by("other-figure").hidden = by("compare").hidden = false;
    by("compare-title").textContent = `Compared with ${page.other.run.run}: ${page.other.run.policy}, seed ${page.other.run.seed}`;
  }
  listen();
  see(page.now);
  if (!page.run.live) page.follows = false;
  await show(page.run.live ? page.now.next - 1 : page.now.first);
  if (page.run.live) page.follows = true;
  if (page.run.controls) {
    stands(await get("api/clock"));
  }
  curves();
  if (page.run.live) live(see, (error) => { tell(error.message, true); return page.now?.over; });
}

begin().catch((error) => tell(error.message, true));
