// Binary messages of samples; serve/isocharge/serve/viewer/messages.py describes them.

export const HEADER_BYTES = 24;
export const CONTACT = 0x80000000;
const SAMPLES = 1, BEGIN_ANEW = 1;

/** Short names that the page uses for some numbers of a record; the other numbers keep the names of the record. */
const SHORT_NAMES = {
  x_mm: "x", y_mm: "y", force_N: "force", x_std_mm: "xStd", y_std_mm: "yStd", force_std_N: "forceStd",
  latency_us: "latency", xy_correlation: "correlation", other_x_mm: "otherX", other_y_mm: "otherY",
};

/** Values of a sample that are not single numbers of 32 bits. */
const SPECIAL = new Set(["timestamp", "flags", "records", "charge_pC"]);

/**
 * @param layout {{bytes, offsets}} size of a sample and place of each value in it, from the description of the film
 * @returns {{number, sent_s, missed, beginsAnew, samples}} null for a message of another kind or length
 */
export function decode(buffer, layout, electrodes) {
  if (buffer.byteLength < HEADER_BYTES) return null;
  const head = new DataView(buffer);
  const count = head.getUint16(2, true);
  if (head.getUint8(0) !== SAMPLES) return null;
  if (buffer.byteLength !== HEADER_BYTES + count * layout.bytes) return null;
  const samples = [];
  for (let k = 0; k < count; k++) samples.push(decodeSample(head, HEADER_BYTES + k * layout.bytes, layout, electrodes));
  return {
    samples, number: head.getUint32(4, true), sent_s: head.getFloat64(8, true), missed: head.getUint32(16, true),
    beginsAnew: (head.getUint32(20, true) & BEGIN_ANEW) !== 0,
  };
}

function decodeSample(view, start, { offsets }, electrodes) {
  const numberAt = (place) => {
    const value = view.getFloat32(start + place, true);
    return Number.isNaN(value) ? null : value;
  };
  const bits = view.getUint32(start + offsets.flags, true);
  const sample = {
    t: view.getFloat64(start + offsets.timestamp, true),
    contact: (bits & CONTACT) !== 0,
    bits: bits & ~CONTACT,
    records: view.getUint32(start + offsets.records, true),
    charges: [],
  };
  for (let electrode = 0; electrode < electrodes; electrode++) {
    sample.charges.push(numberAt(offsets.charge_pC + 4 * electrode));
  }
  for (const [name, place] of Object.entries(offsets)) {
    if (!SPECIAL.has(name)) sample[SHORT_NAMES[name] ?? name] = numberAt(place);
  }
  return sample;
}
