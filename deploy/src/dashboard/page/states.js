// The states of devices with their names and colours, for the map, the timeline, the histogram and all legends.

import { element } from "./page_state.js";

// Colours are names of the style sheet. `shape` is the class of the mark in legends: devices that cannot act have lower ones.
export const STATES = {
  sensing: { name: "S1 senses", colour: "--sensing" },
  reporting: { name: "S3 reports after sensing", colour: "--reporting" },
  woken: { name: "S3 reports after a wake-up", colour: "--woken" },
  failed: { name: "lacked energy, or report lost", colour: "--failed" },
  asleep: { name: "S4 sleeps", colour: "--asleep" },
  unpowered: { name: "S4 unpowered", colour: "--unpowered", shape: "low" },
  out: { name: "failed by an operator", colour: "--out", shape: "flat" },
};

// States by their codes in answers of the program.
export const STATE_OF_CODE = { 0: "unpowered", 1: "sensing", 2: "reporting", 3: "reporting", 4: "asleep", x: "out" };

// The name of the state with this code. The code does not tell the reason for a report.
export const nameOfCode = (code) => ({ 2: "S2 active", 3: "S3 reports" })[code] ?? STATES[STATE_OF_CODE[code]]?.name ?? "";

// The mark of a state or of another colour in a legend.
export function colourBox(colour, shape = "") {
  const box = element("i", { className: `box ${shape}` });
  box.style.background = `var(${colour})`;
  return box;
}

export const stateEntry = (state, text = STATES[state].name) => element("span", {}, colourBox(STATES[state].colour, STATES[state].shape), text);

// The entry of a band of states, which marks the wake-up signal, not the report after it.
export const bandEntry = (state) => stateEntry(state, state === "woken" ? "wake-up sent" : undefined);
