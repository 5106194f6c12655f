// Charges of a press, from a Chebyshev series of the stress. An electrode of area A on a film with d31 = d32 collects
// the charge d31 A mean(s11 + s22), where s11 and s22 are the normal stresses.
//
// The film is round and elastically isotropic, so every press is a rotated press on the x axis. A disk automorphism maps
// rings around the origin to rings around the probe, z -> (z + c) / (1 + c z). In film radii, p is the distance of the
// probe from the centre and r is its radius; c = tanh((atanh(p + r) + atanh(p - r)) / 2), and the ring of the radius
// s0 = tanh((atanh(p + r) - atanh(p - r)) / 2) is mapped to the edge of the probe. One series describes the smooth
// function ln(s11 + s22) under the probe, and another series describes it outside:
//
//     ln(s11 + s22) = sum c_ijkm T_i(p') T_j(l') T_k(u) T_m(cos(arg z)).
//
// Here p' is the distance, and l' is the logarithm of the force, both scaled to [-1, 1]. Under the probe, u is
// 2 (|z| / s0)^2 - 1. Outside, u is a linear function of ln|z| that is -1 at s0 and 1 at max_ring. The coefficients are
// little-endian float32 numbers in base64, shape (distances, forces, rings, angles).

const NEAR_MM = 2.0, NEAR_POINTS = 8, FAR_POINTS = 4;

class StressSeries {
  constructor(table) {
    this.filmRadius = table.film.radius_mm;
    this.probeRadius = table.probe_radius_mm;
    this.maxDistance = table.max_distance_mm;
    this.forceRange = table.force_range_N;
    this.maxRing = table.max_ring;
    this.inner = readCoefficients(table.inner);
    this.outer = readCoefficients(table.outer);
  }

  /** Return the stress field of a press: a function of a point (x, y) in mm that gives s11 + s22 in MPa. */
  press(x, y, force) {
    const distance = Math.min(Math.hypot(x, y), this.maxDistance);
    const outerEdge = Math.atanh((distance + this.probeRadius) / this.filmRadius);
    const innerEdge = Math.atanh((distance - this.probeRadius) / this.filmRadius);
    const shift = Math.tanh((outerEdge + innerEdge) / 2);
    const probeRing = Math.tanh((outerEdge - innerEdge) / 2);
    const logRingRange = Math.log(this.maxRing / probeRing);
    const [low, high] = this.forceRange;
    const scaledDistance = 2 * distance / this.maxDistance - 1;
    const scaledForce = 2 * Math.log(force / low) / Math.log(high / low) - 1;
    const inner = contract(this.inner, scaledDistance, scaledForce);
    const outer = contract(this.outer, scaledDistance, scaledForce);
    const direction = Math.atan2(y, x);
    const cosine = Math.cos(direction);
    const sine = Math.sin(direction);
    return (pointX, pointY) => {
      const u = (pointX * cosine + pointY * sine) / this.filmRadius;
      const v = (pointY * cosine - pointX * sine) / this.filmRadius;
      // The point before the automorphism: (u + iv - shift) / (1 - shift (u + iv)).
      const real = 1 - shift * u;
      const imaginary = -shift * v;
      const norm = real * real + imaginary * imaginary;
      const beforeX = ((u - shift) * real + v * imaginary) / norm;
      const beforeY = (v * real - (u - shift) * imaginary) / norm;
      const ring = Math.hypot(beforeX, beforeY);
      const angleCosine = ring > 0 ? beforeX / ring : 1;
      if (ring < probeRing) return Math.exp(evaluate(inner, 2 * (ring / probeRing) ** 2 - 1, angleCosine));
      const logRing = Math.log(Math.min(ring, this.maxRing) / probeRing);
      return Math.exp(evaluate(outer, 2 * logRing / logRingRange - 1, angleCosine));
    };
  }
}

/** The electrodes of a sensor as integration points. The corners of an electrode are four points (x, y) in mm. */
class Electrodes {
  constructor(outlines, piezo_pC_per_N) {
    this.parts = outlines.map((corners) => {
      const x = corners.reduce((sum, corner) => sum + corner[0], 0) / corners.length;
      const y = corners.reduce((sum, corner) => sum + corner[1], 0) / corners.length;
      const reach = Math.max(...corners.map(([cornerX, cornerY]) => Math.hypot(cornerX - x, cornerY - y)));
      return { x, y, reach, near: quadrature(corners, NEAR_POINTS), far: quadrature(corners, FAR_POINTS) };
    });
    this.piezo = piezo_pC_per_N;
  }

  /** Compute the charges of a press at (x, y) mm with a force in N, in pC. */
  charges(series, x, y, force) {
    const stress = series.press(x, y, force);
    return this.parts.map((part) => {
      const isNear = Math.hypot(part.x - x, part.y - y) < part.reach + series.probeRadius + NEAR_MM;
      const { points, areas } = isNear ? part.near : part.far;
      let integral = 0;
      points.forEach(([pointX, pointY], k) => { integral += areas[k] * stress(pointX, pointY); });
      return this.piezo * integral;
    });
  }
}

function readCoefficients({ shape, data }) {
  const bytes = Uint8Array.from(atob(data), (character) => character.charCodeAt(0));
  return { shape, values: new Float32Array(bytes.buffer) };
}

/** Return the Chebyshev polynomials T_0 to T_(count - 1) at a point of [-1, 1]. Points outside are moved to the edge. */
function polynomials(point, count) {
  const inside = Math.min(Math.max(point, -1), 1);
  const values = [1, inside];
  for (let k = 2; k < count; k++) values.push(2 * inside * values[k - 1] - values[k - 2]);
  return values.slice(0, count);
}

/** Evaluate a series in its first two axes. The result is a matrix over ring and angle. */
function contract({ shape, values }, distance, force) {
  const [distances, forces, rings, angles] = shape;
  const distanceTerms = polynomials(distance, distances);
  const forceTerms = polynomials(force, forces);
  const size = rings * angles;
  const matrix = new Float64Array(size);
  for (let i = 0; i < distances; i++) {
    for (let j = 0; j < forces; j++) {
      const factor = distanceTerms[i] * forceTerms[j];
      const offset = (i * forces + j) * size;
      for (let k = 0; k < size; k++) matrix[k] += factor * values[offset + k];
    }
  }
  return { rings, angles, matrix };
}

function evaluate({ rings, angles, matrix }, ring, angleCosine) {
  const ringTerms = polynomials(ring, rings);
  const angleTerms = polynomials(angleCosine, angles);
  let sum = 0;
  for (let i = 0; i < rings; i++) {
    let row = 0;
    for (let j = 0; j < angles; j++) row += angleTerms[j] * matrix[i * angles + j];
    sum += ringTerms[i] * row;
  }
  return sum;
}

/** Gauss-Legendre points and weights on [-1, 1], by Newton's method. */
function gaussLegendre(count) {
  return Array.from({ length: count }, (_, k) => {
    let x = Math.cos(Math.PI * (k + 0.75) / (count + 0.5));
    let slope = 1;
    for (let iteration = 0; iteration < 8; iteration++) {
      let [previous, value] = [1, x];
      for (let n = 2; n <= count; n++) [previous, value] = [value, ((2 * n - 1) * x * value - (n - 1) * previous) / n];
      slope = count * (x * value - previous) / (x * x - 1);
      x -= value / slope;
    }
    return { x, weight: 2 / ((1 - x * x) * slope * slope) };
  });
}

/** Integration points on a quadrilateral, each with its share of the area in mm^2. */
function quadrature(corners, count) {
  const rule = gaussLegendre(count);
  const [a, b, c, d] = corners;
  const points = [];
  const areas = [];
  for (const first of rule) {
    for (const second of rule) {
      const s = (1 + first.x) / 2;
      const t = (1 + second.x) / 2;
      const along = (axis) => (1 - t) * (b[axis] - a[axis]) + t * (c[axis] - d[axis]);
      const across = (axis) => (1 - s) * (d[axis] - a[axis]) + s * (c[axis] - b[axis]);
      const at = (axis) => (1 - s) * (1 - t) * a[axis] + s * (1 - t) * b[axis] + s * t * c[axis] + (1 - s) * t * d[axis];
      points.push([at(0), at(1)]);
      areas.push(Math.abs(along(0) * across(1) - along(1) * across(0)) * first.weight * second.weight / 4);
    }
  }
  return { points, areas };
}
