// The fleet as cards: how well each robot is heard, its battery, its tasks. A click chooses the robot that all else shows.

import { $, colour, make, number, text } from "./dom.js";

const LOW_LINK = 0.9;
const LOW_CHARGE = 0.2;

export class Fleet {
  #cards = new Map();
  #streams = [];
  #chosen = null;

  constructor(choose) {
    this.choose = choose;
  }

  get chosen() {
    return this.#chosen;
  }

  begin({ robots, streams }) {
    this.#streams = streams;
    const names = new Set([...robots.map((robot) => robot.name), ...streams.map((stream) => stream.robot)]);
    this.robots = [...names].map((name) => robots.find((robot) => robot.name === name) ?? { name, tasks: [] });
    const body = $("fleet").querySelector(".body");
    body.replaceChildren();
    this.#cards.clear();
    this.robots.forEach((robot, index) => {
      const card = {
        index,
        link: make("span", { className: "pill" }),
        figures: make("div", { className: "figures" }),
        streams: make("div", { className: "streams" }),
      };
      card.element = make(
        "button",
        { type: "button", className: "robot", onclick: () => this.pick(robot.name) },
        make(
          "div",
          { className: "name" },
          make("i", { className: "swatch", style: { background: colour(index) } }),
          robot.name,
          make("span", { className: "quiet mono" }, robot.address ?? ""),
          make("span", { className: "space" }),
          card.link,
        ),
        card.figures,
        card.streams,
      );
      this.#cards.set(robot.name, card);
      body.append(card.element);
    });
    const still = this.#chosen && this.#cards.has(this.#chosen);
    const first = streams[0]?.robot ?? this.robots[0]?.name ?? null;
    this.pick(still ? this.#chosen : first);
  }

  pick(name) {
    this.#chosen = name;
    for (const [robot, card] of this.#cards) card.element.classList.toggle("chosen", robot === name);
    this.choose(name);
  }

  index(name) {
    return this.#cards.get(name)?.index ?? 0;
  }

  stream(robot, task) {
    return this.#streams.find((stream) => stream.robot === robot && stream.task === task);
  }

  /** Path that may be used for stopping in m, by robot, of those that report it. */
  free(state) {
    const found = {};
    for (const stream of this.#streams) {
      const { values, silent } = state.streams[stream.topic];
      if ("free" in values && !silent) found[stream.robot] = values.free;
    }
    return found;
  }

  show(state) {
    for (const robot of this.robots) {
      const card = this.#cards.get(robot.name);
      const own = this.#streams.filter((stream) => stream.robot === robot.name);
      this.#showLink(card, own.map((stream) => state.streams[stream.topic]));
      this.#showFigures(card, robot, own, state);
      this.#showStreams(card, own, state);
    }
  }

  /** Nothing comes from the station. */
  age(s) {
    for (const { link } of this.#cards.values()) {
      text(link, `${number(s, 1)} s old`);
      link.className = "pill bad";
    }
  }

  #showLink(card, rows) {
    const silent = rows.every((row) => row.silent);
    const links = rows.filter((row) => row.link !== null && !row.silent).map((row) => row.link);
    const link = links.length ? Math.min(...links) : null;
    const words = !rows.length ? "no reports" : silent ? "silent" : link === null ? "heard" : `link ${Math.round(100 * link)} %`;
    text(card.link, words);
    const how = !rows.length ? "" : silent ? "bad" : rows.some((row) => row.silent) ? "warn" : link !== null && link < LOW_LINK ? "warn" : "good";
    card.link.className = `pill ${how}`;
  }

  #showFigures(card, robot, own, state) {
    const parts = [];
    for (const stream of own) {
      const row = state.streams[stream.topic];
      const was = row.silent ? " (old)" : "";
      if (row.charge !== null) parts.push(["battery", `${Math.round(100 * row.charge)} %${was}`, was || row.charge < LOW_CHARGE]);
      for (const flag of row.bad) parts.push([stream.task, `not ${flag}`, true]);
    }
    const pose = state.poses[robot.name];
    const old = state.old.includes(robot.name);
    if (pose) parts.push([old ? "was at" : "at", `${number(pose[0])}, ${number(pose[1])} m`, old]);
    const tasks = robot.tasks.map((task) => state.tasks[`${robot.name} ${task}`]).filter(Boolean);
    const running = tasks.filter((task) => task.good).length;
    if (tasks.length) parts.push(["tasks", `${running} of ${tasks.length} well`, running < tasks.length]);
    const overruns = tasks.reduce((sum, task) => sum + (task.overruns ?? 0), 0);
    const lately = tasks.reduce((sum, task) => sum + (task.lately ?? 0), 0);
    if (tasks.some((task) => task.overruns !== null)) {
      parts.push(["overruns", `${overruns}${lately ? ` (+${lately})` : ""}`, lately > 0]);
    }
    // No alarm: each first message after a start is refused, too.
    for (const name of new Set([...robot.tasks, ...own.map((stream) => stream.task)])) {
      const reported = own.find((stream) => stream.task === name && state.streams[stream.topic].refusals);
      const refusals = state.tasks[`${robot.name} ${name}`]?.refusals || (reported && state.streams[reported.topic].refusals);
      if (refusals) parts.push([name, `refused ${refusals}`, false]);
      const waiting = state.tasks[`${robot.name} ${name}`]?.waiting;
      if (waiting) parts.push([name, `stopped since its start, switch off and on: ${waiting}`, true]);
      const lost = state.tasks[`${robot.name} ${name}`]?.lost;
      if (lost) parts.push([name, `serial overruns, bytes were lost: ${lost}`, true]);
    }
    for (const stream of own) {
      const attempts = state.streams[stream.topic].attempts;
      if (attempts) parts.push([`${stream.task} ${stream.name}`, `left out ${attempts}`, true]);
    }
    for (const note of state.said[robot.name] ?? []) {
      const [label, ...words] = note.split(" ");
      parts.push([label, words.join(" "), true]);
    }
    const shown = parts.map((part) => part.join(" ")).join("|");
    if (card.figures.dataset.shown === shown) return;
    card.figures.dataset.shown = shown;
    card.figures.replaceChildren(
      ...parts.map(([label, value, bad]) => make("span", { className: bad ? "is-bad" : "" }, `${label} `, make("b", {}, value))),
    );
  }

  #showStreams(card, own, state) {
    const cells = own.flatMap((stream) => {
      const row = state.streams[stream.topic];
      const age = row.age === null ? "never" : row.silent ? `${number(row.age, 1)} s ago` : `${row.hz.toFixed(1)} of ${+stream.hz.toFixed(1)} Hz`;
      const lost = row.lost ? `${row.lost} lost` : row.refused ? `${row.refused} refused` : "none lost";
      return [[`${stream.task} ${stream.name}`, false], [age, row.silent], [lost, Boolean(row.lost || row.refused)]];
    });
    while (card.streams.children.length < cells.length) card.streams.append(make("span"));
    cells.forEach(([value, bad], index) => {
      const cell = card.streams.children[index];
      text(cell, value);
      cell.classList.toggle("is-bad", bad);
    });
  }
}
