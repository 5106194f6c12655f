// One film on the page: its views, its values in words and numbers, its buttons.

import { History } from "./history.js";
import { Plan } from "./plan.js";
import { Relief } from "./relief.js";
import { Traces } from "./traces.js";

const SILENT_MS = 1500, SPOKEN_MS = 150, FLAG_MS = 2500, NOTE_S = 12, SEEN_IN_VERDICT = new Set(["tare", "misfit", "outside", "invalid"]);
const COUNTERS = { frames: "frames", lost: "lost", repeated: "repeated", restarts: "restarts of the board", crc_errors: "wrong checksums",
  malformed: "malformed", bytes_dropped: "bytes dropped", reconnects: "reconnected", not_shown: "not shown here" };

export class FilmView {
  constructor(session, act) {
    const description = session.film;
    Object.assign(this, { description, act, isReplay: session.is_replay, state: {}, isPaused: false, missed: 0, arrivedMs: -Infinity, spokenMs: 0, ahead_s: 0, recent: new Map() });
    this.words = new Map(session.flags.map(({ word, bit, says }) => [word, { bit, says }]));
    this.root = document.getElementById("film-template").content.firstElementChild.cloneNode(true);
    this.history = new History(description.electrodes.length, this.isReplay);
    this.find = (selector) => this.root.querySelector(selector);
    this.find(".name").textContent = description.name;
    this.showModel(description.model);
    this.root.addEventListener("click", (event) => { const button = event.target.closest("[data-do]"); if (button) { act(button.dataset.do); if (event.detail) button.blur(); } });
    this.find(".buttons").hidden = this.isReplay; // the time line has the button of a recording
    this.latencies = [];
    this.ages = [];
  }

  showModel(label) {
    const isOfThisName = label.startsWith(`${this.description.name}/`);
    this.find(".model").textContent = isOfThisName ? `version ${label.slice(this.description.name.length + 1)}` : label;
  }

  /** Once the card is in the page and has a size. */
  start() {
    this.plan = new Plan(this.find(".plan canvas"), this.description);
    this.relief = new Relief(this.find(".relief canvas"), this.find(".relief figcaption"), this.description);
    const figures = Object.fromEntries(["charges", "force", "misfit"].map((name) => [name, this.find(`.trace.${name}`)]));
    this.traces = new Traces(figures, this.description, this.history);
  }

  refresh() { this.plan.refresh(); this.traces.build(); this.isNew = true; }

  take(message, nowMs) {
    if (message.beginsAnew) { this.history.clear(); Object.assign(this, { missed: 0, isNew: true }); }
    for (const sample of message.samples) {
      this.history.add(sample);
      if (sample.latency !== null) this.latencies.push(sample.latency);
      for (const [word, { bit }] of this.words) if (sample.bits & bit) this.recent.set(word, nowMs);
    }
    this.history.trim();
    this.missed += message.missed;
    this.ahead_s = message.sent_s - Date.now() / 1000;
    if (message.samples.length) Object.assign(this, { arrivedMs: nowMs, sent_s: message.sent_s, sentMs: nowMs - message.travelMs, isNew: true });
  }

  update(state) {
    const { note } = this.state; // stays until the server has a newer one
    this.state = note && !(state.note?.at > note.at) ? { ...state, note } : state;
    if (state.model) this.showModel(state.model);
    this.history.markers = state.markers ?? [];
    const record = this.find("[data-do=record]");
    record.setAttribute("aria-pressed", String(Boolean(state.recording)));
    record.title = state.recording ? `recording ${state.recording}` : "";
  }

  kind(nowMs) {
    const { latest } = this.history, has = (word) => latest && (latest.bits & (this.words.get(word)?.bit ?? 0));
    if (!this.isReplay && nowMs - this.arrivedMs > SILENT_MS) return "silent";
    if (!latest) return "none";
    if (has("tare")) return "tare";
    if (has("invalid")) return "silent";
    if (!latest.contact) return "none";
    return has("misfit") ? "misfit" : has("outside") ? "outside" : "contact";
  }

  /** @param heavy which of the costly parts to draw: {traces, relief} */
  draw(nowMs, heavy) {
    const kind = this.kind(nowMs), { history } = this, sample = history.latest;
    const word = { tare: "taring: leave the film alone", none: sample ? "no touch" : "", silent: "no data" }[kind];
    if (this.isNew || kind !== this.drawnKind) {
      this.plan.draw({ sample, kind, trail: history.trail, now: sample?.t ?? 0, word });
      this.showValues(sample, kind);
    }
    if (heavy.relief) this.relief.draw({ sample, kind });
    if (heavy.traces && this.isNew) this.traces.draw();
    if (this.isNew) this.noteAge(sample, nowMs);
    this.isNew = heavy.traces ? false : this.isNew;
    if (kind !== this.spokenKind && nowMs - this.spokenMs > SPOKEN_MS) this.showSlow(nowMs);
    this.drawnKind = kind;
  }

  /** Twice a second: words and counters. */
  showSlow(nowMs) {
    const kind = this.kind(nowMs);
    [this.spokenMs, this.spokenKind] = [nowMs, kind];
    const verdict = this.find(".verdict"), words = {
      contact: "touch", none: this.history.latest ? "no touch" : "waiting for the first frame", tare: "taring: leave the film alone",
      outside: "outside the area or the forces that the model knows: place and force are guesses",
      misfit: "no single contact fits these charges: two touches, or another film? The place means little",
      silent: Number.isFinite(this.arrivedMs) ? "no frame comes: does the stream run, and is the sensor plugged in?" : "waiting for the first frame",
    }[kind];
    verdict.dataset.kind = kind;
    setText(verdict.querySelector(".text"), words);
    this.showFlags(nowMs);
    this.showHealth();
  }

  showValues(sample, kind) {
    const sure = kind === "contact" || kind === "outside" || kind === "misfit", put = (name, value, std, digits) => {
      const place = this.find(`.values .${name}`);
      setText(place.querySelector("b"), sure && value !== null ? signed(value, digits) : name === "force" && kind === "none" && sample ? signed(0, digits) : "–");
      setText(place.querySelector(".std"), sure && std !== null ? `± ${Number(std.toFixed(digits)) ? std.toFixed(digits) : `under ${10 ** -digits}`}` : "");
    };
    put("force", sample?.force ?? null, sample?.forceStd ?? null, 3);
    put("x", sample?.x ?? null, sample?.xStd ?? null, 2);
    put("y", sample?.y ?? null, sample?.yStd ?? null, 2);
  }

  showFlags(nowMs) {
    for (const [word, at] of this.recent) if (nowMs - at > FLAG_MS) this.recent.delete(word);
    const shown = [...this.recent.keys()].filter((word) => !SEEN_IN_VERDICT.has(word)).sort();
    if (shown.join() === this.shownFlags) return;
    this.shownFlags = shown.join();
    this.find(".flags").replaceChildren(...shown.map((word) => {
      const line = document.createElement("li"), name = document.createElement("b");
      name.textContent = word;
      line.append(name, ` ${this.words.get(word).says}`);
      return line;
    }));
  }

  showHealth() {
    const { counters, rate_Hz: rate, note, recording_failed: failed, film } = this.state;
    setText(this.find(".rate"), rate ? `${rate.toFixed(0)} Hz` : "–");
    setText(this.find(".latency"), this.latencies.length ? `${percentile(this.latencies, 0.5).toFixed(0)} µs` : "–");
    setText(this.find(".age"), this.isReplay || !this.ages.length ? "–" : `${this.age.toFixed(0)} ms`);
    setText(this.find(".lost"), counters ? String(counters.lost) : "–");
    if (this.latencies.length > 2000) this.latencies.splice(0, this.latencies.length - 1000);
    const fresh = note && Math.abs(this.server_s - note.at) < NOTE_S ? note.text : "";
    const followed = film ? `film at ${film.pretension_MPa.toFixed(2)} ± ${film.pretension_std_MPa.toFixed(2)} MPa` : "";
    const recording = this.state.recording ? `recording ${this.state.recording}` : followed;
    setText(this.find(".note"), failed ? "recording stopped: the disk is full" : fresh || recording);
    if (counters && this.find("details").open) this.showCounters({ ...counters, not_shown: this.missed });
  }

  showCounters(counters) {
    const list = this.find(".counters");
    if (!list.children.length) list.append(...Object.entries(COUNTERS).map(([key, name]) => {
      const row = document.createElement("div");
      row.innerHTML = `<dt>${name}</dt><dd data-key="${key}"></dd>`;
      return row;
    }));
    for (const cell of list.querySelectorAll("dd")) setText(cell, (counters[cell.dataset.key] ?? 0).toLocaleString());
  }

  /**
   * Median of the latest times from a reading to its picture, ms. The clock of the board may be ahead of the server's.
   * Then the shortest of the times is negative, and the clocks differ by at least its amount.
   */
  get age() { return percentile(this.ages, 0.5) - Math.min(...this.ages, 0); }

  /** Present time by the server's clock, s. The clocks of the two machines may differ. */
  get server_s() { return Date.now() / 1000 + this.ahead_s; }

  /** From the reading to this picture: to the sending by the server's clock, from the sending by this one's. */
  noteAge(sample, nowMs) {
    if (!sample) return;
    this.ages.push((this.sent_s - sample.t) * 1000 + nowMs - this.sentMs);
    if (this.ages.length > 600) this.ages.splice(0, 300);
  }
}

function signed(value, digits) { const text = Math.abs(value).toFixed(digits); return value < 0 && Number(text) !== 0 ? `−${text}` : text; }

export function percentile(values, share) { return [...values].sort((a, b) => a - b)[Math.min(Math.floor(share * values.length), values.length - 1)]; }

export function setText(place, text) { if (place.textContent !== text) place.textContent = text; }
