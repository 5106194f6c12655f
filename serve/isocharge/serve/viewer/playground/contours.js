// The charges of all presses with one force on a square grid, and their isocharge curves.

const MIN_CHARGE_PC = 1e-3, LOCAL_REACH_MM = 1.05, LOCAL_COUNT = 7;

class ChargeGrid {
  /** Take a grid from -reach to reach mm in both axes, with the logarithms of the charges at three forces. */
  constructor(electrodes, series, reach, step) {
    this.electrodes = electrodes;
    this.series = series;
    this.reach = reach;
    this.step = step;
    this.count = 2 * Math.round(reach / step) + 1;
    const [low, high] = series.forceRange;
    this.forces = [low, Math.sqrt(low * high), high];
    this.logs = this.forces.map(() => electrodes.parts.map(() => new Float64Array(this.count * this.count).fill(NaN)));
    this.nextRow = 0;
  }

  get isComplete() { return this.nextRow >= this.count; }

  /** Compute rows of the grid until a time in ms. */
  fillUntil(deadline) {
    while (!this.isComplete && performance.now() < deadline) {
      const row = this.nextRow++;
      for (let column = 0; column < this.count; column++) {
        const [x, y] = this.place(row, column);
        if (Math.hypot(x, y) > this.series.maxDistance) continue;
        this.forces.forEach((force, k) => {
          const charges = this.electrodes.charges(this.series, x, y, force);
          charges.forEach((charge, electrode) => { this.logs[k][electrode][row * this.count + column] = Math.log(charge); });
        });
      }
    }
  }

  place(row, column) { return [column * this.step - this.reach, row * this.step - this.reach]; }

  /** Return ln Q of one electrode on the grid under a force in N, by quadratic interpolation over ln F. */
  logCharges(electrode, force) {
    const weights = lagrange(Math.log(force), this.forces.map(Math.log));
    const [first, second, third] = this.logs.map((tables) => tables[electrode]);
    return first.map((value, k) => weights[0] * value + weights[1] * second[k] + weights[2] * third[k]);
  }

  /** Return the isocharge curve of an electrode: all presses with a force that give the electrode a charge in pC. */
  isocharge(electrode, charge, force) {
    const values = this.logCharges(electrode, force);
    return contour(values, this.count, [-this.reach, -this.reach], this.step, Math.log(Math.max(charge, MIN_CHARGE_PC)));
  }
}

/** Return the isocharge curves of all electrodes near a contact, each as segments. They are computed without the grid. */
function localIsocharges(sensor, charges, { x, y, force }) {
  const origin = [x - LOCAL_REACH_MM, y - LOCAL_REACH_MM];
  const step = 2 * LOCAL_REACH_MM / (LOCAL_COUNT - 1);
  const tables = charges.map(() => new Float64Array(LOCAL_COUNT * LOCAL_COUNT));
  for (let row = 0; row < LOCAL_COUNT; row++) {
    for (let column = 0; column < LOCAL_COUNT; column++) {
      const values = sensor.charges(origin[0] + column * step, origin[1] + row * step, force);
      values.forEach((charge, electrode) => { tables[electrode][row * LOCAL_COUNT + column] = Math.log(charge); });
    }
  }
  return charges.map((charge, electrode) => contour(tables[electrode], LOCAL_COUNT, origin, step, Math.log(Math.max(charge, MIN_CHARGE_PC))));
}

/**
 * Return the contour of values on a square grid as segments [x0, y0, x1, y1]. Each cell is divided into two triangles.
 * Cells with a value that is not a number have no contour.
 */
function contour(values, count, [originX, originY], step, level) {
  const segments = [];
  const corner = (row, column) => ({ x: originX + column * step, y: originY + row * step, height: values[row * count + column] - level });
  for (let row = 0; row + 1 < count; row++) {
    for (let column = 0; column + 1 < count; column++) {
      const at = row * count + column;
      const [a, b, c, d] = [values[at], values[at + 1], values[at + count], values[at + count + 1]];
      if (!(Math.min(a, b, c, d) < level && Math.max(a, b, c, d) >= level)) continue;
      const corners = [corner(row, column), corner(row, column + 1), corner(row + 1, column + 1), corner(row + 1, column)];
      addSegment(segments, [corners[0], corners[1], corners[2]]);
      addSegment(segments, [corners[0], corners[2], corners[3]]);
    }
  }
  return segments;
}

/** Add the part of a contour that crosses a triangle. */
function addSegment(segments, triangle) {
  const ends = [];
  triangle.forEach((start, k) => {
    const end = triangle[(k + 1) % 3];
    if (start.height < 0 === end.height < 0) return;
    const share = start.height / (start.height - end.height);
    ends.push(start.x + share * (end.x - start.x), start.y + share * (end.y - start.y));
  });
  if (ends.length === 4) segments.push(ends);
}

/** Return the weights of three values in the quadratic interpolation at a point. */
function lagrange(point, nodes) {
  return nodes.map((node, k) => nodes.reduce((product, other, j) => (j === k ? product : product * (point - other) / (node - other)), 1));
}
