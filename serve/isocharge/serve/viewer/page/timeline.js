// The time line of a recording: where it is pressed, where we are, how fast it plays.

import { fit, theme } from "./theme.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 24], STEP_S = 5;

export class Timeline {
  constructor(root, send) {
    Object.assign(this, { root, send, canvas: root.querySelector("canvas"), slider: root.querySelector("input"), button: root.querySelector(".play"), length: 0, place: 0, isPlaying: true, state: {} });
    this.select = root.querySelector("select");
    this.select.replaceChildren(...SPEEDS.map((speed) => new Option(`${speed} ×`, speed, speed === 1, speed === 1)));
    this.select.addEventListener("change", () => send({ do: "speed", value: Number(this.select.value) }));
    this.button.addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    root.hidden = false;
  }

  toggle() { this.send({ do: this.isPlaying ? "pause" : "play" }); }

  step(direction) { this.seek(this.place + direction * STEP_S); }

  seek(place) {
    this.place = Math.min(Math.max(place, 0), this.length);
    this.send({ do: "seek", value: this.place });
    this.show();
  }

  play({ at_s: at, speed, is_playing: isPlaying }) {
    Object.assign(this, { place: at, isPlaying });
    this.select.value = String(speed);
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

  /** A sample that is now shown. */
  at(timestamp) { if (this.state.span) { this.place = Math.min(Math.max(timestamp - this.start, 0), this.length); this.show(); } }

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
