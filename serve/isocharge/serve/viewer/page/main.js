// The page: connects, hands samples to the film, draws, and takes keys and buttons.

import { Connection } from "./connection.js";
import { FilmView, setText } from "./film.js";
import { onTheme } from "./theme.js";
import { Timeline } from "./timeline.js";

const SLOW_MS = 500, PACE_MS = 20, RAREST = 8, LONGEST_MS = 80;
const page = { film: null, timeline: null, isPaused: false, pictures: 0, cost: 0, pace: 16, every: 1 };
const connection = new Connection({ session, samples, state, error, position, link, door });
const nowMs = () => performance.now();

function session(content, isNew) {
  document.getElementById("door").hidden = true;
  if (!isNew) return;
  if (page.timeline) return location.reload(); // a replay has ended, and another program has its address
  page.film = new FilmView(content, act);
  document.getElementById("film").replaceChildren(page.film.root);
  page.film.start();
  if (content.is_replay) page.timeline = new Timeline(document.getElementById("timeline"));
  if (page.isPaused) pause(false);
  document.title = `${content.film.name} · isocharge ${content.is_replay ? "replay" : "live"}`;
}

function samples(message) {
  page.film.take(message, nowMs());
}

function state(changed) { page.film.update(changed); page.timeline?.update(changed); }

function error(text) { page.film.update({ ...page.film.state, note: { text, at: page.film.server_s } }); }

/** The position in a recording after some more seconds, s; nothing for a live stream. */
function position(elapsed_s) { return page.timeline?.advance(elapsed_s) ?? {}; }

function link(kind, words) {
  const shown = kind === "live" && page.isPaused ? ["paused", "paused"] : kind === "live" && page.timeline ? ["live", "replay"] : [kind, words];
  const pill = document.getElementById("link");
  page.link = [kind, words];
  pill.dataset.state = shown[0];
  setText(pill.querySelector(".text"), shown[1]);
}

function door(reason) {
  const form = document.getElementById("door");
  form.hidden = false;
  setText(form.querySelector(".reason"), reason);
  form.querySelector("[type=password]").focus();
  link("waiting", "a token, please");
}

function act(what) {
  if (what === "pause") return page.timeline ? page.timeline.toggle() : pause(!page.isPaused);
  if (what === "record") return connection.request({ do: "record", on: !page.film.state.recording });
  if (what === "tare" || what === "marker") return connection.request({ do: what });
  return undefined;
}

function pause(isPaused) {
  page.isPaused = isPaused;
  for (const button of document.querySelectorAll("[data-do=pause]")) {
    button.setAttribute("aria-pressed", String(isPaused));
    button.firstChild.textContent = isPaused ? "Go on " : "Pause ";
  }
  link(...page.link);
}

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input:not([type=range]), select, dialog[open]")) return;
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (name === " " && event.target.closest("button, summary")) return;
  const live = page.timeline === null, action = {
    t: live && (() => act("tare")), r: live && (() => act("record")), m: live && (() => act("marker")),
    " ": () => act("pause"), "?": () => document.getElementById("help").showModal(),
    ArrowLeft: !live && (() => page.timeline.step(-1)), ArrowRight: !live && (() => page.timeline.step(1)),
  }[name];
  if (!action || !page.film) return;
  if (!event.repeat || name.startsWith("Arrow")) action();
  event.preventDefault();
}

let slowMs = 0, beganMs = 0, heavyMs = 0;
function picture() {
  requestAnimationFrame(picture);
  const began = nowMs(), number = page.pictures++;
  page.pace += 0.05 * (Math.min(began - beganMs, 200) - page.pace);
  beganMs = began;
  const isDue = began - heavyMs > LONGEST_MS, heavy = {
    traces: isDue || number % Math.max(page.every, 2) === 0, relief: isDue || number % page.every === page.every >> 1,
  };
  if (heavy.traces) heavyMs = began;
  if (!page.isPaused) page.film?.draw(began, heavy);
  if (began - slowMs > SLOW_MS) showSlow(began);
  page.cost += 0.1 * (nowMs() - began - page.cost);
}

/** Words and counters; and where pictures come too seldom, the costly parts are drawn for fewer of them. */
function showSlow(began) {
  slowMs = began;
  if (page.pace > PACE_MS && page.every < RAREST) page.every *= 2;
  else if (page.pace < 0.9 * PACE_MS && page.every > 1) page.every /= 2;
  if (!page.isPaused) page.film?.showSlow(began);
}

addEventListener("keydown", key);
onTheme(() => page.film?.refresh());
addEventListener("resize", () => { page.film?.refresh(); page.timeline?.drawTrack(); });
document.getElementById("help-button").addEventListener("click", () => document.getElementById("help").showModal());
document.getElementById("door").addEventListener("submit", (event) => {
  event.preventDefault();
  connection.enter(event.target.querySelector("[type=password]").value);
});
globalThis.isocharge = { page, connection };
connection.open();
requestAnimationFrame(picture);
