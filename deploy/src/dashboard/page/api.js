// Requests from the page to the program.

import { token } from "./address.js";

const headers = token ? { "x-reveille-token": token } : {};

async function request(path, method) {
  const answer = await fetch(path, { headers, method }).catch(() => {
    throw new Error("the program that served this page has ended; start a run with --hold, or record it with --record, to look back");
  });
  if (answer.ok) return answer;
  // Another machine may not read without the token, and no page may change the run.
  if (answer.status === 401) throw new Error("this page needs the address that the program printed (it contains a token)");
  const isJson = answer.headers.get("content-type")?.startsWith("application/json");
  const reason = isJson ? (await answer.json()).error : await answer.text();
  throw new Error(reason || answer.statusText);
}

export const get = async (path) => (await request(path, "GET")).json();
export const getBytes = async (path) => (await request(path, "GET")).arrayBuffer();
export const post = async (path) => (await request(path, "POST")).json();

// Calls `onUpdate` with each update, and `onLost` when the connection ends. Connects again unless `onLost` returns true.
export async function followRun(onUpdate, onLost) {
  for (;;) {
    try {
      const answer = await request("api/live", "GET");
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let held = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        held += value;
        // The last part may still be incomplete.
        const parts = held.split("\n\n");
        held = parts.pop();
        // Of several events in one read the last is enough.
        if (parts.length) onUpdate(JSON.parse(parts.at(-1).slice("data: ".length)));
      }
      throw new Error("the program has ended");
    } catch (error) {
      if (onLost(error)) return;
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}
