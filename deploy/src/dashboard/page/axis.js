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

// The values of a logarithmic axis that begins at 0.
export const decades = (high) => [0, ...Array.from({ length: Math.floor(Math.log10(high)) + 1 }, (_, nth) => 10 ** nth)];

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
