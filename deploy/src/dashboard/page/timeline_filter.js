// The devices that the timeline shows: by list, cluster, class, and state in the shown TTI.

import { page } from "./page_state.js";

// The numbers of a list such as "0-40, 57"; throws an error for anything else.
export function parseNumbers(text, end) {
  const numbers = new Set();
  for (const part of text.split(",").map((part) => part.trim()).filter(Boolean)) {
    const found = /^(\d+)(?:\s*-\s*(\d+))?$/.exec(part);
    if (!found) throw new Error(`“${part}” is not a number or a range; use a list such as 0-40, 57`);
    const first = +found[1], last = Math.min(+(found[2] ?? first), end - 1);
    if (first >= end) throw new Error(`${first} is too high; the last number is ${end - 1}`);
    for (let number = first; number <= last; number += 1) numbers.add(number);
  }
  return numbers;
}

const STATES = { S1: "1", S3: "23", S4: "4", unpowered: "0", failed: "x" };

// The devices that pass the fields of the form, in the order of ids.
export function filterDevices(form) {
  const { run, moment } = page;
  const listed = form.devices.value.trim() ? parseNumbers(form.devices.value, run.devices) : null;
  const clusters = form.cluster.value.trim() ? parseNumbers(form.cluster.value, Infinity) : null;
  const { value: deviceClass } = form.class, states = STATES[form.state.value];
  return Array.from({ length: run.devices }, (_, device) => device).filter((device) =>
    (!listed || listed.has(device))
    && (!clusters || clusters.has(run.groups?.[device]))
    && (deviceClass === "" || run.device_classes[device] === +deviceClass)
    && (!states || states.includes(moment.states[device])));
}
