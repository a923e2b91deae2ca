// The files of the run folder, or the recording, as links.

import { get, getBytes } from "./api.js";
import { shortNumber } from "./axis.js";
import { save } from "./export.js";
import { byId, element, page } from "./page_state.js";

function fileLink({ name, bytes }) {
  const href = `api/files/${name.split("/").map(encodeURIComponent).join("/")}`, file = name.split("/").at(-1);
  const link = element("a", { href, download: file, textContent: name });
  const note = element("span", { className: "note" }, ` ${shortNumber(bytes)} bytes`);
  // A link does not send the token, which a dashboard beyond loopback requires.
  if (page.run.needs_token) {
    link.onclick = (event) => {
      event.preventDefault();
      const showError = (error) => { note.textContent = ` ${error.message}`; };
      getBytes(href).then((content) => save(file, new Blob([content])), showError);
    };
  }
  return element("li", {}, link, note);
}

// Shows the list of the files.
export async function showFiles() {
  byId("file-list").replaceChildren(...(await get("api/files")).map(fileLink));
  byId("files").showModal();
}
