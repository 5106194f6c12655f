// The film of the playground from above: the plan of the live page with isocharge curves and press.

import { lineStyle, theme } from "./theme.js";
import { Plan } from "./plan.js";

const VIEW_MM = 24, LENS_REACH_MM = 1, CURVE_PX = 1.8;

class Stage extends Plan {
  constructor(canvas, film) {
    super(canvas, film);
    this.reach = VIEW_MM;
  }

  /** @param view {{press, sample, kind, trail, curves, lensCurves, word}} what is drawn over the film */
  draw(view) {
    const g = this.drawBackground();
    view.curves.forEach((segments, electrode) => this.drawCurve(g, segments, electrode, CURVE_PX * this.css, this.css));
    this.lensCurves = view.lensCurves;
    this.drawTouch(g, view);
    this.drawPress(g, view.press);
    if (view.word) this.drawWord(g, view.word);
  }

  /** Return the point of the film, mm, under a point of the window. */
  place(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = (2 * (event.clientX - box.left) / box.width - 1) * this.reach;
    const y = (1 - 2 * (event.clientY - box.top) / box.height) * this.reach;
    return { x, y };
  }

  drawCurve(g, segments, electrode, width, dashUnit) {
    g.save();
    const { colour, dash } = lineStyle(electrode);
    g.strokeStyle = colour;
    g.lineWidth = width;
    g.lineCap = "round";
    g.beginPath();
    for (const polyline of joined(segments)) {
      polyline.forEach(([x, y], k) => { if (k === 0) g.moveTo(x, y); else g.lineTo(x, y); });
    }
    g.setLineDash(dash.map((length) => length * dashUnit));
    g.stroke();
    g.restore();
  }

  drawPress(g, press) {
    const px = this.css;
    const { x, y } = this.inView(press);
    g.save();
    for (const [colour, width] of [[theme.card, 5], [theme.ink, 2.4]]) {
      g.strokeStyle = colour;
      g.lineWidth = width * px;
      g.beginPath();
      g.moveTo(x - 11 * px, y);
      g.lineTo(x + 11 * px, y);
      g.moveTo(x, y - 11 * px);
      g.lineTo(x, y + 11 * px);
      g.stroke();
    }
    g.restore();
  }

  drawTrail() {} // The trail is drawn in the lens only.

  drawLens(g, sample, trail, px) {
    super.drawLens(g, sample, trail, px);
    const { x, y, size } = this.lens;
    const scale = size / LENS_REACH_MM;
    g.save();
    g.beginPath();
    g.arc(x, y, size, 0, 2 * Math.PI);
    g.clip();
    g.translate(x, y);
    g.scale(scale, scale);
    g.translate(-sample.x, -sample.y);
    this.lensCurves.forEach((segments, electrode) => this.drawCurve(g, segments, electrode, CURVE_PX * px / scale, px / scale));
    g.restore();
  }
}

/** Join segments that share an end into polylines, so that dashes go on from segment to segment. */
function joined(segments) {
  const key = (x, y) => `${x.toFixed(6)} ${y.toFixed(6)}`;
  const neighbours = new Map();
  segments.forEach(([x0, y0, x1, y1], index) => {
    for (const end of [key(x0, y0), key(x1, y1)]) {
      if (!neighbours.has(end)) neighbours.set(end, []);
      neighbours.get(end).push(index);
    }
  });
  const isUsed = new Set();
  const follow = (start) => {
    const points = [];
    let [x, y] = start;
    for (;;) {
      const index = neighbours.get(key(x, y)).find((candidate) => !isUsed.has(candidate));
      if (index === undefined) return points;
      isUsed.add(index);
      const [x0, y0, x1, y1] = segments[index];
      [x, y] = key(x0, y0) === key(x, y) ? [x1, y1] : [x0, y0];
      points.push([x, y]);
    }
  };
  const polylines = [];
  segments.forEach(([x, y], index) => {
    if (isUsed.has(index)) return;
    const forwards = follow([x, y]);
    const backwards = follow([x, y]).reverse();
    polylines.push([...backwards, [x, y], ...forwards]);
  });
  return polylines;
}
