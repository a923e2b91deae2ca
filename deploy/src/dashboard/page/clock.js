// The clock of the run: pause, step, run to, resume, pace.

import { get, post } from "./api.js";
import { byId, page } from "./page_state.js";
import { runState, showRunState } from "./run_state.js";

const POLL_INTERVAL = 1000;

// A pace in milliseconds; the clock reports it as "Max" or in microseconds per TTI. "Max" is the empty text, in whose place
// the field shows `max`.
const milliseconds = ({ RealTime: micros }) => (micros ? micros / 1000 : "");

// Shows the pace of the clock when it changes: a number typed but not yet set stays in the field.
let shownPace;
function showPace(pace) {
  if (pace === shownPace) return;
  shownPace = pace;
  byId("pace").value = pace;
}

// Shows a status. Returns whether the clock is paused, or runs to the end.
function showStatus({ status }) {
  // The curves of a paused run do not wait for their next refresh.
  if (status.paused && page.clock?.tti !== status.tti) page.onPause();
  page.clock = status;
  const isStopping = status.until < status.ttis;
  showPace(milliseconds(status.pace));
  byId("pause").textContent = status.paused || isStopping ? "Resume" : "Pause";
  const hosts = status.hosts.filter(({ lost }) => lost).map(({ host, name, first, last }) => `host ${host} (devices ${first} to ${last}, ${name})`);
  const notes = [hosts.length ? `waiting for ${hosts.join(", ")}` : "", isStopping && !status.paused ? `to stop before TTI ${status.until}` : ""];
  byId("clock-note").textContent = notes.filter(Boolean).join("; ");
  showRunState();
  return status.paused || !isStopping;
}

// Sends a command, and polls the status until the command is carried out.
let commands = 0;
export async function command(text) {
  // A newer command ends the polling of an older one.
  const own = ++commands;
  try {
    let isDone = showStatus(await post(`api/clock/${text}`));
    while (!isDone && own === commands) {
      await new Promise((resolve) => setTimeout(resolve, 100));
      isDone = showStatus(await get("api/clock"));
    }
  } catch (error) {
    byId("clock-note").textContent = error.message;
  }
}

export const pauseOrResume = () => command(byId("pause").textContent === "Pause" ? "pause" : "resume");

// Keeps the status up to date, since other programs can drive the clock too.
async function poll() {
  if (!document.hidden && !page.now.over) await get("api/clock").then(showStatus, () => showRunState());
  if (["finished", "interrupted"].includes(runState())) disable();
  else setTimeout(poll, POLL_INTERVAL);
}

function disable() {
  for (const control of byId("clock").querySelectorAll("button, input")) control.disabled = true;
  byId("clock-note").textContent = "the run has ended";
}

export function startClock() {
  byId("clock").hidden = false;
  byId("pause").onclick = pauseOrResume;
  byId("step").onclick = () => command("step?n=1");
  byId("run-to").onclick = () => command(`run-to?n=${+byId("target").value || 0}`);
  byId("set-pace").onclick = () => {
    // Shows the pace as set, also if it equals the one before.
    shownPace = undefined;
    command(`pace?n=${Math.round(1000 * byId("pace").value)}`);
  };
  return poll();
}
