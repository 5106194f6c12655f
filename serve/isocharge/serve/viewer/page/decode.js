// Binary messages of samples; serve/isocharge/serve/viewer/messages.py describes them.

export const HEADER_BYTES = 24;
export const CONTACT = 0x80000000;
const SAMPLES = 1, BEGIN_ANEW = 1;

/** @returns {{number, sent_s, missed, beginsAnew, samples}} null for a message of another kind or length */
export function decode(buffer, electrodes) {
  if (buffer.byteLength < HEADER_BYTES) return null;
  const head = new DataView(buffer);
  const count = head.getUint16(2, true);
  if (head.getUint8(0) !== SAMPLES) return null;
  const size = 8 * Math.ceil((60 + 4 * electrodes) / 8);
  if (buffer.byteLength !== HEADER_BYTES + count * size) return null;
  const samples = [];
  for (let k = 0; k < count; k++) samples.push(sample(head, HEADER_BYTES + k * size, electrodes));
  return {
    samples, number: head.getUint32(4, true), sent_s: head.getFloat64(8, true), missed: head.getUint32(16, true),
    beginsAnew: (head.getUint32(20, true) & BEGIN_ANEW) !== 0,
  };
}

function sample(view, at, electrodes) {
  const number = (place) => { const v = view.getFloat32(at + place, true); return Number.isNaN(v) ? null : v; };
  const bits = view.getUint32(at + 52, true), charges = [];
  for (let e = 0; e < electrodes; e++) charges.push(number(60 + 4 * e));
  return {
    t: view.getFloat64(at, true), x: number(8), y: number(12), force: number(16),
    xStd: number(20), yStd: number(24), forceStd: number(28), misfit: number(32), latency: number(36), correlation: number(40),
    otherX: number(44), otherY: number(48),
    contact: (bits & CONTACT) !== 0, bits: bits & ~CONTACT, records: view.getUint32(at + 56, true), charges,
  };
}
