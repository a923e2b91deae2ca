// The state of the run, with the names of `reveille clock status` and of the progress bar.

import { clockText, shortNumber, ttiText } from "./axis.js";
import { showFiles } from "./files.js";
import { byId, page, plural, setText } from "./page_state.js";

// The state from the latest update and the latest status of the clock.
export function runState() {
  const { now, run, clock } = page;
  if (now.over) return now.next < run.ttis ? "interrupted" : "finished";
  if (!run.live) return now.next < run.ttis ? "interrupted" : "finished";
  if (!now.reachable) return "waiting";
  // The first status of the clock arrives after the page's first update.
  if (!clock) return run.controls ? "connecting" : "running";
  if (!clock.begun) return "joining";
  if (clock.hosts.some(({ lost }) => lost)) return "waiting";
  return clock.paused ? "paused" : "running";
}

// The position of the run, in the words of `reveille clock status`.
function progressText(state) {
  const { now, run } = page, of = `of ${ttiText(run.ttis)}`;
  if (["finished", "interrupted"].includes(state)) return `after TTI ${ttiText(Math.max(now.next, 1) - 1)} ${of}`;
  return `${["paused", "joining"].includes(state) ? "before" : "at"} TTI ${ttiText(now.next)} ${of}`;
}

// The end of TTIs to which the sums belong, or the reason for their absence.
function countedText() {
  const { now, run } = page;
  if (now.next <= run.warm_up_end) return `warm-up until TTI ${ttiText(run.warm_up_end)}; nothing is counted yet`;
  return missedText(now);
}

function missedText({ events, missed }) {
  return events ? `${missed} of ${plural(events, "event")} missed (${shortNumber((100 * missed) / events)} %)` : "no event has been counted yet";
}

// The name of a run with the values in which compared runs often differ.
export const describeRun = ({ run, policy, seed }) => `${run} (${policy}, seed ${seed})`;

// Shows the constant data of the run, or of both runs.
export function showAbout() {
  const { run, other } = page, { preset, path } = run;
  const names = [run, other?.run].filter(Boolean).map(({ run: name }) => name).join(" and ");
  document.title = `${names} · Reveille`;
  byId("run").textContent = names;
  byId("counted").classList.toggle("this-run", Boolean(other));
  byId("other-counted").hidden = !other;
  const size = `${plural(run.devices, "device")} · preset ${preset}`;
  byId("about").textContent = other ? size : `${run.policy} · seed ${run.seed} · ${size}`;
  if (!path) return;
  byId("folder").hidden = false;
  // The mark keeps the leading slash in place: a long path is cut at its start, in a right-to-left box.
  byId("path").textContent = `\u200e${path}`;
  byId("path").title = path;
  byId("path").onclick = (event) => {
    event.preventDefault();
    showFiles().catch((error) => showProblem(error.message));
  };
  byId("copy-path").onclick = () => navigator.clipboard.writeText(path).then(() => { byId("copy-path").textContent = "Copied"; }, () => getSelection().selectAllChildren(byId("path")));
}

export function showRunState() {
  const { now, run } = page, state = runState(), chip = byId("state");
  if (chip.textContent !== state) {
    chip.textContent = state;
    chip.dataset.state = state;
  }
  setText(byId("progress"), progressText(state));
  setText(byId("counted"), page.other ? `this run, ${describeRun(run)}: ${countedText()}` : countedText());
  if (page.other) setText(byId("other-counted"), `other run, ${describeRun(page.other.run)}: ${missedText(page.other)}`);
  setText(byId("wall"), now.wall_s === null || !run.live ? "" : `${run.is_whole_wall_time ? "wall clock" : "watched for"} ${clockText(now.wall_s)}`);
  setText(byId("message-count"), page.other ? "" : `${ttiText(now.messages)} message${now.messages === 1 ? "" : "s"}`);
  const behind = now.next - 1 - page.tti;
  const end = run.live ? "the latest" : "the last";
  setText(byId("shown"), behind > 0 && !(page.follows && run.live) ? `${plural(behind, "TTI")} before ${end}` : end);
}

// Shows an error, or removes it.
export function showProblem(text = "") {
  setText(byId("problem"), text);
}
