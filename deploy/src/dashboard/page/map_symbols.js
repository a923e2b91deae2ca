// The symbols of devices on the map and in its legend.

import { STATES, STATE_OF_CODE } from "./states.js";
import { ink } from "./theme.js";

// The state of each device in a moment, as a key of `STATES`. Reports differ by the reason why the device was active.
export function symbolsOf(moment) {
  const symbols = [...moment.states].map((code) => STATE_OF_CODE[code]);
  for (const device of [...(moment.failed ?? []), ...(moment.lost ?? [])]) symbols[device] = "failed";
  for (const { device, outcome } of moment.woken ?? []) {
    if (outcome.Reported) symbols[device] = "woken";
    else if (outcome.Failed || outcome.Lost) symbols[device] = "failed";
  }
  return symbols;
}

function path(draw, points, x, y, size) {
  draw.beginPath();
  for (const [dx, dy] of points) draw.lineTo(x + dx * size, y + dy * size);
  draw.closePath();
}

// Symbols with an outline in the colour of their state; others have a cross in it, or none.
const OUTLINED = ["sensing", "reporting", "woken"];
const TRIANGLE = [[0, -1.6], [1.45, 1], [-1.45, 1]];
const DIAMOND = [[0, -1.7], [1.7, 0], [0, 1.7], [-1.7, 0]];

export function drawSymbol(draw, symbol, x, y, size, fill) {
  // Hollow without power: the battery is about empty, and starved parts of the map are seen at a glance.
  draw.fillStyle = symbol === "unpowered" ? ink("--field") : fill;
  draw.strokeStyle = ink("--ink");
  // A full line would leave little of a small symbol.
  draw.lineWidth = size < 3 ? 0.5 : 1;
  if (symbol === "reporting") path(draw, TRIANGLE, x, y, size);
  else if (symbol === "woken") path(draw, DIAMOND, x, y, size);
  else if (symbol === "sensing") {
    draw.beginPath();
    draw.arc(x, y, 1.1 * size, 0, 2 * Math.PI);
  } else {
    draw.beginPath();
    draw.rect(x - 0.75 * size, y - 0.75 * size, 1.5 * size, 1.5 * size);
  }
  if (OUTLINED.includes(symbol)) {
    draw.strokeStyle = ink(STATES[symbol].colour);
    draw.lineWidth = size < 3 ? 1.5 : 2.5;
  }
  draw.fill();
  // A full outline would hide the battery of a small symbol; without one, full batteries are pale on a light ground.
  draw.globalAlpha = size < 3 && symbol === "asleep" ? 0.5 : 1;
  draw.stroke();
  draw.globalAlpha = 1;
  if (symbol !== "unpowered" && symbol !== "failed" && symbol !== "out") return;
  draw.beginPath();
  // A failed device is crossed upright, so that its mark differs from lack of energy in shape too.
  if (symbol === "out") {
    draw.moveTo(x - 1.4 * size, y);
    draw.lineTo(x + 1.4 * size, y);
    draw.moveTo(x, y - 1.4 * size);
    draw.lineTo(x, y + 1.4 * size);
  } else for (const turn of [1, -1]) {
    draw.moveTo(x - size, y - turn * size);
    draw.lineTo(x + size, y + turn * size);
  }
  // The bright colour of a device without power needs an outline on a light ground.
  const lines = symbol === "unpowered" ? [["--ink", 2.5], [STATES[symbol].colour, 1.5]] : [[STATES[symbol].colour, 2.5]];
  for (const [colour, lineWidth] of lines) {
    Object.assign(draw, { strokeStyle: ink(colour), lineWidth });
    draw.stroke();
  }
}
