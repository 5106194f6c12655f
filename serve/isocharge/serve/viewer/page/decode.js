// Samples of the server as objects; serve/isocharge/serve/viewer/tape.py describes them.

/** Short names that the page uses for some numbers of a record; the other numbers keep the names of the record. */
const SHORT_NAMES = {
  timestamp: "t", x_mm: "x", y_mm: "y", force_N: "force", x_std_mm: "xStd", y_std_mm: "yStd", force_std_N: "forceStd",
  latency_us: "latency", xy_correlation: "correlation", other_x_mm: "otherX", other_y_mm: "otherY", flags: "bits",
};

/** @param columns names of the numbers of a sample, the charges last */
export function decode(row, columns) {
  const sample = { charges: [] };
  columns.forEach((name, k) => { if (name.startsWith("charge_pC.")) sample.charges.push(row[k]); else sample[SHORT_NAMES[name] ?? name] = row[k]; });
  sample.contact = sample.contact === 1;
  return sample;
}
