// The address of the page: after `#`, the token of the run, then the shown TTI and the chosen device, such as #TOKEN&tti=40&device=7.

import { page } from "./page_state.js";

// Browsers limit how often a page may change its address.
const WRITE_INTERVAL = 250;

function parse(hash) {
  const parts = hash.slice(1).split("&"), fields = new URLSearchParams(parts.filter((part) => part.includes("=")).join("&"));
  const number = (name) => (/^\d+$/.test(fields.get(name) ?? "") ? +fields.get(name) : null);
  return { token: parts.find((part) => part && !part.includes("=")) ?? "", tti: number("tti"), device: number("device") };
}

const { token, ...first } = parse(location.hash);
export { token };
// The TTI and the device of the link that opened the page; null if it has none.
export const linked = first;

let timer, onChange;

function write() {
  timer = undefined;
  const parts = [token, page.follows ? "" : `tti=${page.tti}`, page.device < 0 ? "" : `device=${page.device}`].filter(Boolean);
  const hash = parts.length ? `#${parts.join("&")}` : "";
  if (hash !== location.hash) history.replaceState(null, "", hash || location.pathname);
}

// Keeps the address up to date with the shown TTI and the chosen device.
export function noteAddress() {
  timer ??= setTimeout(write, WRITE_INTERVAL);
}

// Calls `act` with the TTI and the device of an address that the reader has changed.
export function followAddress(act) {
  onChange = act;
}

addEventListener("hashchange", ({ newURL }) => {
  // `write` may have replaced the hash meanwhile.
  const address = parse(new URL(newURL).hash);
  // The address of another run on the same port differs in its token, which alone would not load the page again.
  if (address.token !== token) location.reload();
  else onChange?.(address);
});
