// The deflected film: a table of the simulator, interpolated over force and place; isocharge/deflection_field.py has the format.

const NEAREST_RIM = 0.95;

export class Deflection {
  constructor(table) {
    Object.assign(this, { radius: table.film.radius_mm, probe: table.probe_radius_mm, rings: table.rings, angles: table.angles });
    [this.forces, this.distances] = [table.force_N, table.distance_mm];
    const bytes = Uint8Array.from(atob(table.deflection), (c) => c.charCodeAt(0));
    this.shares = new Uint16Array(bytes.buffer);
    this.step = table.scale_mm / 65535;
    this.size = this.rings.length * this.angles;
    this.sheet = new Float32Array(this.size);
    this.force = 0;
    this.c = 0;
    this.turn = 0;
    this.largest = table.scale_mm;
  }

  /** Bring the film under a press; without force it is flat. */
  press(x, y, force) {
    const distance = Math.min(Math.hypot(x, y), this.distances.at(-1)), rim = NEAREST_RIM;
    const p = Math.min(distance / this.radius, rim), r = this.probe / this.radius;
    this.c = Math.tanh(0.5 * (Math.atanh(p + r) + Math.atanh(p - r)));
    this.turn = Math.atan2(y, x);
    this.force = force;
    if (force <= 0) { this.sheet.fill(0); return; }
    const [d, dShare] = place(this.distances, distance), [f, low, high] = this.placeForce(force);
    const base = (f * this.distances.length + d) * this.size, nextForce = this.forces.length > 1 ? this.distances.length * this.size : 0;
    const nextDistance = this.distances.length > 1 ? this.size : 0, at = (k) => this.shares[k] * (1 - dShare) + this.shares[k + nextDistance] * dShare;
    for (let k = base; k < base + this.size; k++) this.sheet[k - base] = this.step * (low * at(k) + high * at(k + nextForce));
  }

  /** The two forces between which a force lies, with their weights: a membrane deflects as the cube root of the force. */
  placeForce(force) {
    const inside = Math.min(Math.max(force, this.forces[0]), this.forces.at(-1));
    const [f, share] = place(this.forces.map(Math.log), Math.log(inside)), next = Math.min(f + 1, this.forces.length - 1);
    return [f, (1 - share) * Math.cbrt(force / this.forces[f]), share * Math.cbrt(force / this.forces[next])];
  }

  /** Place on a ring, mm; angle 0 to 2 (angles - 1), between the table's too, the second half mirrors the first. */
  node(ring, angle) {
    const half = this.angles - 1, phi = angle * Math.PI / half, s = this.rings[ring];
    const [re, im] = [s * Math.cos(phi), s * Math.sin(phi)], { c } = this;
    const [a, b] = [1 + c * re, c * im], norm = a * a + b * b;
    const [u, v] = [((re + c) * a + im * b) / norm, (im * a - (re + c) * b) / norm];
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    const [j, share] = place2(angle <= half ? angle : 2 * half - angle, this.angles), w = this.sheet.subarray(ring * this.angles + j);
    return [this.radius * (u * cos - v * sin), this.radius * (u * sin + v * cos), w[0] * (1 - share) + w[1] * share];
  }

  /** Deflection at a place, mm. */
  at(x, y) {
    if (this.force <= 0) return 0;
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)], { c } = this;
    const [u, v] = [(x * cos + y * sin) / this.radius, (-x * sin + y * cos) / this.radius];
    const [a, b] = [1 - c * u, -c * v], norm = a * a + b * b;
    const re = ((u - c) * a + v * b) / norm, im = (v * a - (u - c) * b) / norm;
    const [i, iShare] = place(this.rings, Math.min(Math.hypot(re, im), 1));
    const [j, jShare] = place2(Math.abs(Math.atan2(im, re)) / Math.PI * (this.angles - 1), this.angles);
    const w = (ring, angle) => this.sheet[ring * this.angles + angle];
    return (w(i, j) * (1 - jShare) + w(i, j + 1) * jShare) * (1 - iShare) + (w(i + 1, j) * (1 - jShare) + w(i + 1, j + 1) * jShare) * iShare;
  }
}

/** The interval of increasing values in which a value lies, and its share of it. */
function place(values, value) {
  if (values.length < 2) return [0, 0];
  let k = 0;
  while (k < values.length - 2 && values[k + 1] <= value) k++;
  return [k, Math.min(Math.max((value - values[k]) / (values[k + 1] - values[k]), 0), 1)];
}

function place2(value, count) { const k = Math.min(Math.floor(value), count - 2); return [k, value - k]; }
