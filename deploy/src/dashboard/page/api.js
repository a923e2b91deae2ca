// Requests from the page to the program.

const token = location.hash.slice(1);
const headers = token ? { "x-reveille-token": token } : {};

export async function get(path, method = "GET") {
  const answer = await fetch(path, { headers, method });
  const isTold = answer.headers.get("content-type")?.startsWith("application/json");
  const found = isTold ? await answer.json() : { error: await answer.text() };
  if (!answer.ok) throw new Error(found.error ?? answer.statusText);
  return found;
}

export const post = (path) => get(path, "POST");

// Calls `see` with each update, and `lost` when the connection ends. Connects again unless `lost` returns true.
export async function live(see, lost) {
  for (;;) {
    try {
      const answer = await fetch("api/live", { headers });
      if (!answer.ok) throw new Error((await answer.json()).error);
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
        if (parts.length) see(JSON.parse(parts.at(-1).slice("data: ".length)));
      }
      throw new Error("the program has ended");
    } catch (error) {
      if (lost(error)) return;
      await new Promise((go) => setTimeout(go, 1000));
    }
  }
}
