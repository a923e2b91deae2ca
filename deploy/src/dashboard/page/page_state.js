// The state that the parts of the page share.

export const page = {
  // Constant data of the run, its latest state, and the compared run.
  run: null, now: null, other: null,
  // The shown TTI with its states; `follows` while it is the latest one.
  tti: 0, moment: null, follows: true,
  device: -1, points: [], bookmarks: [],
  // Numbers of updates received and painted.
  updates: 0, paints: 0,
};
// For tests, and for the browser's console.
window.reveille = page;

export const byId = (id) => document.getElementById(id);

// Creates an element with these properties and children.
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

// Sets the text of an element. An unchanged text costs no layout.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Shows a note about the shown TTI next to its controls.
export function showNote(text) {
  setText(byId("miss-note"), text);
}

export const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
