// The samples of a flight: asked from the server, kept in typed arrays by topic and channel.
import {Series} from "./series.js";

const PATIENCE = 10_000; // ms; the server answers within 2 s, also without news
const GRACE = 500; // ms, in which a page that was frozen takes what came meanwhile, before its patience counts

// The token of the address, after #: a browser sends this part to no server. The storage is of this tab and this port alone.
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1));
  if (given.has("token")) {
    sessionStorage.setItem("token", given.get("token"));
    given.delete("token");
    history.replaceState(null, "", `#${given}`); // without the token in the bar and in the history of the tab
  }
  return sessionStorage.getItem("token") ?? "";
}

const TOKEN = takeToken();
export const HEADERS = {"X-Page-Token": TOKEN};

// An answer of the server (server.py, answer): its head, and the time and the columns of each topic in the head.
export function decode(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  let place = 4 + size;
  for (const topic of head.topics) {
    topic.t = new Float64Array(buffer, place, topic.count);
    place += 8 * topic.count;
    topic.columns = topic.channels.map((_, k) => new Float32Array(buffer, place + 4 * k * topic.count, topic.count));
    place += Math.ceil((4 * topic.count * topic.channels.length) / 8) * 8;
  }
  return head;
}

export class Flight { // one flight of the server
  constructor(number) {
    this.number = number;
    this.socket = null;
    this.head = {state: "", faults: [], bands: {}, models: {}, described: "", ghost: false, fleet: 0, start: 0};
    this.clear("");
  }

  clear(epoch) {
    this.epoch = epoch;
    this.info = {name: "", modes: {}, units: {}, positive: {}, limits: {}, gusts: [], commands: [], learned: []};
    this.series = new Map();
    this.events = [];
    this.begin = Infinity;
    this.end = -Infinity;
  }

  query() { // what this page knows
    const known = {epoch: this.epoch, state: this.head.state, described: this.head.described, events: this.events.length};
    for (const [name, series] of this.series) known[name] = series.count;
    return new URLSearchParams(known).toString();
  }

  take(head) { // true when samples came
    if (head.epoch !== this.epoch) this.clear(head.epoch);
    for (const {name, channels, first, t, columns} of head.topics) {
      if (first === 0) this.series.set(name, new Series(channels));
      const series = this.series.get(name);
      if (series === undefined || series.count !== first) continue;
      series.append(t, columns);
      this.begin = Math.min(this.begin, t[0]);
      this.end = Math.max(this.end, t[t.length - 1]);
    }
    if (head.first_event === this.events.length) {
      this.events.push(...head.events.map(([t, kind, text]) => ({t, kind, text})));
      if (head.events.length) this.events.sort((one, other) => one.t - other.t); // topics arrive one behind another
    }
    if (head.flight) this.info = {...this.info, ...head.flight};
    const {state, faults, bands, models, described, ghost, fleet, start, control} = head;
    this.head = {state, faults, bands, models, described, ghost, fleet, start, control};
    return head.topics.length > 0;
  }

  async poll() { // one request; true when samples came
    if (this.socket?.readyState === WebSocket.OPEN) {
      const content = await this.ask();
      if (content) return this.take(decode(content));
    }
    const response = await fetch(`data/${this.number}?${this.query()}`, {headers: HEADERS, signal: AbortSignal.timeout(PATIENCE)});
    if (!response.ok) throw new Error(await response.text());
    const content = await response.arrayBuffer();
    this.socket ??= this.open();
    return this.take(decode(content));
  }

  open() { // a socket that never opens stays, and its flight asks by HTTP
    const socket = new WebSocket(new URL(`news/${this.number}`, location.href.replace("http", "ws")));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      socket.onclose = () => { this.socket = null; };
      socket.send(TOKEN);
    };
    return socket;
  }

  ask() { // the answer to a message that holds what this page knows; null where the server closes, as after a pause
    return new Promise((answer, refuse) => {
      const {socket} = this, end = () => {
        clearTimeout(patience);
        socket.onclose = null;
        socket.close();
        this.socket = null;
        answer(null);
      };
      const hangs = () => { // no close event: it waits for the server
        refuse(new DOMException("", "NetworkError"));
        end();
      };
      let patience = setTimeout(() => { patience = setTimeout(hangs, GRACE); }, PATIENCE);
      socket.onclose = end;
      socket.onmessage = ({data}) => { clearTimeout(patience); answer(data); };
      socket.send(this.query());
    });
  }

  get(topic) {
    return this.series.get(topic);
  }
}
