// A sensor with its network: charges of presses, faults and noise of the amplifiers, and answers with their flags.

const GAIN_ERROR = 0.2, IMPLAUSIBLE_FACTOR = 3;

class PlaygroundSensor {
  constructor(description, series, networkBytes) {
    this.description = description;
    this.series = series;
    const outlines = description.electrodes.map((name) => description.polygons_mm[name][0]);
    this.electrodes = new Electrodes(outlines, description.piezo_pC_per_N);
    this.network = new Network(networkBytes);
    this.largestDistance = Math.max(...description.working_area_mm.map(([x, y]) => Math.hypot(x, y)));
  }

  /** Compute the charges of a press without noise and faults, pC. */
  charges(x, y, force) { return this.electrodes.charges(this.series, x, y, force); }

  /** Return charges as they are measured: with noise, a gain that is too high, and an electrode without a signal. */
  measured(charges, { noise, wrongGain, dead }, normal) {
    const { white_pC: white, gain } = this.description.noise;
    return charges.map((charge, k) => {
      if (k === dead) return noise * white * normal();
      const amplified = k === wrongGain ? charge * (1 + GAIN_ERROR) : charge;
      return amplified + noise * Math.hypot(white, gain * amplified) * normal();
    });
  }

  /** Compute the contact of measured charges: position in mm, force in N, their standard deviations, and the misfit. */
  answer(charges) {
    const output = this.network.run(charges);
    const [x, y, force] = output("contact");
    const [xStd, yStd, forceStd] = output("contact_std");
    const [correlation] = output("contact_correlation") ?? [0];
    const [misfit] = output("misfit");
    return { x, y, force, xStd, yStd, forceStd, correlation, misfit };
  }

  /** Return the reasons not to trust an answer, as isocharge.serve.model.contact defines them. */
  flags(answer) {
    const { force_range_N: [low, high], misfit_limit: misfitLimit, yield_force_N: yieldForce } = this.description;
    const flags = [];
    if (!this.isInWorkingArea(answer.x, answer.y) || answer.force < low || answer.force > high) flags.push("outside");
    const isFar = Math.hypot(answer.x, answer.y) > IMPLAUSIBLE_FACTOR * this.largestDistance;
    if (isFar || answer.force > IMPLAUSIBLE_FACTOR * high) flags.push("beyond");
    if (answer.misfit > misfitLimit) flags.push("misfit");
    if (yieldForce !== null && answer.force > yieldForce) flags.push("stress");
    return flags;
  }

  isInWorkingArea(x, y) {
    const corners = this.description.working_area_mm;
    let isInside = false;
    corners.forEach(([x1, y1], k) => {
      const [x0, y0] = corners[(k + corners.length - 1) % corners.length];
      if (y0 > y !== y1 > y && x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)) isInside = !isInside;
    });
    return isInside;
  }
}

/** Return random numbers of the normal distribution, by the method of Box and Muller. */
function normalNumber() {
  return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
}

/** Unpack base64 of a gzip file. */
async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
