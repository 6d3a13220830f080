// Puts the page together: each part gets the greeting after a connection (`begin`) and the state ten times a second.

import { Connection } from "./connection.js";
import { $, make, number, text, toast } from "./dom.js";
import { Drive } from "./drive.js";
import { Fleet } from "./fleet.js";
import { Map2d } from "./map.js";
import { Plots } from "./plots.js";
import { Tasks } from "./tasks.js";

if (location.search) history.replaceState(null, "", location.pathname); // the token is in a cookie now

let fleet, map, drive, tasks;
const CURRENT_MS = 500; // what is older is not shown as current
let heardMs = performance.now();
let lost = "connecting"; // why there is no connection; empty: there is one
const connection = new Connection((open, reason) => {
  heardMs = performance.now();
  lost = open ? "" : `not connected: ${reason}`;
  if (!open) drive?.rest();
  look();
});

/** Whether what the page shows is current, or since when it is not. */
function look() {
  const age = performance.now() - heardMs;
  const old = Boolean(lost) || age > CURRENT_MS;
  const words = lost || (old ? `the station has said nothing for ${number(age / 1000, 1)} s` : "connected");
  text($("link"), words);
  $("link").className = `pill ${old ? "bad" : "good"}`;
  document.body.classList.toggle("old", old);
  map?.age(old);
  if (!old) return;
  fleet?.age(age / 1000);
  drive?.lose(words);
  tasks?.lose();
}
setInterval(look, 100);
fleet = new Fleet((robot) => {
  drive?.choose(robot);
  tasks?.choose(robot);
});
map = new Map2d(fleet);
drive = new Drive(connection, fleet);
tasks = new Tasks(connection, fleet);
const plots = new Plots(connection, fleet);
const notes = $("notes").querySelector("ol");

function note({ at, text: words }) {
  notes.prepend(make("li", {}, make("time", {}, new Date(at * 1000).toLocaleTimeString("en-GB")), make("span", {}, words)));
  while (notes.children.length > 100) notes.lastChild.remove();
}

connection.on("hello", (hello) => {
  text($("fleet-name"), hello.fleet);
  document.title = `${hello.replay ? hello.replay.file : hello.fleet} · Flotilla`;
  notes.replaceChildren();
  hello.notes.forEach(note);
  fleet.begin(hello);
  map.begin(hello.paths);
  drive.begin(hello);
  tasks.begin(hello);
  plots.begin(hello);
  $("drive").hidden = Boolean(hello.replay);
  $("record").hidden = $("stop-all").hidden = Boolean(hello.replay);
  $("replay").hidden = !hello.replay;
  document.body.classList.toggle("replays", Boolean(hello.replay));
  if (hello.replay) {
    $("position").max = hello.replay.s;
    text($("replay-file"), hello.replay.file);
  }
});
connection.on("begin", ({ paths }) => {
  map.begin(paths);
  plots.jump();
});
connection.on("note", note);
connection.on("scans", ({ scans }) => map.scan(scans));
connection.on("state", (state) => {
  heardMs = performance.now();
  look();
  fleet.show(state);
  map.show(state, fleet.free(state));
  drive.show(state);
  tasks.show(state);
  text($("browsers"), state.browsers > 1 ? `${state.browsers} browsers` : "");
  const recording = state.recording;
  $("record").classList.toggle("on", Boolean(recording));
  $("record").lastElementChild.textContent = recording ? `Recording ${Math.floor(recording.s)} s · ${recording.messages}` : "Record";
  $("record").title = recording?.file ?? "Record what all robots report";
  if (state.replay) showReplay(state.replay);
});

$("record").onclick = () => {
  const on = !$("record").classList.contains("on");
  connection.ask({ do: "record", on }).catch((error) => toast(error.message));
};
// Stop all, by a request of its own, which waits behind nothing. Its answer says that the station has it; then each robot
// acknowledges. What has not come back after a second is an alarm.
const ACKNOWLEDGED_MS = 1000;
let stopping = null; // { begun, robots: null or a map from a robot to whether it has acknowledged }
$("stop-all").onclick = async () => {
  const own = (stopping = { begun: performance.now(), robots: null, said: new Set(), late: false });
  setTimeout(() => {
    own.late = true;
    showStop();
  }, ACKNOWLEDGED_MS);
  const asked = fetch("/stop-all", { method: "POST", cache: "no-store" });
  drive?.rest();
  showStop();
  try {
    const answer = await asked;
    if (!answer.ok) throw new Error(`the station answers with status ${answer.status}`);
    own.robots = (await answer.json()).robots;
  } catch (error) {
    own.failed = error.message;
  }
  showStop();
};
connection.on("stopped", ({ robot, acknowledged }) => {
  if (!stopping || !acknowledged) return;
  stopping.said.add(robot);
  showStop();
});

function showStop() {
  const { begun, robots, said, late, failed } = stopping;
  const missing = robots?.filter((robot) => !said.has(robot)) ?? [];
  const took = `${number((performance.now() - begun) / 1000, 1)} s`;
  const [words, how] = failed || (late && !robots)
    ? [`STOP ALL NOT ACKNOWLEDGED: ${failed ?? "the station does not answer"}`, "alarm"]
    : missing.length
      ? late ? [`STOP ALL NOT ACKNOWLEDGED by ${missing.join(", ")}`, "alarm"] : [`stopping: ${said.size} of ${robots.length}`, "warn"]
      : robots ? [`stop all: ${robots.length} acknowledged after ${took}`, late ? "warn" : "good"] : ["stopping", "warn"];
  $("stop-said").hidden = false;
  $("stop-said").className = how === "alarm" ? "pill alarm" : `pill ${how}`;
  text($("stop-said"), words);
}

let seeking = false;
function showReplay({ s, playing, speed }) {
  text($("play"), playing ? "Pause" : "Play");
  $("play").dataset.playing = playing;
  if (!seeking) $("position").value = s;
  text($("position-s"), `${number(s, 1)} of ${number(+$("position").max, 1)} s`);
  if (document.activeElement !== $("speed")) $("speed").value = speed;
}
$("play").onclick = () => connection.send({ do: "play", on: $("play").dataset.playing !== "true" });
$("position").oninput = () => (seeking = true);
$("position").onchange = () => {
  seeking = false;
  connection.send({ do: "play", at_s: +$("position").value });
};
$("speed").onchange = () => connection.send({ do: "play", speed: +$("speed").value });
