// Tasks of the chosen robot: whether they run, start and stop, and their parameters.

import { $, make, text, toast } from "./dom.js";

const SURE_MS = 3000;

export class Tasks {
  #tasks = new Map();
  #robot = null;

  constructor(connection, fleet) {
    this.connection = connection;
    this.fleet = fleet;
    this.results = make("div", { id: "stopped", className: "chips" });
    this.list = make("div");
    $("tasks").querySelector(".body").append(this.results, this.list);
    this.#stopped = new Map();
    connection.on("stopped", ({ robot, good, text: words }) => {
      this.#stopped.set(robot, [good, words]);
      this.results.replaceChildren(
        ...[...this.#stopped].map(([name, [well, said]]) =>
          make("span", { className: `chip ${well === null ? "info" : well ? "good" : "bad"}`, title: said }, `${name}: ${said.slice(0, 80)}`)),
      );
    });
  }

  #stopped;

  begin({ replay }) {
    this.replay = replay;
    this.choose(this.fleet.chosen);
  }

  choose(robot) {
    this.#robot = robot;
    text($("tasks-title"), robot ? `Tasks of ${robot}` : "Tasks");
    this.#tasks.clear();
    const tasks = this.fleet.robots?.find((each) => each.name === robot)?.tasks ?? [];
    this.list.replaceChildren(...(this.replay || !tasks.length ? [make("p", { className: "hint" }, this.replay ? "A recording has no running tasks." : "This robot has no control tasks.")] : tasks.map((task) => this.#task(robot, task))));
  }

  show(state) {
    for (const [task, shown] of this.#tasks) {
      const own = state.tasks[`${this.#robot} ${task}`];
      text(shown.words, own?.words ?? "not asked");
      shown.words.className = `pill ${own ? (own.good ? "good" : "bad") : ""}`;
      const facts = own && own.period_ms !== null ? [`${+own.period_ms.toFixed(3)} ms`, `${own.overruns} overruns${own.lately ? ` (+${own.lately})` : ""}`] : [];
      const sensors = Object.entries(own?.sensors ?? {});
      for (const [name, flag] of sensors) if (!flag) facts.push(`not ${name}`);
      if (sensors.length && sensors.every(([, flag]) => flag)) facts.push(`${sensors.length} sensors good`);
      text(shown.facts, facts.join(" · "));
    }
  }

  /** Nothing comes from the station. */
  lose() {
    for (const { words, facts } of this.#tasks.values()) {
      text(words, "not known");
      words.className = "pill bad";
      text(facts, "");
    }
  }

  #task(robot, task) {
    const words = make("span", { className: "pill" });
    const facts = make("div", { className: "quiet" });
    const parameters = make("div");
    const start = make("button", { type: "button", className: "small" }, "Start");
    start.onclick = () => {
      if (start.dataset.sure) {
        delete start.dataset.sure;
        text(start, "Start");
        this.#do(robot, task, "start", start);
      } else {
        start.dataset.sure = "1";
        text(start, "Sure? Start");
        setTimeout(() => {
          delete start.dataset.sure;
          text(start, "Start");
        }, SURE_MS);
      }
    };
    const stop = make("button", { type: "button", className: "small" }, "Stop");
    stop.onclick = () => this.#do(robot, task, "stop", stop);
    const open = make("button", { type: "button", className: "small parameters-of" }, "Parameters");
    open.onclick = () => (parameters.childElementCount ? parameters.replaceChildren() : this.#parameters(robot, task, parameters, open));
    this.#tasks.set(task, { words, facts });
    return make("div", { className: "task", "data-task": task }, make("div", { className: "head" }, task, words), facts, make("div", { className: "actions" }, start, stop, open), parameters);
  }

  async #do(robot, task, action, button) {
    button.disabled = true;
    try {
      await this.connection.ask({ do: "service", robot, task, action });
      toast(`${robot} ${task}: ${action} done`, true);
    } catch (error) {
      toast(error.message);
    }
    button.disabled = false;
  }

  async #parameters(robot, task, place, button) {
    button.disabled = true;
    try {
      const answer = await this.connection.ask({ do: "parameters", robot, task });
      const rows = answer.split("\n").filter(Boolean).map((line) => this.#row(robot, task, line));
      const search = make("input", { type: "search", placeholder: "filter", style: { width: "100%", marginTop: "8px" } });
      search.oninput = () => rows.forEach((row) => (row.hidden = !row.dataset.name.includes(search.value)));
      place.replaceChildren(search, make("div", { className: "parameters" }, make("table", {}, make("tbody", {}, ...rows))));
    } catch (error) {
      toast(error.message);
    }
    button.disabled = false;
  }

  /** "block.name: value unit, tunable, 0 to 1, a|b" as flotilla-param says it. */
  #row(robot, task, line) {
    const name = line.slice(0, line.indexOf(":"));
    const rest = line.slice(name.length + 2);
    const [, said, tunable, limits, choices] = rest.match(/^(.*?)(, tunable)?(, \S+ to \S+)?(?:, ([\w-]+(?:\|[\w-]+)+))?$/) ?? [null, rest];
    const [, value, unit] = said.match(/^(\[.*?\]|"[^"]*"|\S*)(?: (.*))?$/) ?? [null, said, ""];
    const about = [unit, limits?.slice(2)].filter(Boolean).join(", ");
    let field = make("span", { className: "fixed" }, value);
    if (tunable) {
      field = choices
        ? make("select", {}, ...choices.split("|").map((each) => make("option", { value: each, selected: each === value }, each)))
        : make("input", { type: "text", value, spellcheck: false, "aria-label": name });
      let before = value;
      field.onchange = async () => {
        field.disabled = true;
        try {
          const wanted = { do: "set", robot, task, parameter: name, value: field.value };
          const answer = await this.connection.ask(wanted).catch((error) => {
            const asked = error.message.match(/is a limit of safety: (\S+) → .*; confirm it/);
            if (!asked || !confirm(error.message)) throw error;
            return this.connection.ask({ ...wanted, confirm: asked[1] });
          });
          before = field.value;
          toast(`${name}: ${answer}`, true);
        } catch (error) {
          field.value = before;
          toast(error.message);
        }
        field.disabled = false;
      };
    }
    return make("tr", { "data-name": name }, make("td", {}, name), make("td", {}, field), make("td", { className: "quiet" }, about));
  }
}
