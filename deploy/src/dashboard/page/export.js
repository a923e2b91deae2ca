// Files of a panel: its picture as PNG and its data as CSV.

import { element, page } from "./page_state.js";
import { ink } from "./theme.js";

// Most rows in the picture of a table; browsers limit the height of a canvas.
const MAX_ROWS = 400;

// Saves a file from the page.
export function save(name, blob) {
  const link = element("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// Text of a CSV file with quotes around cells that need them.
export function csvText(rows) {
  const cell = (value) => (/[",\n]/.test(String(value)) ? `"${String(value).replaceAll('"', '""')}"` : String(value));
  return rows.map((row) => row.map(cell).join(",")).join("\n") + "\n";
}

// Paints the mark of a legend: a picture, a character in its colour, or a box.
function paintMark(draw, mark, x, y, ratio) {
  if (!mark) return;
  const style = getComputedStyle(mark);
  draw.globalAlpha = style.opacity;
  if (mark instanceof HTMLCanvasElement) draw.drawImage(mark, x, y - mark.height / 2);
  else {
    const text = mark.textContent.trim(), box = 11 * ratio;
    draw.fillStyle = text ? style.color : style.backgroundColor;
    // A state without power has a lower box.
    const height = Math.min(mark.offsetHeight * ratio, box) || box;
    if (text) draw.fillText(text, x + 4 * ratio, y);
    else draw.fillRect(x + 4 * ratio, y + box / 2 - height, box, height);
  }
  draw.globalAlpha = 1;
}

// The places of the entries of a legend in lines of at most `width` pixels, and the number of lines.
function placeEntries(legend, draw, width, ratio) {
  let x = 0, line = 0;
  const entries = [...legend?.children ?? []].filter((entry) => entry.textContent.trim() && !entry.matches(".hint")).map((entry) => {
    const text = entry.textContent.trim(), needed = draw.measureText(text).width + 44 * ratio;
    if (x > 0 && x + needed > width) [x, line] = [0, line + 1];
    x += needed;
    return { mark: entry.querySelector("canvas, i"), text, x: x - needed, line };
  });
  return { entries, lines: entries.length ? line + 1 : 0 };
}

// A copy of a canvas between a title and the entries of its legend, on the colour of the page.
function titledPicture(canvas, title, legend) {
  const ratio = devicePixelRatio || 1, top = Math.round(34 * ratio), edge = Math.round(10 * ratio), lineHeight = 22 * ratio;
  const picture = element("canvas"), draw = picture.getContext("2d");
  const text = `${title} · ${page.run.run} · TTI ${page.tti}`, font = `${14 * ratio}px system-ui, sans-serif`;
  draw.font = font;
  const width = Math.max(canvas.width, Math.ceil(draw.measureText(text).width)), { entries, lines } = placeEntries(legend, draw, width, ratio);
  picture.width = width + 2 * edge;
  picture.height = canvas.height + top + edge + lines * lineHeight;
  draw.fillStyle = ink("--paper");
  draw.fillRect(0, 0, picture.width, picture.height);
  draw.fillStyle = ink("--ink");
  // A new size resets the font.
  draw.font = font;
  draw.textBaseline = "middle";
  draw.fillText(text, edge, top / 2);
  draw.drawImage(canvas, edge, top);
  for (const entry of entries) {
    const x = edge + entry.x, y = top + canvas.height + (entry.line + 0.5) * lineHeight;
    paintMark(draw, entry.mark, x, y, ratio);
    draw.fillStyle = ink("--ink");
    draw.fillText(entry.text.replace(entry.mark?.textContent ?? "", "").trim(), x + 24 * ratio, y);
  }
  return picture;
}

// Draws rows of text, for panels without a canvas.
function tablePicture(all) {
  const rows = all.slice(0, MAX_ROWS), more = all.length - rows.length;
  const canvas = element("canvas"), draw = canvas.getContext("2d"), font = "13px ui-monospace, monospace";
  draw.font = font;
  const widths = rows[0].map((_, column) => Math.max(...rows.map((row) => draw.measureText(String(row[column])).width)) + 16);
  canvas.width = Math.min(widths.reduce((sum, width) => sum + width, 0), 4000);
  canvas.height = 20 * (rows.length + (more > 0));
  draw.font = font;
  draw.textBaseline = "middle";
  rows.forEach((row, nth) => {
    let x = 0;
    draw.fillStyle = ink(nth ? "--ink" : "--faint");
    row.forEach((value, column) => {
      draw.fillText(String(value), x, 20 * nth + 10);
      x += widths[column];
    });
  });
  if (more > 0) draw.fillText(`… ${more} more rows in the CSV file`, 0, 20 * rows.length + 10);
  return canvas;
}

// Adds buttons to the heading of a panel. `rows` returns the rows of the CSV file, or a promise; the first is its header.
// `legend` is the element of the legend, if the canvas lacks it.
export function addExport(heading, { name, title, canvas, rows, legend }) {
  const file = (kind) => `${page.run.run}-${name}-tti-${page.tti}.${kind}`;
  const png = element("button", { type: "button", textContent: "PNG", title: `Save ${title} as a picture` });
  const csv = element("button", { type: "button", textContent: "CSV", title: `Save the data of ${title}` });
  png.setAttribute("aria-label", `Save ${title} as PNG`);
  csv.setAttribute("aria-label", `Save ${title} as CSV`);
  png.onclick = async () => {
    const source = canvas ? canvas() : tablePicture(await rows());
    titledPicture(source, title, legend).toBlob((blob) => save(file("png"), blob));
  };
  csv.onclick = async () => save(file("csv"), new Blob([csvText(await rows())], { type: "text/csv" }));
  heading.append(element("span", { className: "export" }, png, csv));
}
