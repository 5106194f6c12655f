// The time line of a recording: where it is pressed, where we are, how fast it plays.

import { fit, theme } from "./theme.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 24], STEP_S = 5;

export class Timeline {
  constructor(root) {
    Object.assign(this, { root, canvas: root.querySelector("canvas"), slider: root.querySelector("input"), button: root.querySelector(".play"), length: 0, place: 0, speed: 1, isPlaying: true, isElsewhere: true, state: {} });
    this.select = root.querySelector("select");
    this.select.replaceChildren(...SPEEDS.map((speed) => new Option(`${speed} ×`, speed, speed === 1, speed === 1)));
    this.select.addEventListener("change", () => { this.speed = Number(this.select.value); });
    this.button.addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    root.hidden = false;
  }

  toggle() {
    if (!this.isPlaying && this.place >= this.length) this.seek(0);
    this.play(!this.isPlaying);
  }

  step(direction) { this.seek(this.place + direction * STEP_S); }

  seek(place) {
    Object.assign(this, { place: Math.min(Math.max(place, 0), this.length), isElsewhere: true });
    this.show();
  }

  /** Move on by the seconds that have passed. While the recording is still being read, wait at its end. */
  advance(elapsed_s) {
    if (this.isPlaying) this.place = Math.min(this.place + this.speed * elapsed_s, this.length);
    if (this.isPlaying && this.state.is_complete && this.place >= this.length) this.play(false);
    const { isElsewhere } = this;
    this.isElsewhere = false;
    this.show();
    return { until_s: this.place, isElsewhere };
  }

  play(isPlaying) {
    this.isPlaying = isPlaying;
    this.button.textContent = isPlaying ? "Pause" : "Play";
    this.button.setAttribute("aria-pressed", String(isPlaying));
    this.show();
  }

  update(state) {
    const [start, end] = state.span ?? [0, 0];
    Object.assign(this, { state, start, length: end - start });
    this.slider.max = this.length;
    this.drawTrack();
    this.show();
  }

  show() {
    if (document.activeElement !== this.slider || !this.slider.matches(":active")) this.slider.value = this.place;
    const words = `${clock(this.place)} of ${clock(this.length)}${this.state.is_complete ? "" : " …"}`;
    const output = this.root.querySelector(".place");
    if (output.textContent !== words) { output.textContent = words; this.slider.setAttribute("aria-valuetext", words); }
  }

  drawTrack() {
    fit(this.canvas);
    const g = this.canvas.getContext("2d"), { width, height } = this.canvas, forces = this.state.overview ?? [], most = Math.max(...forces, 0.1);
    g.clearRect(0, 0, width, height);
    g.fillStyle = theme.line; g.fillRect(0, height - 2, width, 2);
    g.fillStyle = theme.accent;
    forces.forEach((force, k) => { const size = (height - 4) * Math.sqrt(force / most); g.fillRect(k * width / forces.length, height - size, Math.max(width / forces.length - 0.5, 1), size); });
    g.fillStyle = theme.touch;
    for (const [timestamp] of this.state.markers ?? []) g.fillRect((timestamp - this.start) / this.length * width - 1, 0, 3, height);
  }
}

function clock(seconds) {
  const whole = Math.floor(seconds), pad = (n) => String(n).padStart(2, "0");
  const hours = Math.floor(whole / 3600), rest = `${hours ? pad(Math.floor(whole / 60) % 60) : Math.floor(whole / 60)}:${pad(whole % 60)}`;
  return hours ? `${hours}:${rest}` : rest;
}
