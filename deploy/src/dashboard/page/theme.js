// Colours of the page, from the style sheet, and canvases in device pixels.

import { sizeOf } from "./visibility.js";

let known = {};

// Forgets the colours after a change of the colour scheme.
export function refreshTheme() {
  known = {};
}

export function ink(name) {
  known[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  return known[name];
}

// A colour of the style sheet as red, green and blue.
export function rgb(name) {
  const digits = ink(name).slice(1);
  const wide = digits.length === 3 ? [...digits].map((digit) => digit + digit).join("") : digits;
  return [0, 2, 4].map((at) => parseInt(wide.slice(at, at + 2), 16));
}

// Cividis: dark to light, the same for all kinds of colour vision.
const SCALE = [[0, 34, 78], [53, 69, 108], [102, 105, 112], [148, 142, 119], [200, 184, 102], [254, 232, 56]];

export function batteryColour(share) {
  const at = Math.min(Math.max(share, 0), 1) * (SCALE.length - 1);
  const low = Math.min(Math.floor(at), SCALE.length - 2), part = at - low;
  return `rgb(${SCALE[low].map((from, i) => Math.round(from + (SCALE[low + 1][i] - from) * part)).join(",")})`;
}

// The battery of a device in a moment, from 0 to 1 of its E_max.
export const batteryShare = (moment, device) => parseInt(moment.batteries.slice(2 * device, 2 * device + 2), 16) / 255;

// Writes text that stays readable on lines and marks.
export function outlinedText(draw, text, x, y) {
  draw.lineWidth = 4;
  draw.lineJoin = "round";
  draw.strokeStyle = ink("--field");
  draw.strokeText(text, x, y);
  draw.fillStyle = ink("--ink");
  draw.fillText(text, x, y);
}

// Clears a canvas and fits its pixels to its size on the screen.
export function prepareCanvas(canvas) {
  const ratio = devicePixelRatio || 1, { width, height } = sizeOf(canvas);
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const draw = canvas.getContext("2d");
  draw.setTransform(ratio, 0, 0, ratio, 0, 0);
  draw.clearRect(0, 0, width, height);
  return { draw, width, height };
}

// A canvas that is not in the page, with the same scale.
export function hiddenCanvas(width, height) {
  const ratio = devicePixelRatio || 1, canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  const draw = canvas.getContext("2d");
  draw.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { canvas, draw };
}
