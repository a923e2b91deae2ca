// Files of a panel: its picture as PNG and its data as CSV.

import { element, page } from "./page_state.js";
import { ink } from "./theme.js";

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

// A copy of a canvas below a title, on the colour of the page.
function titledPicture(canvas, title) {
  const ratio = devicePixelRatio || 1, top = Math.round(34 * ratio), edge = Math.round(10 * ratio);
  const picture = element("canvas"), draw = picture.getContext("2d");
  const text = `${title} · ${page.run.run} · TTI ${page.tti}`, font = `${14 * ratio}px system-ui, sans-serif`;
  draw.font = font;
  picture.width = Math.max(canvas.width, Math.ceil(draw.measureText(text).width)) + 2 * edge;
  picture.height = canvas.height + top + edge;
  draw.fillStyle = ink("--paper");
  draw.fillRect(0, 0, picture.width, picture.height);
  draw.fillStyle = ink("--ink");
  // A new size resets the font.
  draw.font = font;
  draw.textBaseline = "middle";
  draw.fillText(text, edge, top / 2);
  draw.drawImage(canvas, edge, top);
  return picture;
}

// Draws rows of text, for panels without a canvas.
function tablePicture(rows) {
  const canvas = element("canvas"), draw = canvas.getContext("2d"), font = "13px ui-monospace, monospace";
  draw.font = font;
  const widths = rows[0].map((_, column) => Math.max(...rows.map((row) => draw.measureText(String(row[column])).width)) + 16);
  canvas.width = Math.min(widths.reduce((sum, width) => sum + width, 0), 4000);
  canvas.height = Math.min(20 * rows.length, 8000);
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
  return canvas;
}

// Adds buttons to the heading of a panel. `rows` returns the rows of the CSV file, or a promise; the first is its header.
export function addExport(heading, { name, title, canvas, rows }) {
  const file = (kind) => `${page.run.run}-${name}-tti-${page.tti}.${kind}`;
  const png = element("button", { type: "button", textContent: "PNG", title: `Save ${title} as a picture` });
  const csv = element("button", { type: "button", textContent: "CSV", title: `Save the data of ${title}` });
  png.setAttribute("aria-label", `Save ${title} as PNG`);
  csv.setAttribute("aria-label", `Save ${title} as CSV`);
  png.onclick = async () => {
    const source = canvas ? canvas() : tablePicture(await rows());
    titledPicture(source, title).toBlob((blob) => save(file("png"), blob));
  };
  csv.onclick = async () => save(file("csv"), new Blob([csvText(await rows())], { type: "text/csv" }));
  heading.append(element("span", { className: "export" }, png, csv));
}
