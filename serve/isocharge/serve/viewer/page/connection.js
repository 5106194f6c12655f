// The session over HTTP, the samples over a WebSocket that is opened again whenever it breaks.

const PROTOCOL = "isocharge.live.1", FIRST_PAUSE_MS = 300, LONGEST_PAUSE_MS = 4000, KEY = "isocharge token";

export class Connection {
  /** @param on {{session, samples, message, state, door}} functions that are called with what comes */
  constructor(on) {
    this.on = on;
    this.pause = FIRST_PAUSE_MS;
    this.id = null;
    this.token = takeToken();
  }

  async open() {
    this.on.state("waiting", this.id === null ? "connecting" : "connecting again");
    try {
      const headers = this.token ? { Authorization: `Bearer ${this.token}` } : {};
      const answer = await fetch("session.json", { headers, cache: "no-store" });
      if (answer.status === 401) return this.on.door(this.token ? "The server knows another one." : "");
      if (!answer.ok) throw new Error((await answer.json()).error ?? answer.statusText);
      const session = await answer.json();
      this.on.session(session, session.id !== this.id);
      this.id = session.id;
    } catch (error) {
      return this.tryAgain(error.name === "TypeError" ? "no answer" : error.message);
    }
    this.follow();
  }

  follow() {
    const url = new URL("live", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    const bearer = this.token ? [`bearer.${base64url(this.token)}`] : [];
    const socket = new WebSocket(url, [PROTOCOL, ...bearer]);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.pause = FIRST_PAUSE_MS; this.on.state("live", "live"); };
    socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return this.on.samples(data);
      let message;
      try { message = JSON.parse(data); } catch { return undefined; }
      return this.on.message(message);
    };
    socket.onclose = ({ code }) => { if (this.socket === socket) this.tryAgain(code === 1012 ? "the stream has ended" : "lost"); };
  }

  tryAgain(reason) {
    this.socket = null;
    this.on.state("lost", `${reason}; trying again`);
    setTimeout(() => this.open(), this.pause);
    this.pause = Math.min(2 * this.pause, LONGEST_PAUSE_MS);
  }

  enter(token) {
    this.token = token;
    try { sessionStorage.setItem(KEY, token); } catch { /* a browser may forbid it: the token is asked for again */ }
    this.open();
  }

  request(content) { this.send(JSON.stringify(content)); }

  confirm(number) { this.send(new Uint32Array([number])); }

  send(data) { if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(data); }
}

/** The token in the address after #, which is taken out of it and never sent as part of it. */
function takeToken() {
  const given = decodeURIComponent(location.hash.slice(1));
  try {
    if (given) sessionStorage.setItem(KEY, given);
    if (given) history.replaceState(null, "", location.pathname);
    return given || sessionStorage.getItem(KEY) || "";
  } catch { return given; }
}

function base64url(text) {
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
