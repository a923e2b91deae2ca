// The map: cells, devices by battery and state, the event.

// Cividis: dark to light, the same for all kinds of colour vision.
const SCALE = [[0, 34, 78], [53, 69, 108], [102, 105, 112], [148, 142, 119], [200, 184, 102], [254, 232, 56]];

export function colour(share) {
  const at = Math.min(Math.max(share, 0), 1) * (SCALE.length - 1);
  const low = Math.min(Math.floor(at), SCALE.length - 2), part = at - low;
  return `rgb(${SCALE[low].map((from, i) => Math.round(from + (SCALE[low + 1][i] - from) * part)).join(",")})`;
}

export function sharp(canvas) {
  const ratio = devicePixelRatio || 1, { width, height } = canvas.getBoundingClientRect();
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const draw = canvas.getContext("2d");
  draw.setTransform(ratio, 0, 0, ratio, 0, 0);
  draw.clearRect(0, 0, width, height);
  return { draw, width, height };
}

export const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class Map {
  constructor(canvas, run) {
    this.canvas = canvas;
    this.run = run;
    this.ground = null;
    canvas.style.aspectRatio = `${run.area[0]} / ${run.area[1]}`;
  }

  place({ x, y }, width, height) {
    const edge = 10, [w, h] = this.run.area;
    return [edge + (x / w) * (width - 2 * edge), height - edge - (y / h) * (height - 2 * edge)];
  }

  // Returns the device closest to a position on the screen.
  near(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const far = (at) => Math.hypot(at[0] - x, at[1] - y);
    const all = this.run.positions.map((p) => far(this.place(p, box.width, box.height)));
    return all.indexOf(Math.min(...all));
  }

  // Paints the cells, which do not change, once for each size and colour scheme.
  cells(width, height) {
    const line = ink("--line"), ratio = devicePixelRatio || 1, key = [width, height, ratio, line].join();
    if (this.ground?.key === key) return this.ground.canvas;
    const canvas = document.createElement("canvas"), draw = canvas.getContext("2d");
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    draw.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.run.cells.forEach((corners, j) => {
      if (!corners.length) return;
      draw.beginPath();
      corners.map((p) => this.place(p, width, height)).forEach((at, i) => (i ? draw.lineTo(...at) : draw.moveTo(...at)));
      draw.closePath();
      if (this.run.groups) {
        // Steps of the golden angle keep the hues of neighbouring groups apart.
        draw.fillStyle = `hsl(${(this.run.groups[j] * 137.5) % 360} 40% 50% / .13)`;
        draw.fill();
      }
      draw.strokeStyle = line;
      draw.stroke();
    });
    this.ground = { key, canvas };
    return canvas;
  }

  paint(moment, chosen) {
    const { draw, width, height } = sharp(this.canvas);
    const at = (p) => this.place(p, width, height);
    const dark = ink("--ink"), accent = ink("--accent"), alarm = ink("--alarm");
    const size = Math.max(2.5, Math.min(8, width / 9 / Math.sqrt(this.run.devices)));
    const levels = (j) => parseInt(moment.batteries.slice(2 * j, 2 * j + 2), 16) / 255;
    draw.drawImage(this.cells(width, height), 0, 0, width, height);
    const most = Math.max(...(moment.belief ?? []).map((place) => place.share));
    for (const place of moment.belief ?? []) {
      const [x, y] = at(place);
      draw.beginPath();
      draw.arc(x, y, 2 + 4 * Math.sqrt(place.share / most), 0, 2 * Math.PI);
      draw.globalAlpha = 0.25 + 0.55 * (place.share / most);
      draw.fillStyle = accent;
      draw.fill();
      draw.globalAlpha = 1;
    }
    if (moment.event) {
      const [x, y] = at(moment.event.epicentre);
      draw.beginPath();
      draw.arc(x, y, (this.run.d_max / this.run.area[0]) * (width - 20), 0, 2 * Math.PI);
      draw.strokeStyle = alarm;
      draw.setLineDash([4, 4]);
      draw.lineWidth = 1.5;
      draw.stroke();
      draw.setLineDash([]);
      for (const device of [...(moment.reported ?? []), ...(moment.woken ?? []).map((w) => w.device)]) {
        draw.beginPath();
        draw.moveTo(...at(this.run.positions[device]));
        draw.lineTo(x, y);
        draw.lineWidth = 1;
        draw.strokeStyle = alarm;
        draw.stroke();
      }
    }
    this.run.positions.forEach((p, j) => {
      const [x, y] = at(p), state = moment.states[j];
      draw.fillStyle = colour(levels(j));
      draw.strokeStyle = dark;
      draw.lineWidth = 1;
      draw.beginPath();
      if (state === "3" || state === "2") {
        draw.moveTo(x, y - 1.6 * size);
        draw.lineTo(x + 1.4 * size, y + size);
        draw.lineTo(x - 1.4 * size, y + size);
        draw.closePath();
      } else if (state === "1") {
        draw.arc(x, y, 1.1 * size, 0, 2 * Math.PI);
        draw.strokeStyle = accent;
        draw.lineWidth = 2.5;
      } else {
        draw.rect(x - 0.7 * size, y - 0.7 * size, 1.4 * size, 1.4 * size);
      }
      draw.fill();
      draw.stroke();
      if (state === "0") {
        draw.beginPath();
        draw.moveTo(x - size, y - size);
        draw.lineTo(x + size, y + size);
        draw.moveTo(x - size, y + size);
        draw.lineTo(x + size, y - size);
        draw.strokeStyle = alarm;
        draw.lineWidth = 1.5;
        draw.stroke();
      }
      if (j === chosen) {
        draw.beginPath();
        draw.arc(x, y, 2.4 * size, 0, 2 * Math.PI);
        draw.strokeStyle = dark;
        draw.lineWidth = 2;
        draw.stroke();
      }
    });
    if (moment.event) {
      const [x, y] = at(moment.event.epicentre);
      draw.beginPath();
      for (let i = 0; i < 16; i++) {
        const far = i % 2 ? 4 : 10, turn = (i * Math.PI) / 8;
        draw.lineTo(x + far * Math.sin(turn), y - far * Math.cos(turn));
      }
      draw.closePath();
      draw.fillStyle = alarm;
      draw.fill();
    }
  }
}
