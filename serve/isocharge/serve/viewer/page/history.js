// What was received in the last seconds, in columns, as the traces take it.

import { WINDOW_S } from "./traces.js";

const MOST = 6000;

export class History {
  constructor(electrodes, isReplay) {
    Object.assign(this, { electrodes, isReplay, markers: [], origin: null, latest: null });
    this.clear();
  }

  clear() {
    [this.t, this.force, this.misfit] = [[], [], []];
    this.charges = Array.from({ length: this.electrodes }, () => []);
    this.trail = [];
    this.latest = null;
    this.end = 0;
  }

  /** A sample; one that is older than the last is left out, as the traces need times that grow. */
  add(sample) {
    this.origin ??= sample.t;
    const t = sample.t - this.origin;
    this.latest = sample;
    if (this.t.length && t <= this.t.at(-1)) { if (this.t.at(-1) - t > 1) { this.clear(); this.add(sample); } return; }
    this.t.push(t);
    this.force.push(sample.force);
    this.misfit.push(sample.misfit);
    sample.charges.forEach((charge, k) => this.charges[k].push(charge));
    if (sample.contact && sample.x !== null) this.trail.push(sample); else if (this.trail.at(-1)?.contact) this.trail.push({ ...this.trail.at(-1), contact: false });
    this.end = t;
  }

  trim() {
    const first = this.t.findIndex((t) => t > this.end - 1.1 * WINDOW_S), surplus = Math.max(first, this.t.length - MOST, 0);
    if (surplus > 200) for (const column of [this.t, this.force, this.misfit, ...this.charges]) column.splice(0, surplus);
    const old = this.latest ? this.trail.findIndex((past) => past.t > this.latest.t - 2) : 0;
    if (old > 0) this.trail.splice(0, old); else if (old < 0) this.trail = [];
  }
}
