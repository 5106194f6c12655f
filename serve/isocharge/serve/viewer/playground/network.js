// A network of isocharge, read from its ONNX file and evaluated for one press at a time.

const FLOAT = 1, INT64 = 7;

/** A reader of protobuf messages, the format of ONNX files. */
class ProtobufReader {
  constructor(bytes) {
    this.bytes = bytes;
    this.position = 0;
  }

  /** Yield the number and the value of each field. Values are numbers or bytes. */
  *fields() {
    while (this.position < this.bytes.length) {
      const key = this.varint();
      const wireType = key & 7;
      const number = Math.floor(key / 8);
      if (wireType === 0) {
        yield [number, this.varint()];
      } else if (wireType === 2) {
        yield [number, this.take(this.varint())];
      } else if (wireType === 5) {
        yield [number, this.take(4)];
      } else if (wireType === 1) {
        yield [number, this.take(8)];
      } else {
        throw new Error(`expected a protobuf field of wire type 0, 1, 2 or 5, got ${wireType}`);
      }
    }
  }

  varint() {
    let value = 0;
    let factor = 1;
    let byte;
    do {
      byte = this.bytes[this.position++];
      value += (byte & 127) * factor;
      factor *= 128;
    } while (byte >= 128);
    return value;
  }

  take(length) {
    const start = this.position;
    this.position += length;
    return this.bytes.subarray(start, this.position);
  }
}

/** Return the fields of a message: lists of values by the number of the field. */
function readMessage(bytes) {
  const fields = new Map();
  for (const [number, value] of new ProtobufReader(bytes).fields()) {
    if (!fields.has(number)) fields.set(number, []);
    fields.get(number).push(value);
  }
  return (number) => fields.get(number) ?? [];
}

function readText(bytes) { return new TextDecoder().decode(bytes); }

/** Return repeated integers, which a file may store one by one or packed into bytes. */
function readIntegers(values) {
  return values.flatMap((value) => {
    if (typeof value === "number") return [value];
    const reader = new ProtobufReader(value);
    const integers = [];
    while (reader.position < value.length) integers.push(reader.varint());
    return integers;
  });
}

/** Return a constant: its shape and its numbers. */
function readTensor(field) {
  const shape = readIntegers(field(1));
  const type = field(2)[0];
  const raw = field(9)[0];
  if (!raw || (type !== FLOAT && type !== INT64)) throw new Error(`expected raw float32 or int64 numbers, got type ${type}`);
  const copy = raw.slice().buffer;
  const values = type === FLOAT ? new Float32Array(copy) : Array.from(new BigInt64Array(copy), Number);
  return { shape, values: Float64Array.from(values) };
}

function mapped(operation) {
  return ({ values }) => [{ values: values.map(operation) }];
}

/** Multiply a row by a matrix, and add a bias if there is one. */
function multiply(row, matrix, bias) {
  const columns = matrix.shape[1];
  const weights = matrix.values;
  const result = bias ? bias.values.slice() : new Float64Array(columns);
  let k = 0;
  for (const factor of row.values) {
    for (let j = 0; j < columns; j++) result[j] += factor * weights[k++];
  }
  return [{ values: result }];
}

/** The operations of ONNX that occur in released models. All of them act on one row. */
const OPERATIONS = {
  Clip: (row, low, high) => [{ values: row.values.map((value) => Math.min(Math.max(value, low.values[0]), high.values[0])) }],
  Max: (row, low) => [{ values: row.values.map((value, k) => Math.max(value, low.values[k])) }],
  Min: (row, high) => [{ values: row.values.map((value, k) => Math.min(value, high.values[k])) }],
  Mul: (row, factor) => [{ values: row.values.map((value, k) => value * factor.values[factor.values.length > 1 ? k : 0]) }],
  Log: mapped(Math.log),
  Tanh: mapped(Math.tanh),
  Exp: mapped(Math.exp),
  Cos: mapped(Math.cos),
  Sinh: mapped(Math.sinh),
  Gemm: multiply,
  MatMul: multiply,
  Concat: (...rows) => [{ values: Float64Array.from(rows.flatMap((row) => Array.from(row.values))) }],
  ReduceL2: (row) => [{ values: Float64Array.of(Math.hypot(...row.values)) }],
  Split: (row, sizes) => {
    let start = 0;
    return Array.from(sizes.values, (size) => {
      const part = row.values.subarray(start, start + size);
      start += size;
      return { values: part };
    });
  },
};

class Network {
  constructor(bytes) {
    const graph = readMessage(readMessage(bytes)(7)[0]);
    this.constants = new Map();
    for (const tensorBytes of graph(5)) {
      const field = readMessage(tensorBytes);
      this.constants.set(readText(field(8)[0]), readTensor(field));
    }
    this.nodes = graph(1).map((nodeBytes) => {
      const field = readMessage(nodeBytes);
      const type = readText(field(4)[0]);
      const operation = OPERATIONS[type];
      if (!operation) throw new Error(`expected one of the operations ${Object.keys(OPERATIONS)}, got ${type}`);
      return { operation, inputs: field(1).map(readText), outputs: field(2).map(readText) };
    });
    const constants = this.constants;
    const inputs = graph(11).map((input) => readText(readMessage(input)(1)[0]));
    this.input = inputs.find((name) => !constants.has(name));
  }

  /** Compute the outputs, by name, from the charges of the electrodes in pC. */
  run(charges) {
    const values = new Map(this.constants);
    values.set(this.input, { values: Float64Array.from(charges) });
    for (const { operation, inputs, outputs } of this.nodes) {
      const results = operation(...inputs.map((name) => values.get(name)));
      outputs.forEach((name, k) => values.set(name, results[k]));
    }
    return (name) => values.get(name)?.values;
  }
}
