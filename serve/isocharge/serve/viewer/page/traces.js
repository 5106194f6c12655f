// Charges, force and misfit over time, by uPlot.

import { lineStyle, theme } from "./theme.js";

export const WINDOW_S = 10;
const HEIGHT = 172;

export class Traces {
  /** @param figures {{charges, force, misfit}} figure elements */
  constructor(figures, film, history) {
    Object.assign(this, { figures, film, history });
    this.build();
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(figures.charges);
  }

  build() {
    for (const plot of Object.values(this.plots ?? {})) plot.destroy();
    const charges = this.film.electrodes.map((label, k) => {
      const { colour, dash } = lineStyle(k);
      return { label, stroke: colour, dash, width: 1.6 };
    });
    this.plots = {
      charges: this.plot("charges", charges),
      force: this.plot("force", [{ label: "force", stroke: theme.touch, width: 1.8, fill: `${theme.touch}22` }], [0, 0.2]),
      misfit: this.plot("misfit", [{ label: "misfit", stroke: theme.accent, width: 1.6 }], [0, 1.2 * this.film.misfit_limit]),
    };
    this.nameCharges(charges);
  }

  plot(name, series, least = null) {
    const grid = { stroke: theme.line, width: 1 }, axis = { stroke: theme.quiet, grid, ticks: grid, font: "11px system-ui, sans-serif" };
    return new uPlot({
      width: this.width(name), height: HEIGHT, legend: { show: false }, cursor: { sync: { key: "time" }, points: { size: 6 } }, padding: [8, 16, 0, 0],
      scales: { x: { time: false, range: () => [this.end - WINDOW_S, this.end] }, y: { range: (_, low, high) => range(low, high, least) } },
      axes: [{ ...axis, size: 26, values: (_, marks) => marks.map((mark) => this.word(mark)) }, { ...axis, size: 46 }],
      series: [{}, ...series.map((line) => ({ ...line, points: { show: false }, spanGaps: false }))],
      hooks: { draw: [(plot) => this.drawMarks(plot, name)] },
    }, [[], ...series.map(() => [])], this.figures[name].querySelector("div"));
  }

  get end() { return this.history.end; }

  /** A time on the axis: of the clock, or since a recording began. */
  word(seconds) {
    if (this.history.isReplay) return seconds < 0 ? "" : `${seconds.toFixed(0)} s`;
    return new Date((seconds + this.history.origin) * 1000).toLocaleTimeString([], { minute: "2-digit", second: "2-digit" });
  }

  nameCharges(series) {
    const caption = this.figures.charges.querySelector("figcaption");
    caption.replaceChildren("Charge, pC", ...series.map(({ label, stroke, dash }) => {
      const entry = document.createElement("span");
      entry.innerHTML = "<svg viewBox='0 0 22 4' aria-hidden='true'><line x1='0' y1='2' x2='22' y2='2' stroke-width='2.5'/></svg>";
      entry.querySelector("line").setAttribute("stroke", stroke);
      entry.querySelector("line").setAttribute("stroke-dasharray", dash.join(" "));
      entry.append(label);
      return entry;
    }));
  }

  drawMarks(plot, name) {
    const g = plot.ctx, { left, top, width, height } = plot.bbox, pixel = devicePixelRatio || 1;
    g.save(); g.beginPath(); g.rect(left, top, width, height); g.clip(); g.lineWidth = pixel;
    if (name === "misfit") {
      const y = plot.valToPos(this.film.misfit_limit, "y", true);
      g.strokeStyle = theme.warn; g.setLineDash([5 * pixel, 4 * pixel]); stroke(g, left, y, left + width, y);
      g.fillStyle = theme.warn; g.font = `${11 * pixel}px system-ui, sans-serif`; g.textAlign = "right"; g.textBaseline = "bottom";
      g.fillText("no single contact above", left + width - 4 * pixel, y - 4 * pixel);
    }
    g.strokeStyle = theme.ink; g.setLineDash([2 * pixel, 2 * pixel]);
    for (const [timestamp] of this.history.markers) {
      const x = plot.valToPos(timestamp - this.history.origin, "x", true);
      if (x >= left && x <= left + width) stroke(g, x, top, x, top + height);
    }
    g.restore();
  }

  draw() {
    const { t, charges, force, misfit } = this.history;
    this.plots.charges.setData([t, ...charges]);
    this.plots.force.setData([t, force]);
    this.plots.misfit.setData([t, misfit]);
  }

  width(name) { return Math.max(this.figures[name].clientWidth, 120); }

  resize() { for (const [name, plot] of Object.entries(this.plots)) if (plot.width !== this.width(name)) plot.setSize({ width: this.width(name), height: HEIGHT }); }
}

function range(low, high, least) {
  if (low === null || high === null) return least ?? [-10, 100];
  if (least) return [Math.min(least[0], low), Math.max(least[1], 1.08 * high)];
  const pad = Math.max(0.06 * (high - low), 5);
  return [low - pad, high + pad];
}

function stroke(g, x0, y0, x1, y1) { g.beginPath(); g.moveTo(x0, y0); g.lineTo(x1, y1); g.stroke(); }
