// Driving: keys, a stick on the screen, a gamepad. Only the browser that holds a robot commands it. Whatever ends an input
// (a key up, focus elsewhere, a page that is hidden or left) is sent as rest at once; the station stops the robot by
// itself 0.3 s after the last input.

import { $, make, number, text, toast } from "./dom.js";

const REPEAT_MS = 100; // a held input is said again
const APART_MS = 40; // between two inputs that differ
const BOOM_M_S = 0.05;
const DEAD_ZONE = 0.15; // of a gamepad's stick
const KEYS = {
  KeyW: [1, 0], ArrowUp: [1, 0], KeyS: [-1, 0], ArrowDown: [-1, 0],
  KeyA: [0, 1], ArrowLeft: [0, 1], KeyD: [0, -1], ArrowRight: [0, -1],
};
const BOOM_KEYS = { KeyE: 1, KeyQ: -1 };
const FLAGS = [
  ["conflict", "several operators command", ""], ["alive", "commands come", "no commands"], ["seeing", "sees", "sees nothing"], ["limited", "slowed by what it sees", ""],
  ["left", "left motor on", "left motor off"], ["right", "right motor on", "right motor off"],
  ["boom_enabled", "boom on", "boom off"],
];

export class Drive {
  #down = new Set();
  #stick = [0, 0];
  #pointer = null;
  #boom = 0;
  #boomKnown = false;
  #enable = false;
  #sent = "";
  #sentMs = 0;
  #pending = null;
  #held = null;
  #robot = null;
  #browsers = {};

  constructor(connection, fleet) {
    this.connection = connection;
    this.fleet = fleet;
    this.#build();
    addEventListener("keydown", (event) => this.#key(event, true));
    addEventListener("keyup", (event) => this.#key(event, false));
    for (const end of ["blur", "pagehide"]) addEventListener(end, () => this.rest());
    document.addEventListener("visibilitychange", () => document.hidden && this.rest());
    connection.on("refused", ({ text }) => toast(text));
    setInterval(() => this.#say(false), REPEAT_MS);
  }

  begin({ you, vehicles }) {
    this.you = you;
    this.vehicles = vehicles;
    this.rest();
    this.choose(this.fleet.chosen);
  }

  choose(robot) {
    if (!this.vehicles) return;
    this.rest();
    this.#enable = false;
    this.#boomKnown = false;
    this.#robot = robot in this.vehicles ? robot : null;
    text($("drive-title"), this.#robot ? `Drive ${this.#robot}` : "Drive");
    this.controls.hidden = !this.#robot;
    this.none.hidden = Boolean(this.#robot);
    if (this.#robot) {
      const [, most] = this.vehicles[this.#robot].boom;
      this.boom.max = most;
    }
  }

  /** No input any more, and said so at once. */
  rest() {
    this.#down.clear();
    this.#release();
    this.#say(true);
  }

  show(state) {
    if (!this.#robot) return;
    const held = (this.#held = state.driving[this.#robot]);
    const mine = this.#mine;
    if (!mine) {
      this.#enable = false;
      this.#boomKnown = false;
    }
    text($("holder"), !held.holder ? "nobody commands" : mine ? "you command" : `${held.holder.split(" at ")[0]} commands`);
    $("holder").className = mine ? "pill good" : held.holder ? "pill warn" : "quiet";
    const offered = held.offered === this.you;
    this.take.hidden = mine || offered || Boolean(held.holder);
    this.ask.hidden = mine || offered || !held.holder;
    const asked = this.you in held.asking;
    text(this.ask, asked ? "Asked: waiting for the holder" : "Ask for it");
    this.ask.disabled = asked;
    this.accept.hidden = !offered;
    this.leave.hidden = !mine;
    this.enable.disabled = !mine;
    this.enable.classList.toggle("on", this.#enable);
    text(this.enable, this.#enable ? "Motors on" : "Switch motors on");
    this.stick.classList.toggle("off", !mine || !this.#enable);
    this.boom.disabled = !mine;
    this.#showAsking(held, mine);
    this.#showReport(state);
    text(this.why, mine ? held.error || held.note : held.holder && !offered ? `You cannot command: ${held.holder} does. Ask for it, and the holder can hand it over.` : held.note);
  }

  /** Nothing comes from the station: it stops the robot by itself, and who commands is not known. */
  lose(words) {
    if (!this.#robot || !this.controls) return;
    if (this.#mine) this.rest();
    this.#held = null;
    this.#enable = false;
    this.#boomKnown = false;
    text($("holder"), "not known");
    $("holder").className = "pill bad";
    for (const each of [this.take, this.ask, this.accept, this.leave]) each.hidden = true;
    this.enable.disabled = this.boom.disabled = true;
    this.enable.classList.remove("on");
    text(this.enable, "Switch motors on");
    this.stick.classList.add("off");
    for (const out of [this.out.speed, this.out.turn, this.out.boom]) text(out, "–");
    this.flags.dataset.shown = "";
    this.flags.replaceChildren(make("span", { className: "chip bad" }, "no reports"));
    text(this.why, `You command nothing: ${words}.`);
  }

  get #mine() {
    return this.#held?.by === this.you;
  }

  #build() {
    const act = (what) => () => this.connection.send({ do: what, robot: this.#robot });
    this.take = make("button", { type: "button", id: "take", className: "primary", onclick: act("take") }, "Take control");
    this.ask = make("button", { type: "button", id: "ask", onclick: act("ask") }, "Ask for it");
    this.accept = make("button", { type: "button", id: "accept", className: "primary", onclick: act("accept") }, "Accept control");
    this.leave = make("button", { type: "button", id: "release", onclick: () => { this.rest(); act("release")(); } }, "Release");
    this.enable = make("button", { type: "button", id: "enable", className: "toggle", onclick: () => this.#toggle(!this.#enable) }, "Switch motors on");
    this.asking = make("div", { id: "asking" });
    this.stick = make("div", { id: "stick", className: "off", "aria-label": "stick" }, (this.knob = make("div", { className: "knob" })));
    this.speed = make("input", { type: "range", id: "speed-limit", min: 0.1, max: 1, step: 0.05, value: 0.6 });
    this.boom = make("input", { type: "range", id: "boom", min: 0, max: 0.5, step: 0.01, value: 0, oninput: () => { this.#boom = +this.boom.value; this.#say(false); } });
    this.out = { speed: make("output"), turn: make("output"), boom: make("output"), share: make("output") };
    this.why = make("p", { className: "hint", id: "why" });
    this.flags = make("div", { className: "chips" });
    this.controls = make("div", { className: "body", style: { padding: 0 } },
      make("div", { className: "row" }, this.take, this.ask, this.accept, this.enable, this.leave),
      this.stick, this.asking, this.why, // what comes and goes is beneath the stick, which must not move under a thumb
      make("div", { className: "gauges" },
        make("label", {}, "speed"), make("span"), this.out.speed,
        make("label", {}, "turn"), make("span"), this.out.turn,
        make("label", {}, "boom"), this.boom, this.out.boom,
        make("label", {}, "up to"), this.speed, this.out.share),
      this.flags,
      make("p", { className: "hint keys" }, make("kbd", {}, "W"), make("kbd", {}, "A"), make("kbd", {}, "S"), make("kbd", {}, "D"),
        " or arrows drive, ", make("kbd", {}, "Q"), make("kbd", {}, "E"), " boom, ", make("kbd", {}, "Space"), " motors off"));
    this.none = make("p", { className: "hint" }, "This robot has no control task “drive”.");
    $("drive").querySelector(".body").append(this.none, this.controls);
    this.stick.addEventListener("pointerdown", (event) => {
      if (!this.#mine) return;
      this.stick.setPointerCapture(event.pointerId);
      this.#pointer = event.pointerId;
      this.#move(event);
    });
    this.stick.addEventListener("pointermove", (event) => event.pointerId === this.#pointer && this.#move(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      this.stick.addEventListener(end, () => {
        this.#release();
        this.#say(false);
      });
    }
  }

  #showAsking(held, mine) {
    const asking = mine ? Object.entries(held.asking) : [];
    const shown = JSON.stringify([asking, held.offered]);
    if (this.asking.dataset.shown === shown) return;
    this.asking.dataset.shown = shown;
    this.asking.replaceChildren(
      ...asking.map(([id, name]) => {
        const offered = held.offered === +id;
        return make("div", { className: "row" }, make("span", {}, `${name} asks.`),
          make("button", { type: "button", className: "small offer", onclick: () => { this.rest(); this.connection.send({ do: "offer", robot: this.#robot, to: offered ? null : +id }); } },
            offered ? "Offered: take back" : "Hand over"));
      }),
    );
  }

  #showReport(state) {
    const stream = this.fleet.stream(this.#robot, "drive");
    const row = stream && state.streams[stream.topic];
    const values = row && !row.silent ? row.values : {};
    const { motion, wanted, boom } = values;
    text(this.out.speed, motion ? `${number(motion[0])} of ${number(wanted?.[0])} m/s` : "–");
    text(this.out.turn, motion ? `${number(motion[1])} of ${number(wanted?.[1])} rad/s` : "–");
    text(this.out.boom, boom === undefined ? "–" : `${number(boom)} of ${number(this.#boom)} m`);
    text(this.out.share, `${Math.round(100 * this.speed.value)} %`);
    if (!this.#boomKnown && boom !== undefined && boom !== null) {
      this.#boomKnown = true; // so that taking control moves nothing
      this.#boom = Math.min(+this.boom.max, Math.max(0, boom));
    }
    if (document.activeElement !== this.boom) this.boom.value = this.#boom;
    const chips = FLAGS.filter(([name]) => name in values).map(([name, on, off]) => {
      const is = values[name];
      if (!off) return is ? [on, name === "conflict" ? "bad" : "warn"] : null;
      return [is ? on : off, is ? "good" : name === "seeing" ? "bad" : ""];
    });
    for (const side of ["left", "right", "boom"]) {
      const code = values[`${side}_error`];
      if (code) chips.push([`${side} fault 0x${code.toString(16)}`, "bad"]);
    }
    if (values.free !== undefined && values.free !== null) chips.push([`${number(values.free, 1)} m free`, values.free < 0.3 ? "warn" : ""]);
    if (row?.silent) chips.push(["no reports", "bad"]);
    const shown = JSON.stringify(chips);
    if (this.flags.dataset.shown === shown) return;
    this.flags.dataset.shown = shown;
    this.flags.replaceChildren(...chips.filter(Boolean).map(([words, how]) => make("span", { className: `chip ${how}` }, words)));
  }

  #toggle(on) {
    if (!this.#mine) return;
    this.#enable = on;
    if (!on) this.rest();
    this.#say(true);
    this.enable.blur();
  }

  #key(event, down) {
    const typing = event.target instanceof Element && event.target.closest("input:not([type=range]):not([type=checkbox]), select, textarea");
    if (!(event.code in KEYS) && !(event.code in BOOM_KEYS) && event.code !== "Space") return;
    if (down && (typing || event.ctrlKey || event.metaKey || event.altKey || !this.#robot || !this.#mine)) return;
    if (down || !typing) event.preventDefault();
    if (event.code === "Space") {
      if (down && !event.repeat) this.#toggle(false);
      return;
    }
    if (down) this.#down.add(event.code);
    else this.#down.delete(event.code);
    if (!event.repeat) this.#say(false);
  }

  #move(event) {
    const box = this.stick.getBoundingClientRect();
    const reach = box.width / 2 - 31;
    let [x, y] = [(event.clientX - box.x - box.width / 2) / reach, (event.clientY - box.y - box.height / 2) / reach];
    const length = Math.max(1, Math.hypot(x, y));
    [x, y] = [x / length, y / length];
    this.#stick = [-y, -x];
    this.#knob(-y, -x);
    this.#say(false);
  }

  /** Where the input is, whichever it comes from. */
  #knob(ahead, left) {
    const reach = this.stick.clientWidth / 2 - 31;
    const length = Math.max(1, Math.hypot(ahead, left));
    this.knob.style.transform = `translate(${(-left / length) * reach}px, ${(-ahead / length) * reach}px)`;
  }

  #release() {
    this.#pointer = null;
    this.#stick = [0, 0];
    this.knob.style.transform = "";
  }

  /** Ahead and to the left, each −1 to 1. */
  #input() {
    let [ahead, left] = this.#stick;
    for (const code of this.#down) {
      const [v, omega] = KEYS[code] ?? [0, 0];
      ahead += v;
      left += omega;
    }
    if (document.hasFocus()) {
      for (const pad of navigator.getGamepads?.() ?? []) {
        if (!pad) continue;
        const live = (value) => (Math.abs(value ?? 0) > DEAD_ZONE ? value : 0);
        ahead -= live(pad.axes[1]);
        left -= live(pad.axes[0]);
      }
    }
    const clip = (value) => Math.min(1, Math.max(-1, value));
    return [clip(ahead), clip(left)];
  }

  /** Send the input: when it differs, and again and again. `now`: without waiting for the pause between two. */
  #say(now) {
    if (!this.#robot || !this.#mine) return;
    for (const code of this.#down) {
      if (BOOM_KEYS[code] && now !== true) {
        const at = this.#boom + (BOOM_KEYS[code] * BOOM_M_S * REPEAT_MS) / 1000;
        this.#boom = Math.min(+this.boom.max, Math.max(0, at));
      }
    }
    const limits = this.vehicles[this.#robot];
    const [ahead, left] = this.#input();
    if (this.#pointer === null) this.#knob(ahead, left);
    const share = +this.speed.value;
    const along = (value, [least, most]) => share * (value > 0 ? value * most : -value * least);
    const request = {
      do: "drive", robot: this.#robot, v: along(ahead, limits.v) || 0, omega: along(left, limits.omega) || 0,
      boom: this.#boom, enable: this.#enable,
    };
    const said = JSON.stringify(request);
    const since = performance.now() - this.#sentMs;
    if (said === this.#sent && since < REPEAT_MS * 0.9) return;
    if (!now && since < APART_MS) {
      clearTimeout(this.#pending);
      this.#pending = setTimeout(() => this.#say(true), APART_MS - since);
      return;
    }
    clearTimeout(this.#pending);
    this.#sent = said;
    this.#sentMs = performance.now();
    this.connection.send(request);
  }
}
