// The film from above, to scale: electrodes, working area, the touch with its trail, and a lens on its uncertainty.

import { fit, lineStyle, theme } from "./theme.js";

/** Share of the presses at a place above which the place is shaded as a place without flags. */
const UNNOTICED_SHARE = 0.5;

const HATCH_MM = 1.5, TRAIL_S = 1.6, LENS_MM = 1.0, SIGMAS_95 = 2.448, LENS_PX = 52;

export class Plan {
  constructor(canvas, film) {
    [this.canvas, this.film] = [canvas, film];
    this.filmRadius = film.film?.radius_mm;
    /** Pads of the electrodes. */
    this.pads = Object.values(film.polygons_mm).map(([pad]) => pad);
    const corners = [...film.working_area_mm, ...this.pads.flat()];
    // The view is centred on the film; without a film, as for a pad known by presses alone, on the working area.
    this.middle = this.filmRadius ? { x: 0, y: 0 } : middleOf(corners);
    this.reach = 1.16 * Math.max(...corners.map(([x, y]) => Math.hypot(x - this.middle.x, y - this.middle.y)));
    this.largest = film.force_range_N[1];
    this.region = film.unnoticed ? unnoticedRegion(film.unnoticed) : [];
    this.base = document.createElement("canvas");
    this.isStale = true;
  }

  /** Draw what does not move again: another theme. */
  refresh() { this.isStale = true; }

  /** Draw what does not move, and return the context of the canvas with millimetres of the film as its unit. */
  drawBackground() {
    if (fit(this.canvas) || this.isStale) this.drawBase();
    const g = this.canvas.getContext("2d");
    g.setTransform(1, 0, 0, 1, 0, 0);
    g.clearRect(0, 0, this.canvas.width, this.canvas.height);
    g.drawImage(this.base, 0, 0);
    this.toMillimetres(g);
    return g;
  }

  /** @param view {{sample, kind, trail, now, word}} the latest sample, what it is, and contacts with their age */
  draw(view) {
    const g = this.drawBackground();
    this.drawTrail(g, view);
    if (view.sample?.contact && view.sample.x !== null) this.drawTouch(g, view);
    if (view.word) this.drawWord(g, view.word);
  }

  get pixel() { return 2 * this.reach / this.canvas.width; }

  toMillimetres(g) {
    const scale = 1 / this.pixel;
    g.setTransform(scale, 0, 0, -scale, this.canvas.width / 2, this.canvas.height / 2);
    g.translate(-this.middle.x, -this.middle.y);
  }

  get css() { return this.pixel * this.canvas.width / (this.canvas.clientWidth || 1); }

  drawBase() {
    [this.base.width, this.base.height, this.isStale] = [this.canvas.width, this.canvas.height, false];
    const g = this.base.getContext("2d"), px = this.css, { film } = this;
    this.toMillimetres(g);
    g.lineJoin = "round";
    if (this.filmRadius) { g.fillStyle = theme.film; circle(g, 0, 0, this.filmRadius); g.fill(); }
    if (this.region.length) this.drawRegion(g);
    g.lineWidth = px; g.strokeStyle = theme.line;
    this.drawGrid(g);
    g.fillStyle = theme.area; path(g, film.working_area_mm); g.fill();
    g.setLineDash([4 * px, 4 * px]); g.lineWidth = 1.5 * px; g.strokeStyle = theme.accent; g.stroke(); g.setLineDash([]);
    film.electrodes.forEach((name, k) => this.drawElectrode(g, name, k, px));
    this.drawScale(g, px);
    if (this.filmRadius) this.drawWhole(g, px);
  }

  /** Lines every 5 mm: 50 mm from the middle of a film to each side, or over the whole view of a pad. */
  drawGrid(g) {
    const { middle } = this;
    const half = this.filmRadius ? 50 : 5 * Math.ceil(this.reach / 5);
    const x0 = 5 * Math.round(middle.x / 5), y0 = 5 * Math.round(middle.y / 5);
    for (let at = -half; at <= half; at += 5) {
      segment(g, x0 + at, y0 - half, x0 + at, y0 + half);
      segment(g, x0 - half, y0 + at, x0 + half, y0 + at);
    }
  }

  /** Shade and hatch the part of the film where most presses are answered with a wrong contact and without a flag. */
  drawRegion(g) {
    this.drawUnnoticed(g, "1a");
    g.save();
    g.clip();
    g.globalAlpha = 0.45;
    g.strokeStyle = theme.warn; g.lineWidth = this.css;
    const { reach, middle: { x, y } } = this;
    for (let offset = -2 * reach; offset <= 2 * reach; offset += HATCH_MM) segment(g, x + offset - reach, y - reach, x + offset + reach, y + reach);
    g.restore();
  }

  /** @param opacity two hexadecimal digits */
  drawUnnoticed(g, opacity) {
    g.beginPath();
    for (const polygon of this.region) addPolygon(g, polygon);
    g.fillStyle = theme.warn + opacity; g.fill();
  }

  drawElectrode(g, name, k, px) {
    const [outline, ...leads] = this.film.polygons_mm[name] ?? [];
    if (!outline) return;
    const { colour, dash } = lineStyle(k);
    g.fillStyle = colour + "30"; g.strokeStyle = colour; g.lineWidth = 2 * px;
    for (const polygon of leads) { path(g, polygon); g.fill(); }
    path(g, outline); g.fill(); g.setLineDash(dash.map((d) => d * px)); g.stroke(); g.setLineDash([]);
    const x = mean(outline, 0), y = mean(outline, 1);
    this.text(g, name, x, y, 15 * px, theme.ink, "center", "600");
  }

  drawScale(g, px) {
    const x = this.middle.x - this.reach + 16 * px, y = this.middle.y + this.reach - 18 * px;
    g.strokeStyle = theme.ink; g.lineWidth = 2 * px; segment(g, x, y, x + 5, y);
    segment(g, x, y - 3 * px, x, y + 3 * px); segment(g, x + 5, y - 3 * px, x + 5, y + 3 * px);
    this.text(g, "5 mm", x + 2.5, y - 11 * px, 12 * px, theme.ink, "center");
  }

  /** The whole film, small, in the corner: where this view is on it. */
  drawWhole(g, px) {
    const size = 34 * px, scale = size / this.filmRadius, x = -this.reach + size + 10 * px, y = -this.reach + size + 10 * px;
    g.save(); g.translate(x, y); g.scale(scale, scale);
    const thin = px / scale;
    g.fillStyle = theme.card; g.strokeStyle = theme.quiet; g.lineWidth = 1.2 * thin;
    circle(g, 0, 0, this.filmRadius); g.fill(); g.stroke();
    this.drawUnnoticed(g, "40");
    g.fillStyle = theme.quiet;
    for (const outline of this.pads) { path(g, outline); g.fill(); }
    g.strokeStyle = theme.accent; g.strokeRect(-this.reach, -this.reach, 2 * this.reach, 2 * this.reach);
    g.restore();
    const isShaded = this.region.length > 0;
    // Two lines beside the overview. The longer line is below the electrodes of the built-in sensors.
    const diameter = `Ø ${2 * this.filmRadius} mm`;
    const left = x + size + 6 * px;
    const lowerLine = y - size + 6 * px;
    const upperLine = y - size + 20 * px;
    this.text(g, diameter, left, isShaded ? upperLine : lowerLine, 11 * px, theme.quiet, "left");
    if (isShaded) this.text(g, "shaded: wrong, no flag", left, lowerLine, 11 * px, theme.warn, "left");
  }

  radius(force) { return (5 + 15 * Math.sqrt(Math.min(Math.max(force, 0) / this.largest, 1.5))) * this.css; }

  drawTrail(g, { trail, now }) {
    g.lineCap = "round"; g.strokeStyle = theme.touch;
    for (let k = 1; k < trail.length; k++) {
      const a = trail[k - 1], b = trail[k], age = (now - b.t) / TRAIL_S;
      if (age >= 1 || b.t - a.t > 0.15 || a.contact !== true) continue;
      g.globalAlpha = 0.55 * (1 - age) ** 1.5;
      g.lineWidth = Math.max(1.5 * this.css, 0.55 * this.radius(b.force) * (1 - age));
      segment(g, a.x, a.y, b.x, b.y);
    }
    g.globalAlpha = 1;
  }

  drawTouch(g, { sample, kind, trail }) {
    const px = this.css, r = this.radius(sample.force), { x, y } = this.inView(sample);
    g.lineWidth = 2.5 * px;
    if (kind === "contact") {
      g.fillStyle = theme.touch; g.globalAlpha = 0.82; circle(g, x, y, r); g.fill(); g.globalAlpha = 1;
      g.strokeStyle = theme.card; g.lineWidth = 1.5 * px; circle(g, x, y, r); g.stroke();
    } else {
      g.strokeStyle = theme.warn; g.setLineDash(kind === "outside" ? [5 * px, 4 * px] : []);
      circle(g, x, y, Math.max(r, 9 * px)); g.stroke(); g.setLineDash([]);
      if (kind === "misfit") { const d = 0.7 * Math.max(r, 9 * px); segment(g, x - d, y - d, x + d, y + d); segment(g, x - d, y + d, x + d, y - d); }
    }
    if (sample.otherX !== null) this.drawOther(g, sample, r, px);
    if (sample.xStd !== null) this.drawEllipse(g, x, y, sample, 1, kind === "contact" ? theme.ink : theme.warn, 1.4 * px);
    if (sample.xStd !== null && kind !== "misfit") this.drawLens(g, sample, trail, px);
  }

  /** The other contact with the same charges, where it is not known which of them touches. */
  drawOther(g, { otherX, otherY }, r, px) {
    const { x, y } = this.inView({ x: otherX, y: otherY });
    g.strokeStyle = theme.touch; g.lineWidth = 2.5 * px; g.setLineDash([3 * px, 3 * px]);
    circle(g, x, y, r); g.stroke(); g.setLineDash([]);
    this.text(g, "or here", x, y + r + 9 * px, 11 * px, theme.ink, "center");
  }

  /** A place beyond the view is shown at its edge. */
  inView({ x, y }) {
    const most = this.reach - 12 * this.css;
    const clip = (value, middle) => Math.min(Math.max(value, middle - most), middle + most);
    return { x: clip(x, this.middle.x), y: clip(y, this.middle.y) };
  }

  drawEllipse(g, x, y, sample, scale, colour, width) {
    const { long, short, angle } = axes(sample);
    g.strokeStyle = colour; g.lineWidth = width; g.beginPath();
    g.ellipse(x, y, SIGMAS_95 * long * scale, SIGMAS_95 * short * scale, angle, 0, 2 * Math.PI); g.stroke();
  }

  /** The millimetre around the touch, enlarged, with the ellipse in which it lies 95 times of 100. */
  drawLens(g, sample, trail, px) {
    const size = LENS_PX * px, [x, y] = this.lensPlace(size, px, sample), scale = size / LENS_MM;
    this.lens = { x, y, size };
    g.save();
    g.fillStyle = theme.card; g.strokeStyle = theme.quiet; g.lineWidth = 1.2 * px;
    circle(g, x, y, size); g.fill(); g.stroke(); g.clip();
    g.fillStyle = theme.touch;
    for (const past of trail.slice(-80)) {
      g.globalAlpha = 0.35; circle(g, x + (past.x - sample.x) * scale, y + (past.y - sample.y) * scale, 1.6 * px); g.fill();
    }
    g.globalAlpha = 1;
    this.drawEllipse(g, x, y, sample, scale, theme.ink, 1.8 * px);
    circle(g, x, y, 3 * px); g.fill();
    g.restore();
    g.strokeStyle = theme.ink; g.lineWidth = 1.5 * px;
    const below = y - 0.62 * size;
    segment(g, x - 0.25 * scale, below, x + 0.25 * scale, below);
    this.text(g, "0.5 mm", x, below - 9 * px, 10 * px, theme.ink, "center");
  }

  /** The corner in which the lens hides neither touch nor electrode; on the upper left it is below the scale. */
  lensPlace(size, px, touch) {
    const far = this.reach - size - 10 * px;
    const corners = [[far, -far], [far, far], [-far, far - 34 * px]].map(([x, y]) => [this.middle.x + x, this.middle.y + y]);
    const edges = this.pads.flat();
    const hides = ([x, y]) => Math.hypot(touch.x - x, touch.y - y) < size + 24 * px || edges.some(([u, v]) => Math.hypot(u - x, v - y) < size + 4 * px);
    return corners.find((corner) => !hides(corner)) ?? corners[0];
  }

  drawWord(g, word) {
    const px = this.css;
    this.text(g, word, this.middle.x, this.middle.y + this.reach - 20 * px, 14 * px, theme.quiet, "center");
  }

  text(g, words, x, y, size, colour, align, weight = "400") {
    g.save(); g.translate(x, y); g.scale(this.pixel, -this.pixel);
    g.font = `${weight} ${size / this.pixel}px system-ui, sans-serif`; g.fillStyle = colour; g.textAlign = align; g.textBaseline = "middle";
    g.fillText(words, 0, 0); g.restore();
  }
}

/** Standard deviations along the axes of the ellipse of a covariance, and the angle of the long one from x, rad. */
export function axes({ xStd, yStd, correlation }) {
  const xx = xStd ** 2, yy = yStd ** 2, xy = (correlation ?? 0) * xStd * yStd;
  const half = Math.hypot((xx - yy) / 2, xy), middle = (xx + yy) / 2;
  return { long: Math.sqrt(middle + half), short: Math.sqrt(Math.max(middle - half, 0)), angle: Math.atan2(2 * xy, xx - yy) / 2 };
}

function mean(points, axis) { return points.reduce((sum, point) => sum + point[axis], 0) / points.length; }

/** The middle of the box around points. */
export function middleOf(points) {
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  return { x: (Math.min(...xs) + Math.max(...xs)) / 2, y: (Math.min(...ys) + Math.max(...ys)) / 2 };
}

function circle(g, x, y, radius) { g.beginPath(); g.arc(x, y, radius, 0, 2 * Math.PI); }

function segment(g, x0, y0, x1, y1) { g.beginPath(); g.moveTo(x0, y0); g.lineTo(x1, y1); g.stroke(); }

function path(g, points) { g.beginPath(); addPolygon(g, points); }

function addPolygon(g, points) { points.forEach(([x, y], k) => { if (k) g.lineTo(x, y); else g.moveTo(x, y); }); g.closePath(); }

/**
 * Return the part of the film where the share of unnoticed presses is at least `UNNOTICED_SHARE`, as polygons. The shares
 * belong to the middles of cells of rings and sectors, and are interpolated between these.
 */
function unnoticedRegion({ from_mm, to_mm, share }) {
  const rings = [share[0], ...share, share.at(-1)], sectors = share[0].length, width = (to_mm - from_mm) / share.length;
  const corner = (ring, sector) => {
    const radius = Math.min(Math.max(from_mm + (ring - 0.5) * width, from_mm), to_mm), angle = 2 * Math.PI * (sector + 0.5) / sectors;
    return { x: radius * Math.cos(angle), y: radius * Math.sin(angle), height: rings[ring][sector % sectors] - UNNOTICED_SHARE };
  };
  const polygons = [];
  for (let ring = 0; ring + 1 < rings.length; ring++) {
    for (let sector = 0; sector < sectors; sector++) {
      const [a, b, c, d] = [corner(ring, sector), corner(ring + 1, sector), corner(ring + 1, sector + 1), corner(ring, sector + 1)];
      polygons.push(partAbove([a, b, c]), partAbove([a, c, d]));
    }
  }
  return polygons.filter((polygon) => polygon.length);
}

/** Return the part of a triangle with a height of 0 or more, as a polygon. */
function partAbove(triangle) {
  return triangle.flatMap((start, k) => {
    const end = triangle[(k + 1) % 3], isAbove = start.height >= 0, share = start.height / (start.height - end.height);
    const crossing = [start.x + share * (end.x - start.x), start.y + share * (end.y - start.y)];
    return [...(isAbove ? [[start.x, start.y]] : []), ...(isAbove !== end.height >= 0 ? [crossing] : [])];
  });
}
