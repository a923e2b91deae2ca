// Ticks and numbers of axes.

// About `count` round values from `low` to `high`.
export function ticks(low, high, count, isWhole = false) {
  const rough = (high - low) / Math.max(count, 1);
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  let step = power * ([1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10);
  if (isWhole) step = Math.max(step, 1);
  const found = [];
  for (let nth = Math.ceil(low / step - 1e-9); nth * step <= high + step * 1e-9; nth += 1) found.push(+(nth * step).toPrecision(12));
  return found;
}

// Round values from 0 to the first one that is not below `high`, with room for their labels in this height in pixels: the lowest
// such end, then the shortest steps.
export function ticksAbove(high, height, isWhole = false) {
  if (!(high > 0)) return [0, 1];
  const power = 10 ** Math.floor(Math.log10(high)), most = Math.max(2, Math.min(6, Math.floor(height / 34)));
  const choices = [10, 5, 2, 1, 0.5, 0.2].map((factor) => ({ step: factor * power, steps: Math.ceil(high / (factor * power) - 1e-9) }));
  const fitting = choices.filter(({ step, steps }) => steps <= most && !(isWhole && step < 1));
  const { step, steps } = fitting.sort((a, b) => a.step * a.steps - b.step * b.steps || a.step - b.step)[0];
  return Array.from({ length: steps + 1 }, (_, nth) => +(nth * step).toPrecision(12));
}

// The values of a logarithmic axis that begins at 0, up to the first power of ten that is not below `high`.
export const decades = (high) => [0, ...Array.from({ length: Math.ceil(Math.log10(high) - 1e-9) + 1 }, (_, nth) => 10 ** nth)];

// A number with at most this many significant digits, and thousands as k.
export function shortNumber(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1e6) return `${+(value / 1e6).toPrecision(digits)}M`;
  if (size >= 1e4) return `${+(value / 1e3).toPrecision(digits)}k`;
  return String(+value.toPrecision(digits));
}

// The label of a tick, with all its digits: ticks next to each other differ.
export const tickText = (tick) => shortNumber(tick, 12);

// A number with four significant digits.
export const significant = (value) => +value.toPrecision(4);

// A TTI in full, with spaces between thousands.
export const ttiText = (tti) => String(tti).replace(/\B(?=(\d{3})+$)/g, "\u202f");

// Seconds as hours, minutes and seconds.
export function clockText(seconds) {
  const whole = Math.floor(seconds), two = (value) => String(value).padStart(2, "0");
  return `${Math.floor(whole / 3600)}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
}
