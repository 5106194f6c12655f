// The playground: a press of the visitor, the charges that it gives, and what the network computes from them.

import { lineStyle, onTheme, theme } from "./theme.js";

const GRID_STEP_MM = 0.75, GRID_REACH_MM = 24, FRAME_MS = 70, WORK_MS = 9, WRONG_STDS = 4, MAX_TRAIL = 80;
const START = { x: 3, y: -2 }, START_FORCE_N = 0.5, START_NOISE = 1, KEY_STEP_MM = 0.5;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const BAR_SCALES_PC = [250, 500, 1000, 2500, 5000, 10000];

const find = (id) => document.getElementById(id);

class Playground {
  constructor(data, sensors) {
    this.meanings = data.flags;
    this.sensors = sensors;
    this.grids = new Map();
    this.press = { ...START };
    this.force = START_FORCE_N;
    this.faults = { noise: START_NOISE, wrongGain: -1, dead: -1 };
    this.trail = [];
    this.normal = normalNumber;
    this.drawnMs = -Infinity;
    this.buildControls();
    this.chooseSensor(0);
    onTheme(() => { this.stage.refresh(); this.buildLegend(); this.isNew = true; });
    addEventListener("resize", () => { this.isNew = true; });
    requestAnimationFrame((now) => this.tick(now));
  }

  buildControls() {
    const canvas = find("stage");
    const move = (event) => this.movePress(this.stage.place(event));
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); move(event); });
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) move(event); });
    canvas.addEventListener("keydown", (event) => {
      const step = ARROWS[event.key];
      if (!step) return;
      event.preventDefault();
      this.movePress({ x: this.press.x + KEY_STEP_MM * step[0], y: this.press.y + KEY_STEP_MM * step[1] });
    });
    this.sensors.forEach((sensor, index) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = String(sensor.description.electrodes.length);
      button.title = sensor.description.name;
      button.addEventListener("click", () => this.chooseSensor(index));
      find("models").append(button);
    });
    find("force").addEventListener("input", () => this.setForce(this.forceOfSlider(Number(find("force").value))));
    find("noise").addEventListener("input", () => this.setFaults({ noise: Number(find("noise").value) }));
    find("wrong-gain").addEventListener("change", () => this.setFaults({ wrongGain: Number(find("wrong-gain").value) }));
    find("dead").addEventListener("change", () => this.setFaults({ dead: Number(find("dead").value) }));
    const none = { wrongGain: -1, dead: -1 };
    const scenarios = {
      "A good press": () => this.showScenario({ x: 3, y: -2 }, none),
      "A press in the mirror region": () => this.showScenario({ x: -9.5, y: 15.5 }, none),
      "A dead electrode": () => this.showScenario({ x: -2, y: 3 }, { ...none, dead: 0 }),
      "A wrong gain": () => this.showScenario({ x: -1, y: 1 }, { ...none, wrongGain: 1 }),
    };
    for (const [name, show] of Object.entries(scenarios)) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name;
      button.addEventListener("click", show);
      find("scenarios").append(button);
    }
  }

  get sensor() { return this.sensors[this.sensorIndex]; }

  chooseSensor(index) {
    this.sensorIndex = index;
    this.stage = new Stage(find("stage"), this.sensor.description);
    const { electrodes } = this.sensor.description;
    this.faults = { ...this.faults, wrongGain: -1, dead: -1 };
    for (const id of ["wrong-gain", "dead"]) {
      const options = ["none", ...electrodes].map((name, k) => new Option(name, String(k - 1)));
      find(id).replaceChildren(...options);
    }
    [...find("models").querySelectorAll("button")].forEach((button, k) => button.setAttribute("aria-pressed", String(k === index)));
    if (!this.grids.has(index)) {
      this.grids.set(index, new ChargeGrid(this.sensor.electrodes, this.sensor.series, GRID_REACH_MM, GRID_STEP_MM));
    }
    this.buildLegend();
    this.buildBars();
    this.showSettings();
  }

  showScenario(press, faults) {
    this.setFaults(faults);
    this.movePress(press);
  }

  movePress({ x, y }) {
    const limit = Math.min(1, (this.sensor.series.maxDistance - 0.1) / Math.hypot(x, y));
    this.press = { x: x * limit, y: y * limit };
    this.trail = [];
    this.isNew = true;
  }

  setForce(force) {
    this.force = force;
    this.showSettings();
  }

  setFaults(faults) {
    Object.assign(this.faults, faults);
    this.showSettings();
  }

  forceOfSlider(position) {
    const [low, high] = this.sensor.description.force_range_N;
    return low * (high / low) ** position;
  }

  showSettings() {
    const [low, high] = this.sensor.description.force_range_N;
    find("force").value = String(Math.log(this.force / low) / Math.log(high / low));
    find("force-text").textContent = `${this.force.toFixed(2)} N`;
    find("noise").value = String(this.faults.noise);
    const { white_pC: white, gain } = this.sensor.description.noise;
    const size = `${(this.faults.noise * white).toFixed(1)} pC and ${(100 * this.faults.noise * gain).toFixed(1)} %`;
    find("noise-text").textContent = this.faults.noise ? size : "none";
    find("wrong-gain").value = String(this.faults.wrongGain);
    find("dead").value = String(this.faults.dead);
    this.trail = [];
    this.isNew = true;
  }

  /** Draw a frame with new noise every `FRAME_MS`, and use the rest of the time for the grid. */
  tick(nowMs) {
    if (this.isNew || (this.faults.noise && nowMs - this.drawnMs > FRAME_MS)) this.update(nowMs);
    const grid = this.grids.get(this.sensorIndex);
    if (!grid.isComplete) {
      grid.fillUntil(performance.now() + WORK_MS);
      if (grid.isComplete) this.isNew = true;
    }
    requestAnimationFrame((now) => this.tick(now));
  }

  update(nowMs) {
    const { sensor, press, force } = this;
    const startMs = performance.now();
    const charges = sensor.measured(sensor.charges(press.x, press.y, force), this.faults, this.normal);
    const answer = sensor.answer(charges);
    const flags = sensor.flags(answer);
    this.latencyMs = performance.now() - startMs;
    this.result = { charges, answer, flags, kind: kindOf(flags) };
    this.trail.push(answer);
    if (this.trail.length > MAX_TRAIL) this.trail.shift();
    this.drawnMs = nowMs;
    this.isNew = false;
    this.draw();
    this.showAnswer();
  }

  draw() {
    const { charges, answer, kind } = this.result;
    const grid = this.grids.get(this.sensorIndex);
    const [low, high] = this.sensor.description.force_range_N;
    const force = Math.min(Math.max(answer.force, low), high);
    const isDrawn = grid.isComplete && Number.isFinite(answer.force);
    const curves = isDrawn ? charges.map((charge, electrode) => grid.isocharge(electrode, charge, force)) : [];
    const word = grid.isComplete ? "" : "computing the isocharge curves";
    const hasLens = isDrawn && kind !== "misfit";
    const lensCurves = hasLens ? localIsocharges(this.sensor, charges, { ...answer, force }) : [];
    const sample = { ...answer, contact: true, otherX: null, otherY: null };
    this.stage.draw({ press: this.press, sample, kind, trail: this.trail, curves, lensCurves, word });
  }

  showAnswer() {
    const { charges, answer, flags } = this.result;
    const put = (name, value, std, digits) => {
      const cell = document.querySelector(`.values .${name}`);
      cell.querySelector("b").textContent = value.toFixed(digits).replace("-", "−");
      cell.querySelector(".std").textContent = `± ${std.toFixed(digits)}`;
    };
    put("force", answer.force, answer.forceStd, 3);
    put("x", answer.x, answer.xStd, 2);
    put("y", answer.y, answer.yStd, 2);
    const signed = (value) => value.toFixed(2).replace("-", "−");
    find("truth").textContent = `Your press: ${this.force.toFixed(3)} N at (${signed(this.press.x)}, ${signed(this.press.y)}) mm. ± is one standard deviation.`;
    const largest = Math.max(...charges);
    const scale = BAR_SCALES_PC.find((candidate) => candidate >= largest) ?? largest;
    charges.forEach((charge, k) => {
      const bar = find("bars").children[k];
      bar.querySelector("i").style.width = `${100 * Math.max(charge, 0) / scale}%`;
      bar.querySelector("output").textContent = `${Math.round(charge)} pC`.replace("-", "−");
    });
    const items = flags.map((flag) => {
      const item = document.createElement("li");
      const name = document.createElement("b");
      name.textContent = flag;
      item.append(name, ` ${this.meanings[flag]}`);
      return item;
    });
    find("flags").replaceChildren(...(items.length ? items : ["none"]));
    this.showVerdict();
    if (!this.speedMs || performance.now() - this.speedMs > 1000) this.showSpeed();
  }

  /** Say in a sentence whether the answer is right, and if not, why. */
  showVerdict() {
    const { answer, flags } = this.result;
    const error = Math.hypot(answer.x - this.press.x, answer.y - this.press.y);
    const std = Math.hypot(answer.xStd, answer.yStd);
    const isWrong = error > WRONG_STDS * std || Math.abs(answer.force - this.force) > WRONG_STDS * answer.forceStd;
    const isFlagged = flags.some((flag) => flag !== "stress");
    const isInside = this.sensor.isInWorkingArea(this.press.x, this.press.y);
    const distance = `${error.toFixed(error < 1 ? 2 : 1)} mm from your press`;
    const hasFault = this.faults.wrongGain >= 0 || this.faults.dead >= 0;
    let kind = "good";
    let text = `The answer is ${distance}.`;
    if (isFlagged) {
      kind = "outside";
      text = `The network reports that this answer cannot be trusted (${flags.join(", ")}).`;
    } else if (isWrong && !isInside) {
      kind = "misfit";
      text = `Wrong without a flag: the answer is ${distance}. Here a press gives nearly the charges of a press inside the working area (mirror region).`;
    } else if (isWrong && hasFault) {
      kind = "misfit";
      text = `Wrong without a flag: the answer is ${distance}. These charges also belong to another press, so the fault cannot be noticed.`;
    }
    const verdict = find("verdict");
    verdict.dataset.kind = kind;
    const words = verdict.querySelector(".text");
    if (words.textContent !== text) words.textContent = text;
  }

  showSpeed() {
    this.speedMs = performance.now();
    find("speed").textContent = `One answer takes ${this.measureLatency().toFixed(2)} ms in this browser. Model ${this.sensor.description.model}, `
      + "film and network as released with isocharge.";
  }

  /** Return the mean time of an answer from charges, ms. */
  measureLatency(count = 20) {
    const { charges } = this.result;
    const startMs = performance.now();
    for (let k = 0; k < count; k++) this.sensor.flags(this.sensor.answer(charges));
    return (performance.now() - startMs) / count;
  }

  buildBars() {
    find("bars").replaceChildren(...this.sensor.description.electrodes.map((name, k) => {
      const bar = document.createElement("div");
      bar.className = "bar";
      bar.innerHTML = `<b>${name}</b><div><i style="background: var(--${lineStyle(k).name})"></i></div><output></output>`;
      return bar;
    }));
  }

  buildLegend() {
    const line = ({ colour, dash }) => `<line x1="0" y1="9" x2="26" y2="9" stroke="${colour}" stroke-width="2.4" stroke-dasharray="${dash.join(" ")}"/>`;
    const cross = `<path d="M13 0V18M4 9H22" stroke="${theme.ink}" stroke-width="2.4"/>`;
    const dot = `<circle cx="13" cy="9" r="7" fill="${theme.touch}"/>`;
    const ellipse = `<ellipse cx="13" cy="9" rx="10" ry="5" fill="none" stroke="${theme.ink}" stroke-width="1.8"/>`;
    const area = `<rect x="1" y="1" width="24" height="16" fill="${theme.area}" stroke="${theme.accent}" stroke-dasharray="4 3"/>`;
    const hatch = `<rect x="1" y="1" width="24" height="16" fill="${theme.warn}" fill-opacity=".12"/><path d="M1 17L17 1M9 17L25 1" stroke="${theme.warn}"/>`;
    const [first, second] = this.sensor.description.electrodes;
    const entries = [
      [cross, "your press"],
      [dot, "the network's answer; a larger dot is a larger force"],
      [line(lineStyle(0)), `isocharge curve of ${first}: all places where a press of this force gives ${first} its charge`],
      [line(lineStyle(1)), `isocharge curve of ${second}, and so on. They cross at the contact`],
      [ellipse, "in the lens, 1 mm around the answer: 95 of 100 presses lie in this ellipse"],
      [area, "working area, for which the network was trained"],
      [hatch, "mirror region: most presses here are answered as a press in the working area, without a flag"],
    ];
    find("legend").innerHTML = entries.map(([picture, words]) => `<svg viewBox="0 0 26 18" aria-hidden="true">${picture}</svg><span>${words}</span>`).join("");
  }
}

/** Return how the live page draws an answer with some flags. */
function kindOf(flags) {
  if (flags.includes("misfit") || flags.includes("beyond")) return "misfit";
  if (flags.includes("outside")) return "outside";
  return "contact";
}

async function start() {
  const data = JSON.parse(find("data").textContent);
  const series = new StressSeries(data.stress);
  const sensors = await Promise.all(data.models.map(async (description) => new PlaygroundSensor(description, series, await unpack(description.network))));
  window.isocharge = { playground: new Playground(data, sensors) };
}

start();
