// The state of the run, with the names of `reveille clock status` and of the progress bar.

import { clockText, shortNumber, ttiText } from "./axis.js";
import { byId, page, plural, setText } from "./page_state.js";

// The state from the latest update and the latest status of the clock.
export function runState() {
  const { now, run, clock } = page;
  if (now.over) return now.next < run.ttis ? "interrupted" : "finished";
  if (!run.live) return now.next < run.ttis ? "interrupted" : "finished";
  if (!clock) return "running";
  if (!clock.begun) return "joining";
  if (clock.lost.length) return "waiting";
  return clock.paused ? "paused" : "running";
}

// The end of TTIs to which the sums belong, or the reason for their absence.
function countedText() {
  const { now, run } = page;
  if (now.next <= run.warm_up_end) return `warm-up until TTI ${ttiText(run.warm_up_end)}; nothing is counted yet`;
  const share = now.events ? ` (${shortNumber((100 * now.missed) / now.events)} %)` : "";
  return `${page.other ? "this run: " : ""}${now.missed} of ${plural(now.events, "event")} missed${share}`;
}

export function showRunState() {
  const { now, run } = page, state = runState(), chip = byId("state");
  if (chip.textContent !== state) {
    chip.textContent = state;
    chip.dataset.state = state;
  }
  setText(byId("progress"), now.next ? `TTI ${ttiText(now.next - 1)} of ${ttiText(run.ttis)}` : `before TTI 0 of ${ttiText(run.ttis)}`);
  setText(byId("counted"), countedText());
  setText(byId("wall"), now.wall_s === null || !run.live ? "" : `${run.is_whole_wall_time ? "wall clock" : "watched for"} ${clockText(now.wall_s)}`);
  setText(byId("message-count"), `${ttiText(now.messages)} messages`);
  const behind = now.next - 1 - page.tti;
  const end = run.live ? "the latest" : "the last";
  setText(byId("shown"), behind > 0 && !(page.follows && run.live) ? `${plural(behind, "TTI")} before ${end}` : end);
}

// Shows an error, or removes it.
export function showProblem(text = "") {
  setText(byId("problem"), text);
}
