// The WebSocket to the station: comes back by itself, hands over what is told, and pairs answers with questions.

const AGAIN_MS = [500, 1000, 2000, 4000];

export class Connection {
  #socket = null;
  #listeners = new Map();
  #answers = new Map();
  #id = 0;
  #tries = 0;

  /** `open`: called with true when there is a connection, and with false and a reason when there is none. */
  constructor(open) {
    this.onopen = open;
    this.#connect();
  }

  /** A number that no question or watch of this page had before. */
  get next() {
    return ++this.#id;
  }

  on(type, listener) {
    this.#listeners.set(type, [...(this.#listeners.get(type) ?? []), listener]);
  }

  /** Whether it could be sent. */
  send(request) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(JSON.stringify(request));
    return true;
  }

  /** The answer's text; rejects with the reason. */
  ask(request) {
    const id = this.next;
    return new Promise((resolve, reject) => {
      this.#answers.set(id, { resolve, reject });
      if (!this.send({ ...request, id })) this.#answer({ id, good: false, text: "no connection to the station" });
    });
  }

  #connect() {
    const socket = new WebSocket(`ws://${location.host}/socket`);
    this.#socket = socket;
    socket.onopen = () => {
      this.#tries = 0;
      this.onopen(true, "");
    };
    socket.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      if (message.type === "answer") this.#answer(message);
      for (const listener of this.#listeners.get(message.type) ?? []) listener(message);
    };
    socket.onclose = async ({ reason }) => {
      for (const id of [...this.#answers.keys()]) this.#answer({ id, good: false, text: "the connection broke" });
      this.onopen(false, reason ? `the station closed the connection: ${reason}` : "the station does not answer");
      if (!reason) this.onopen(false, await this.#why());
      setTimeout(() => this.#connect(), AGAIN_MS[Math.min(this.#tries++, AGAIN_MS.length - 1)]);
    };
  }

  /** A browser does not say why a WebSocket was refused; the same question by HTTP is answered with the reason. */
  async #why() {
    try {
      const { status } = await fetch(location.pathname, { cache: "no-store" });
      if (status === 403) return "the station was started anew, with another token: open the address that it printed";
      return status === 200 ? "the connection broke" : `the station answers with status ${status}`;
    } catch {
      return "the station does not answer: is it running?";
    }
  }

  #answer({ id, good, text }) {
    const waiting = this.#answers.get(id);
    this.#answers.delete(id);
    if (waiting) (good ? waiting.resolve : waiting.reject)(good ? text : new Error(text));
  }
}
