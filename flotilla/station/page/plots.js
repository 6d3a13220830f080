// Plots against time of signals: of a robot's reports as they come, or any wire of a running task, by the task's scope.

import uPlot from "./vendor/uPlot.esm.js";
import { $, colour, css, make, number, text, toast } from "./dom.js";

const KEPT = 20000; // rows of a plot
const WIDEST = 32; // elements of a signal that are offered
const MOST = 16; // signals of a plot
const HEIGHT = 210;

export class Plots {
  #plots = new Map();
  #listed = [];

  constructor(connection, fleet) {
    this.connection = connection;
    this.fleet = fleet;
    this.list = $("plot-list");
    this.empty = make("p", { className: "empty" }, "No plot yet. Add one: signals of a robot’s reports, or any wire of a running task.");
    this.list.append(this.empty);
    $("add-plot").onclick = () => this.#choose();
    connection.on("rows", ({ id, rows, lost }) => this.#plots.get(id)?.take(rows, lost ?? 0));
    connection.on("answer", ({ id, good, text: words }) => this.#plots.get(id)?.ended(good, words));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#plots.forEach((plot) => plot.build()));
  }

  /** After a new connection, what was watched is watched again. */
  begin({ streams, replay }) {
    this.streams = streams;
    this.replay = replay;
    for (const plot of [...this.#plots.values()]) if (!plot.once) this.connection.send({ ...plot.request, id: plot.id });
  }

  /** The recording jumped. */
  jump() {
    this.#plots.forEach((plot) => plot.clear());
  }

  add(title, request, signals, kind) {
    const id = this.connection.next;
    const plot = new (kind === "camera" ? Camera : Plot)(id, title, request, signals, () => {
      this.connection.send({ do: "unwatch", id });
      this.#plots.delete(id);
      this.empty.hidden = this.#plots.size > 0;
    });
    this.#plots.set(id, plot);
    this.list.append(plot.element);
    this.empty.hidden = true;
    plot.build();
    this.connection.send({ ...request, id });
  }

  async #choose() {
    const place = $("chooser");
    place.hidden = !place.hidden;
    if (place.hidden) return;
    const sources = [
      ...this.streams.map((stream) => ({ label: `${stream.robot} · ${stream.task} ${stream.name}`, stream })),
      ...(this.replay ? [] : this.fleet.robots.flatMap((robot) => robot.tasks.map((task) => ({ label: `${robot.name} · ${task}: all wires`, robot: robot.name, task })))),
    ];
    sources.sort((a, b) => (b.label.startsWith(this.fleet.chosen) ? 1 : 0) - (a.label.startsWith(this.fleet.chosen) ? 1 : 0));
    const source = make("select", { id: "source" }, ...sources.map((each, index) => make("option", { value: index }, each.label)));
    const search = make("input", { type: "search", id: "search", placeholder: "filter signals" });
    const list = make("div", { className: "list" });
    const field = (label, properties) => {
      const input = make("input", properties);
      return [input, make("label", { className: "field" }, label, input)];
    };
    const [trigger, triggerField] = field("trigger", { type: "text", className: "wide", placeholder: "gyro.rate>0.1", id: "trigger" });
    const [before, beforeField] = field("rows before", { type: "number", min: 0, max: 1000, value: 100 });
    const [every, everyField] = field("every Nth step", { type: "number", min: 1, max: 10000, placeholder: "auto" });
    const wires = make("div", { className: "row" }, triggerField, beforeField, everyField);
    const add = make("button", { type: "button", className: "primary small", id: "plot" }, "Plot");
    const camera = make("button", { type: "button", className: "small", id: "camera", hidden: true }, "Camera picture");
    const fill = async () => {
      const chosen = sources[source.value];
      if (!chosen) return;
      wires.hidden = Boolean(chosen.stream);
      camera.hidden = true;
      list.replaceChildren(make("span", { className: "hint" }, "asking …"));
      try {
        const signals = chosen.stream
          ? chosen.stream.signals.map(({ name, type, width }) => ({ name, type, width, unit: "" }))
          : (await this.connection.ask({ do: "signals", robot: chosen.robot, task: chosen.task })).split("\n").filter(Boolean).map((line) => {
              const [name, type, width, ...unit] = line.split(" ");
              return { name, type, width: +width, unit: unit.join(" ") };
            });
        if (sources[source.value] !== chosen) return;
        this.#listed = signals.flatMap((each) => each.width === 1 ? [each] : each.width > WIDEST ? [] : Array.from({ length: each.width }, (_, i) => ({ ...each, name: `${each.name}[${i}]` })));
        const spots = signals.find((each) => each.name.endsWith(".brightness") && each.width === 3);
        const block = spots?.name.replace(/\.brightness$/, "");
        camera.hidden = !block;
        camera.onclick = () => {
          const asked = ["x", "y", "brightness"].flatMap((port) => [0, 1, 2].map((i) => `${block}.${port}[${i}]`));
          this.add(`${chosen.label.replace(": all wires", "")} · ${block}`, { do: "watch", robot: chosen.robot, task: chosen.task, signals: asked }, asked, "camera");
          place.hidden = true;
        };
        list.replaceChildren(...this.#listed.map(({ name, type, unit }) =>
          make("label", { "data-name": name }, make("input", { type: "checkbox", value: name }), make("span", { title: `${name} ${type}` }, name), make("span", { className: "quiet" }, unit))));
        search.oninput();
      } catch (error) {
        list.replaceChildren(make("span", { className: "hint" }, error.message));
      }
    };
    search.oninput = () => [...list.children].forEach((each) => each.dataset.name && (each.hidden = !each.dataset.name.includes(search.value)));
    source.onchange = fill;
    add.onclick = () => {
      const signals = [...list.querySelectorAll("input:checked")].map((input) => input.value);
      const chosen = sources[source.value];
      if (!signals.length || signals.length > MOST) return toast(signals.length ? `${MOST} signals are the most` : "choose signals first");
      const wanted = chosen.stream
        ? { do: "follow", topic: chosen.stream.topic, signals }
        : { do: "watch", robot: chosen.robot, task: chosen.task, signals, ...(every.value ? { every: +every.value } : {}),
            ...(trigger.value.trim() ? { trigger: trigger.value.replace(/\s/g, ""), before: +before.value } : {}) };
      this.add(chosen.label.replace(": all wires", ""), wanted, signals);
      place.hidden = true;
    };
    place.replaceChildren(make("div", { className: "row" }, source, search, make("span", { className: "space" }), camera, add), wires, list);
    await fill();
  }
}

/** What all kinds of plots have: a head, rows, an end. */
class Shown {
  constructor(id, title, request, signals, close) {
    Object.assign(this, { id, title, request, signals, close, lost: 0 });
    this.once = Boolean(request.trigger);
    this.status = make("span", { className: "chip" }, "waiting for rows");
    this.tools = make("span", { className: "row" });
    this.head = make("div", { className: "head" }, make("b", {}, title), this.status, make("span", { className: "space" }), this.tools);
    this.element = make("div", { className: "plot" }, this.head);
    this.tools.append(make("button", { type: "button", className: "small", "aria-label": "close", onclick: () => { this.element.remove(); this.#watching?.disconnect(); close(); } }, "✕"));
  }

  #watching = null;

  watchSize(resize) {
    this.#watching = new ResizeObserver(resize);
    this.#watching.observe(this.element);
  }

  say(words, how = "") {
    text(this.status, words);
    this.status.className = `chip ${how}`;
  }

  /** The answer: that it began (streams) or ended (watches), or why it did not. */
  ended(good, words) {
    if (!good) this.say(words, "bad");
    else if (words) this.say(this.once ? "complete" : words, "info");
  }
}

class Plot extends Shown {
  #plot = null;
  #due = false;
  #begin = null;

  constructor(...all) {
    super(...all);
    this.data = [[], ...this.signals.map(() => [])];
    this.window = make("select", { "aria-label": "seconds shown" }, ...[5, 15, 30, 60, 300].map((s) => make("option", { value: s, selected: s === 30 }, `${s} s`)));
    this.window.onchange = () => this.draw();
    this.pause = make("button", { type: "button", className: "small" }, "Pause");
    this.pause.onclick = () => {
      this.paused = !this.paused;
      text(this.pause, this.paused ? "Go on" : "Pause");
      this.draw();
    };
    const csv = make("button", { type: "button", className: "small csv", onclick: () => this.#csv() }, "CSV");
    this.tools.prepend(this.window, this.pause, csv);
    this.area = make("div");
    this.values = this.signals.map(() => make("b", {}, "–"));
    this.legend = make("div", { className: "legend" }, ...this.signals.map((signal, index) => make("span", {}, make("i", { style: { background: colour(index) } }), make("span", { className: "mono" }, signal), this.values[index])));
    this.element.append(this.area, this.legend);
    this.watchSize(() => this.#plot?.setSize({ width: this.#width, height: HEIGHT }));
  }

  get #width() {
    return Math.max(200, this.element.clientWidth - 24);
  }

  build() {
    this.#plot?.destroy();
    const axis = { stroke: css("--quiet"), grid: { stroke: css("--edge"), width: 1 }, ticks: { stroke: css("--edge"), width: 1 }, font: "11px system-ui, sans-serif" };
    this.#plot = new uPlot(
      {
        width: this.#width, height: HEIGHT, legend: { show: false }, cursor: { drag: { x: true, y: false } },
        scales: { x: { time: false } },
        axes: [{ ...axis, size: 28, values: (_, ticks) => ticks.map((tick) => `${+tick.toFixed(3)} s`) }, { ...axis, size: 52 }],
        series: [{}, ...this.signals.map((signal, index) => ({ label: signal, stroke: colour(index), width: 1.5, points: { show: false } }))],
        hooks: { setCursor: [(plot) => this.#read(plot.cursor.idx)] },
      },
      this.data, this.area,
    );
    this.draw();
  }

  take(rows, lost) {
    this.lost += lost;
    for (const [time, ...values] of rows) {
      this.#begin ??= time;
      const at = time - this.#begin;
      if (this.data[0].length && at <= this.data[0].at(-1)) continue;
      this.data[0].push(at);
      values.forEach((value, index) => this.data[index + 1].push(value));
    }
    if (this.data[0].length > KEPT) this.data.forEach((column) => column.splice(0, column.length - KEPT));
    this.say(`${this.data[0].length} rows${this.lost ? `, ${this.lost} lost` : ""}`, this.lost ? "warn" : "good");
    this.draw();
  }

  clear() {
    this.#begin = null;
    this.data.forEach((column) => column.splice(0));
    this.draw();
  }

  draw() {
    if (this.#due || !this.#plot) return;
    this.#due = true;
    requestAnimationFrame(() => {
      this.#due = false;
      if (this.paused || !this.#plot) return;
      const end = this.data[0].at(-1) ?? 0;
      const begin = this.once ? this.data[0][0] ?? 0 : Math.max(this.data[0][0] ?? 0, end - this.window.value);
      this.#plot.setData(this.data, false);
      this.#plot.setScale("x", { min: begin, max: Math.max(end, begin + 0.1) });
      this.#read(this.#plot.cursor.idx);
    });
  }

  #read(index) {
    const at = index ?? this.data[0].length - 1;
    this.values.forEach((value, signal) => {
      const shown = this.data[signal + 1][at];
      text(value, typeof shown === "number" ? `${+shown.toPrecision(5)}` : shown === undefined || shown === null ? "–" : `${shown}`);
    });
  }

  #csv() {
    const cell = (value) => (value === null || value === undefined ? "" : typeof value === "boolean" ? +value : value);
    const lines = [["time_s", ...this.signals].join(","), ...this.data[0].map((time, row) => [number(time, 6), ...this.data.slice(1).map((column) => cell(column[row]))].join(","))];
    const url = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" }));
    make("a", { href: url, download: `${this.title.replace(/\W+/g, "-")}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  }
}

/** What the image processor sees: bright spots where they are in the picture. The picture itself stays on the robot. */
class Camera extends Shown {
  constructor(...all) {
    super(...all);
    this.canvas = make("canvas", { className: "camera", width: 640, height: 480 });
    this.element.append(this.canvas, make("p", { className: "hint" }, "Bright spots, as the robot’s image processor finds them. The picture itself stays on the robot."));
  }

  build() {
    const pen = this.canvas.getContext("2d");
    pen.fillStyle = "#05070a";
    pen.fillRect(0, 0, 640, 480);
    pen.strokeStyle = "#1d2733";
    pen.strokeRect(320, 0, 0, 480);
    pen.strokeRect(0, 240, 640, 0);
    const [, ...values] = this.last ?? [];
    const most = Math.max(1, ...values.slice(6).map((each) => each ?? 0));
    for (let spot = 0; spot < 3; spot++) {
      const [x, y, brightness] = [values[spot], values[3 + spot], values[6 + spot]];
      if (!brightness) continue;
      const [px, py, radius] = [((x + 1) / 2) * 640, ((y + 1) / 2) * 480, 8 + 14 * Math.sqrt(brightness / most)];
      const glow = pen.createRadialGradient(px, py, 0, px, py, radius);
      glow.addColorStop(0, "#ffffff");
      glow.addColorStop(0.35, "#ffe9a8");
      glow.addColorStop(1, "transparent");
      pen.fillStyle = glow;
      pen.fillRect(px - radius, py - radius, 2 * radius, 2 * radius);
      pen.fillStyle = "#9fb3c8";
      pen.font = "13px system-ui";
      pen.fillText(`${number(x)}, ${number(y)}`, px + radius, py - 4);
    }
  }

  take(rows, lost) {
    this.lost += lost;
    this.last = rows.at(-1);
    const spots = this.last.slice(7).filter(Boolean).length;
    this.say(`${spots} spots`, spots ? "good" : "");
    requestAnimationFrame(() => this.build());
  }

  clear() {}
}
