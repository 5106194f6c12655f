"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const VIRIDIS = ["440154", "481467", "482576", "453781", "404688", "39558c", "33638d", "2d718e", "287d8e", "238a8d",
  "1f968b", "20a386", "29af7f", "3dbc74", "56c667", "75d054", "95d840", "bade28", "dde318", "fde725"]
  .map(hex => [0, 2, 4].map(at => parseInt(hex.slice(at, at + 2), 16)));
const FIELD = 560; // pixels of the coloured field, which is then scaled
const QUANTITIES = {
  position: { table: decode(data.position), colours: data.position.colours, unit: "mm", title: "position" },
  force: { table: decode(data.force), colours: data.force.colours, unit: "%", title: "force" },
};
const byId = id => document.getElementById(id);
const state = { quantity: "position", share: 0.5, x: 0, y: 0 };

/* Tables: natural logarithms, [force][ring][angle]. */

function decode(table) {
  const bytes = Uint8Array.from(atob(table.log16), character => character.charCodeAt(0));
  const view = new DataView(bytes.buffer), logs = new Float32Array(bytes.length / 2);
  const low = Math.log(table.smallest), step = (Math.log(table.largest) - low) / 65535;
  for (let i = 0; i < logs.length; i++) logs[i] = low + step * view.getUint16(2 * i, true);
  return logs;
}

function force() {
  const first = data.force_N[0], last = data.force_N[data.force_N.length - 1];
  return first * (last / first) ** state.share;
}

function sheet(name) { // the table of one force, between two tabulated ones
  const { table } = QUANTITIES[name], size = data.rings * data.angles, count = data.force_N.length;
  const place = state.share * (count - 1), below = Math.min(Math.floor(place), Math.max(count - 2, 0));
  const part = place - below, sheet = new Float32Array(size);
  for (let i = 0; i < size; i++) {
    const a = table[below * size + i];
    sheet[i] = part > 0 ? a + part * (table[(below + 1) * size + i] - a) : a;
  }
  return sheet;
}

function valueAt(sheet, x, y) { // logarithm at a position in mm; inside the first ring, that of the ring
  const ring = Math.hypot(x, y) / data.radius_mm * data.rings - 1;
  if (ring > data.rings - 1 + 1e-6) return NaN;
  const turn = ((Math.atan2(y, x) / (2 * Math.PI)) % 1 + 1) % 1 * data.angles;
  const r0 = Math.min(Math.max(Math.floor(ring), 0), data.rings - 2), a0 = Math.floor(turn) % data.angles;
  const r = Math.min(Math.max(ring - r0, 0), 1), a = turn - Math.floor(turn), a1 = (a0 + 1) % data.angles;
  const row = r0 * data.angles, next = row + data.angles;
  if (ring < 0) { // around the centre: from the mean of the first ring to the ring itself
    let mean = 0;
    for (let i = 0; i < data.angles; i++) mean += sheet[i] / data.angles;
    const rim = sheet[a0] * (1 - a) + sheet[a1] * a;
    return mean + (ring + 1) * (rim - mean);
  }
  return (1 - r) * ((1 - a) * sheet[row + a0] + a * sheet[row + a1]) + r * ((1 - a) * sheet[next + a0] + a * sheet[next + a1]);
}

/* Colours, numbers */

function colour(share) {
  const place = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1), below = Math.min(Math.floor(place), VIRIDIS.length - 2);
  return VIRIDIS[below].map((value, i) => value + (place - below) * (VIRIDIS[below + 1][i] - value));
}

function share(log, [low, high]) { return (log - Math.log(low)) / Math.log(high / low); }

function digits(value) {
  if (!isFinite(value)) return "–";
  if (value >= 1e4) return value.toExponential(0);
  return value >= 100 ? value.toFixed(0) : Number(value.toPrecision(value >= 10 ? 3 : 2)).toString();
}

function round125(low, high) {
  const values = [];
  for (let power = Math.floor(Math.log10(low)) - 1; power <= Math.log10(high) + 1; power++)
    for (const mantissa of [1, 2, 5]) {
      const value = Number(`${mantissa}e${power}`);
      if (value >= low * 0.999 && value <= high * 1.001) values.push(value);
    }
  return values;
}

function style(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

/* Drawing */

function prepare(canvas) { // as many pixels as the screen has; drawing is in CSS pixels
  const ratio = Math.min(window.devicePixelRatio || 1, 3), { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  return { pen, width, height };
}

const field = document.createElement("canvas");
field.width = field.height = FIELD;

function drawField(sheet, colours) { // colours, with a line wherever a round value is crossed
  const pen = field.getContext("2d"), image = pen.createImageData(FIELD, FIELD), step = 2 * data.radius_mm / FIELD;
  const marks = round125(...colours).map(Math.log), bands = new Int16Array(FIELD * FIELD).fill(-1);
  for (let row = 0; row < FIELD; row++) for (let column = 0; column < FIELD; column++) {
    const log = valueAt(sheet, (column + 0.5) * step - data.radius_mm, data.radius_mm - (row + 0.5) * step);
    if (Number.isNaN(log)) continue;
    const at = row * FIELD + column;
    let band = 0;
    while (band < marks.length && log > marks[band]) band++;
    bands[at] = band;
    const crossed = (column > 0 && bands[at - 1] >= 0 && bands[at - 1] !== band)
      || (row > 0 && bands[at - FIELD] >= 0 && bands[at - FIELD] !== band);
    const [red, green, blue] = colour(share(log, colours)), dim = crossed ? 0.62 : 1;
    image.data.set([dim * red, dim * green, dim * blue, 255], 4 * at);
  }
  pen.putImageData(image, 0, 0);
}

let view = { scale: 1, middle: 0, reach: 1 };

function drawMap(sheet, colours) {
  const { pen, width } = prepare(byId("map"));
  const corners = data.electrodes.flatMap(electrode => electrode.corners_mm.map(([x, y]) => Math.max(Math.abs(x), Math.abs(y))));
  const reach = 1.08 * Math.max(data.radius_mm, ...corners);
  view = { scale: width / (2 * reach), middle: width / 2, reach };
  const X = x => view.middle + view.scale * x, Y = y => view.middle - view.scale * y;
  drawField(sheet, colours);
  pen.drawImage(field, X(-data.radius_mm), Y(data.radius_mm), 2 * view.scale * data.radius_mm, 2 * view.scale * data.radius_mm);
  drawTicks(pen, width, X, Y, reach);
  pen.lineJoin = "round";
  for (const electrode of data.electrodes) {
    const path = new Path2D();
    electrode.corners_mm.forEach(([x, y], i) => i ? path.lineTo(X(x), Y(y)) : path.moveTo(X(x), Y(y)));
    path.closePath();
    halo(pen, path, 2);
    const middle = [0, 1].map(axis => electrode.corners_mm.reduce((sum, corner) => sum + corner[axis], 0) / electrode.corners_mm.length);
    label(pen, electrode.name, X(middle[0]), Y(middle[1]));
  }
  pen.fillStyle = style("--fold");
  for (const [x, y] of data.folds_mm) { pen.beginPath(); pen.arc(X(x), Y(y), 1.7, 0, 7); pen.fill(); }
  if (data.area.radius_mm > 0) {
    const path = new Path2D();
    path.arc(X(0), Y(0), view.scale * data.area.radius_mm, 0, 2 * Math.PI);
    halo(pen, path, 2.5, [8, 6]);
  }
  const cross = new Path2D(), [x, y] = [X(state.x), Y(state.y)];
  for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { cross.moveTo(x + 4 * a, y + 4 * b); cross.lineTo(x + 13 * a, y + 13 * b); }
  halo(pen, cross, 2);
}

function halo(pen, path, width, dash = []) { // readable on every colour: dark on white
  pen.setLineDash(dash);
  pen.strokeStyle = "rgba(255,255,255,0.85)"; pen.lineWidth = width + 2.5; pen.stroke(path);
  pen.strokeStyle = "#10202f"; pen.lineWidth = width; pen.stroke(path);
  pen.setLineDash([]);
}

function label(pen, text, x, y) {
  pen.textAlign = "center"; pen.textBaseline = "middle"; pen.lineWidth = 3.5; pen.lineJoin = "round";
  pen.strokeStyle = "rgba(255,255,255,0.85)"; pen.strokeText(text, x, y);
  pen.fillStyle = "#10202f"; pen.fillText(text, x, y);
}

function drawTicks(pen, width, X, Y, reach) {
  const step = [1, 2, 5, 10, 20, 50].find(each => reach / each <= 4.5) || 100;
  pen.fillStyle = style("--soft"); pen.strokeStyle = style("--line"); pen.lineWidth = 1;
  for (let value = -Math.floor(reach / step) * step; value <= reach; value += step) {
    pen.beginPath(); pen.moveTo(X(value), width); pen.lineTo(X(value), width - 5); pen.moveTo(0, Y(value)); pen.lineTo(5, Y(value)); pen.stroke();
    pen.textAlign = "center"; pen.textBaseline = "bottom"; pen.fillText(value === 0 ? "0 mm" : value, X(value), width - 6);
    pen.textAlign = "left"; pen.textBaseline = "middle"; if (value) pen.fillText(value, 8, Y(value));
  }
}

function drawScale(quantity) {
  const { pen, width } = prepare(byId("scale")), edge = 14, long = width - 2 * edge;
  for (let i = 0; i < long; i++) { pen.fillStyle = `rgb(${colour(i / long)})`; pen.fillRect(edge + i, 4, 1.5, 14); }
  pen.fillStyle = style("--ink"); pen.textAlign = "center"; pen.textBaseline = "top";
  let last = -Infinity;
  for (const value of round125(...quantity.colours)) {
    const x = edge + long * share(Math.log(value), quantity.colours);
    pen.fillRect(x - 0.5, 4, 1, 18);
    if (x - last > 34) { pen.fillText(digits(value), x, 24); last = x; }
  }
  pen.textAlign = "right"; pen.textBaseline = "bottom";
}

function ringStatistics(sheet, ring) {
  const logs = Array.from(sheet.subarray(ring * data.angles, (ring + 1) * data.angles)).sort((a, b) => a - b);
  return { median: Math.exp(logs[data.angles >> 1]), worst: Math.exp(logs[data.angles - 1]) };
}

function drawCurve(sheet, quantity) {
  const { pen, width, height } = prepare(byId("curve")), left = 40, right = 8, top = 8, bottom = 34;
  const [low, high] = quantity.colours;
  const X = mm => left + (width - left - right) * mm / data.radius_mm;
  const Y = value => top + (height - top - bottom) * (1 - Math.min(Math.max(share(Math.log(value), [low, high]), 0), 1));
  pen.fillStyle = style("--soft"); pen.strokeStyle = style("--line"); pen.lineWidth = 1;
  pen.textAlign = "right"; pen.textBaseline = "middle";
  let last = Infinity;
  for (const value of round125(low, high)) {
    const y = Y(value);
    pen.beginPath(); pen.moveTo(left, y); pen.lineTo(width - right, y); pen.stroke();
    if (last - y > 14) { pen.fillText(digits(value), left - 4, y); last = y; }
  }
  pen.textAlign = "center"; pen.textBaseline = "top";
  const step = [1, 2, 5, 10, 20, 50].find(each => data.radius_mm / each <= 6) || 100;
  for (let mm = 0; mm <= data.radius_mm; mm += step) pen.fillText(mm, X(mm), height - bottom + 4);
  pen.fillText(`distance, mm; line: median, dots: worst, ${quantity.unit}`, (left + width - right) / 2, height - 15);
  pen.strokeStyle = style("--ink"); pen.setLineDash([6, 4]);
  pen.beginPath(); pen.moveTo(X(data.area.radius_mm), top); pen.lineTo(X(data.area.radius_mm), height - bottom); pen.stroke();
  for (const [name, dash, thick] of [["median", [], 2], ["worst", [2, 4], 2]]) {
    pen.setLineDash(dash); pen.lineWidth = thick; pen.beginPath();
    for (let ring = 0; ring < data.rings; ring++) pen.lineTo(X((ring + 1) / data.rings * data.radius_mm), Y(ringStatistics(sheet, ring)[name]));
    pen.stroke();
  }
  pen.setLineDash([]);
}

/* Numbers */

function statistics(sheet) { // in the working area, each position weighted with its area
  const inside = [];
  let sum = 0, square = 0;
  for (let ring = 0; ring < data.rings; ring++) {
    if ((ring + 1) / data.rings * data.radius_mm > data.area.radius_mm * (1 + 1e-9)) break;
    for (let angle = 0; angle < data.angles; angle++) {
      const value = Math.exp(sheet[ring * data.angles + angle]);
      inside.push([value, ring + 1]);
      sum += ring + 1; square += (ring + 1) * value * value;
    }
  }
  if (!inside.length) return { median: NaN, rms: NaN, worst: NaN };
  inside.sort((a, b) => a[0] - b[0]);
  let reached = 0;
  const median = inside.find(([, weight]) => (reached += weight) >= sum / 2)[0];
  return { median, rms: Math.sqrt(square / sum), worst: inside[inside.length - 1][0] };
}

function fill(element, rows) {
  element.replaceChildren(...rows.flatMap(([name, text]) => {
    const term = document.createElement("dt"), value = document.createElement("dd");
    term.textContent = name; value.textContent = text;
    return [term, value];
  }));
}

function place(distance) {
  if (distance > data.radius_mm) return "beyond what was searched";
  if (distance <= data.area.radius_mm) return "in the working area";
  return "outside the working area";
}

function write(sheets) {
  const distance = Math.hypot(state.x, state.y);
  const [position, relative] = ["position", "force"].map(name => Math.exp(valueAt(sheets[name], state.x, state.y)));
  fill(byId("reading"), [
    ["at", `(${state.x.toFixed(2)}, ${state.y.toFixed(2)}) mm`],
    ["", place(distance)],
    ["position", `${digits(position)} mm rms`],
    ["force", `${digits(relative)} % (${digits(relative / 100 * force())} N)`],
  ]);
  byId("summary").replaceChildren(...["position", "force"].map(name => {
    const row = document.createElement("tr"), head = document.createElement("th"), values = statistics(sheets[name]);
    head.scope = "row"; head.textContent = `${name}, ${QUANTITIES[name].unit}`;
    row.append(head, ...["median", "rms", "worst"].map(key => Object.assign(document.createElement("td"), { textContent: digits(values[key]) })));
    return row;
  }));
  byId("force-text").textContent = `${force().toPrecision(3)} N`;
  byId("force").setAttribute("aria-valuetext", `${force().toPrecision(3)} newton`);
  byId("map").setAttribute("aria-label", `Least ${QUANTITIES[state.quantity].title} error on the film at ${force().toPrecision(3)} newton`);
}

let waiting = false;

function refresh() { // at most once a frame
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    const sheets = { position: sheet("position"), force: sheet("force") }, quantity = QUANTITIES[state.quantity];
    drawMap(sheets[state.quantity], quantity.colours);
    drawScale(quantity);
    drawCurve(sheets[state.quantity], quantity);
    write(sheets);
  });
}

/* Events */

function pointAt(event) {
  const box = byId("map").getBoundingClientRect();
  state.x = (event.clientX - box.left - view.middle) / view.scale;
  state.y = (view.middle - (event.clientY - box.top)) / view.scale;
  refresh();
}

const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
byId("map").addEventListener("pointermove", pointAt);
byId("map").addEventListener("pointerdown", pointAt);
byId("map").addEventListener("keydown", event => {
  const step = STEPS[event.key];
  if (!step) return;
  event.preventDefault();
  const size = event.shiftKey ? 1 : 0.1, limit = value => Math.min(Math.max(value, -view.reach), view.reach);
  state.x = limit(Math.round((state.x + size * step[0]) * 100) / 100);
  state.y = limit(Math.round((state.y + size * step[1]) * 100) / 100);
  refresh();
});
byId("force").addEventListener("input", event => { state.share = event.target.value / 1000; refresh(); });
for (const choice of document.querySelectorAll("input[name=quantity]"))
  choice.addEventListener("change", () => { state.quantity = choice.value; refresh(); });
new ResizeObserver(refresh).observe(byId("map"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", refresh);

const [first, last] = [data.force_N[0], data.force_N[data.force_N.length - 1]];
state.share = last > first ? Math.min(Math.max(Math.log(1 / first) / Math.log(last / first), 0), 1) : 0;
byId("force").value = Math.round(1000 * state.share);
byId("force").disabled = !(last > first);
byId("scene").textContent = `${data.probe}, noise ${data.noise}, ${first} to ${last} N`;
byId("words").textContent = data.area.words;
refresh();
