// The session, and then the samples that are new since the last answer, again and again, all over HTTP.

import { decode } from "./decode.js";

const FIRST_PAUSE_MS = 300, LONGEST_PAUSE_MS = 4000, IDLE_MS = 40, RATE_PER_MS = 0.24, MOST = 600, KEY = "isocharge token";

export class Connection {
  /** @param on {{session, samples, state, error, position, link, door}} functions that are called with what comes */
  constructor(on) {
    this.on = on;
    this.pause = FIRST_PAUSE_MS;
    this.id = null;
    this.token = takeToken();
  }

  async open() {
    this.on.link("waiting", this.id === null ? "connecting" : "connecting again");
    try {
      const session = await this.fetch("session.json");
      this.on.session(session, session.id !== this.id);
      this.id = session.id;
      await this.follow(session);
    } catch (error) {
      if (error.status === 401) return this.on.door(this.token ? "This token is wrong." : "");
      this.on.link("lost", `${wordsOf(error)}; trying again`);
      setTimeout(() => this.open(), this.pause);
      this.pause = Math.min(2 * this.pause, LONGEST_PAUSE_MS);
    }
    return undefined;
  }

  /** Ask for what is new whenever a picture was drawn, until an answer fails. A recording may be shown from another position. */
  async follow({ columns }) {
    let first = null, version = -1, askedMs = performance.now();
    for (;;) {
      const nowMs = performance.now(), elapsedMs = nowMs - askedMs, { isElsewhere, until_s } = this.on.position(elapsedMs / 1000);
      askedMs = nowMs;
      const beginsAnew = first === null || isElsewhere;
      const most = beginsAnew ? MOST : Math.min(Math.max(Math.ceil(RATE_PER_MS * elapsedMs), 1), MOST);
      const answer = await this.post({ do: "read", first: beginsAnew ? null : first, until_s, version, most });
      const travelMs = (performance.now() - nowMs) / 2; // of the answer: half of the time since the question
      first = Math.max(answer.first, beginsAnew ? 0 : first);
      this.pause = FIRST_PAUSE_MS;
      this.on.link("live", "live");
      if (answer.state) { version = answer.version; this.on.state(answer.state); }
      const samples = answer.samples.map((row) => decode(row, columns));
      this.on.samples({ samples, beginsAnew, missed: answer.missed, sent_s: answer.sent_s, travelMs });
      if (!samples.length) await new Promise((resolve) => setTimeout(resolve, IDLE_MS));
      await new Promise(requestAnimationFrame);
    }
  }

  enter(token) {
    this.token = token;
    try { sessionStorage.setItem(KEY, token); } catch { /* a browser may forbid it: the token is asked for again */ }
    this.open();
  }

  async request(content) {
    try { await this.post(content); } catch (error) { this.on.error(wordsOf(error)); }
  }

  post(content) { return this.fetch("request", { method: "POST", body: JSON.stringify(content) }); }

  async fetch(path, options = {}) {
    const headers = this.token ? { Authorization: `Bearer ${this.token}` } : {};
    const answer = await fetch(path, { headers, cache: "no-store", ...options });
    const content = await answer.json();
    if (!answer.ok) throw Object.assign(new Error(content.error ?? answer.statusText), { status: answer.status });
    return content;
  }
}

/** Browsers have different words for a server that does not answer. */
function wordsOf(error) { return error instanceof TypeError ? "no answer" : error.message; }

/** The token in the address after #, which is taken out of it and never sent as part of it. */
function takeToken() {
  let given = location.hash.slice(1);
  try {
    given = decodeURIComponent(given);
    if (given) sessionStorage.setItem(KEY, given);
    if (given) history.replaceState(null, "", location.pathname);
    return given || sessionStorage.getItem(KEY) || "";
  } catch { return given; }
}
