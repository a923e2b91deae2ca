// Actions of the operator on the chosen device: fail, revive, add energy.

import { ttiText } from "./axis.js";
import { post } from "./api.js";
import { byId, page } from "./page_state.js";
import { runState } from "./run_state.js";

async function act(path) {
  try {
    const { tti, text } = await post(`api/act/${path}`);
    byId("action-note").textContent = `${text} in TTI ${ttiText(tti)}`;
  } catch (error) {
    byId("action-note").textContent = error.message;
  }
}

// Enables the actions that have an effect on a device in this state.
export function showActions(state) {
  const isOver = ["finished", "interrupted"].includes(runState());
  byId("fail").disabled = isOver || state === "x";
  byId("revive").disabled = isOver || state !== "x";
  byId("add-energy").disabled = isOver;
}

export function startActions() {
  byId("device-actions").append(byId("action-controls").content);
  byId("fail").onclick = () => act(`fail?device=${page.device}`);
  byId("revive").onclick = () => act(`revive?device=${page.device}`);
  byId("add-energy").onclick = () => act(`energy?device=${page.device}&units=${+byId("energy-units").value}`);
}
