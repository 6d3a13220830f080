// The map: robots, where they were, and what their scanners saw. Metres; x to the right, y up.

import { $, colour, css } from "./dom.js";

const SCANS = 60; // of each robot that stay, the newest in full colour
const POINTS = 2000; // of a path
const RADIUS_M = 0.2; // robots are drawn so large
const STEP_M = 0.02;
const LEAST_PX_M = 4;
const MOST_PX_M = 600;

export class Map2d {
  #canvas = $("chart");
  #paths = new Map();
  #scans = new Map();
  #poses = {};
  #old = new Set(); // robots whose pose or scan is not current
  #allOld = false;
  #free = {};
  #scale = 90; // px/m
  #centre = [0, 0];
  #pointers = new Map();
  #due = false;

  constructor(fleet) {
    this.fleet = fleet;
    new ResizeObserver(() => this.#draw()).observe(this.#canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#draw());
    $("fit").onclick = () => this.fit();
    $("clear").onclick = () => {
      this.#paths.clear();
      this.#scans.clear();
      this.#draw();
    };
    this.#canvas.addEventListener("pointerdown", (event) => {
      this.#canvas.setPointerCapture(event.pointerId);
      this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      this.#canvas.addEventListener(end, (event) => this.#pointers.delete(event.pointerId));
    }
    this.#canvas.addEventListener("pointermove", (event) => this.#drag(event));
    this.#canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.#zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
      },
      { passive: false },
    );
  }

  begin(paths) {
    this.#paths = new Map(Object.entries(paths).map(([robot, points]) => [robot, points]));
    this.#scans.clear();
    this.#draw();
  }

  show(state, free) {
    this.#poses = state.poses;
    this.#old = new Set(state.old);
    this.#free = free;
    for (const [robot, [x, y]] of Object.entries(state.poses)) {
      if (!this.#paths.has(robot)) this.#paths.set(robot, []);
      const path = this.#paths.get(robot);
      const last = path.at(-1);
      if (!last || Math.hypot(x - last[0], y - last[1]) >= STEP_M) path.push([x, y]);
      if (path.length > POINTS) path.splice(0, path.length - POINTS);
    }
    const chosen = state.poses[this.fleet.chosen];
    if (chosen && $("follow").checked && !this.#pointers.size) this.#centre = [chosen[0], chosen[1]];
    this.#draw();
  }

  /** Whether nothing comes from the station. */
  age(old) {
    if (old === this.#allOld) return;
    this.#allOld = old;
    this.#draw();
  }

  #isOld(robot) {
    return this.#allOld || this.#old.has(robot);
  }

  /** A scan is drawn from where the robot was. */
  scan(scans) {
    for (const [robot, { pose, points }] of Object.entries(scans)) {
      const [x, y, heading] = pose ?? [0, 0, 0];
      const [c, s] = [Math.cos(heading), Math.sin(heading)];
      const placed = new Float32Array(points.length);
      for (let i = 0; i < points.length; i += 2) {
        const [ahead, left] = [points[i] / 1000, points[i + 1] / 1000];
        placed[i] = x + c * ahead - s * left;
        placed[i + 1] = y + s * ahead + c * left;
      }
      const kept = this.#scans.get(robot) ?? [];
      kept.push(placed);
      if (kept.length > SCANS) kept.shift();
      this.#scans.set(robot, kept);
    }
  }

  fit() {
    const points = [...this.#paths.values()].flat();
    for (const kept of this.#scans.values()) {
      for (const scan of kept) for (let i = 0; i < scan.length; i += 2) points.push([scan[i], scan[i + 1]]);
    }
    if (!points.length) return;
    const [xs, ys] = [points.map((point) => point[0]), points.map((point) => point[1])];
    const least = (all) => all.reduce((a, b) => Math.min(a, b), Infinity);
    const most = (all) => all.reduce((a, b) => Math.max(a, b), -Infinity);
    const [left, right, low, high] = [least(xs) - 0.5, most(xs) + 0.5, least(ys) - 0.5, most(ys) + 0.5];
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    this.#scale = Math.min(MOST_PX_M, Math.max(LEAST_PX_M, Math.min(width / (right - left), height / (high - low))));
    this.#centre = [(left + right) / 2, (low + high) / 2];
    $("follow").checked = false;
    this.#draw();
  }

  #drag(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.#pointers.size === 2) {
      const [other] = [...this.#pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const spread = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
      const box = this.#canvas.getBoundingClientRect();
      this.#zoom(spread(now) / Math.max(1, spread(before)), (now[0] + other[0]) / 2 - box.x, (now[1] + other[1]) / 2 - box.y);
    } else {
      $("follow").checked = false;
      this.#centre = [this.#centre[0] - (now[0] - before[0]) / this.#scale, this.#centre[1] + (now[1] - before[1]) / this.#scale];
    }
    this.#pointers.set(event.pointerId, now);
    this.#draw();
  }

  #zoom(factor, x, y) {
    const scale = Math.min(MOST_PX_M, Math.max(LEAST_PX_M, this.#scale * factor));
    if (!$("follow").checked) {
      const [dx, dy] = [x - this.#canvas.clientWidth / 2, y - this.#canvas.clientHeight / 2];
      this.#centre[0] += dx / this.#scale - dx / scale;
      this.#centre[1] -= dy / this.#scale - dy / scale;
    }
    this.#scale = scale;
    this.#draw();
  }

  #draw() {
    if (this.#due) return;
    this.#due = true;
    requestAnimationFrame(() => {
      this.#due = false;
      this.#paint();
    });
  }

  #paint() {
    const canvas = this.#canvas;
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const [scale, [cx, cy]] = [this.#scale, this.#centre];
    const X = (x) => width / 2 + (x - cx) * scale;
    const Y = (y) => height / 2 - (y - cy) * scale;
    this.#grid(pen, width, height, X, Y);
    for (const [robot, kept] of this.#scans) {
      pen.fillStyle = colour(this.fleet.index(robot));
      const dot = Math.max(1.5, Math.min(4, scale / 40));
      kept.forEach((scan, age) => {
        pen.globalAlpha = age === kept.length - 1 && !this.#isOld(robot) ? 0.95 : 0.1 + (0.22 * age) / kept.length;
        for (let i = 0; i < scan.length; i += 2) pen.fillRect(X(scan[i]) - dot / 2, Y(scan[i + 1]) - dot / 2, dot, dot);
      });
      pen.globalAlpha = 1;
    }
    for (const [robot, path] of this.#paths) {
      pen.strokeStyle = colour(this.fleet.index(robot));
      pen.lineWidth = 2;
      pen.globalAlpha = 0.6;
      pen.beginPath();
      path.forEach(([x, y], index) => (index ? pen.lineTo(X(x), Y(y)) : pen.moveTo(X(x), Y(y))));
      pen.stroke();
      pen.globalAlpha = 1;
    }
    canvas.dataset.old = Object.keys(this.#poses).filter((robot) => this.#isOld(robot)).join(" ");
    for (const [robot, pose] of Object.entries(this.#poses)) if (pose) this.#robot(pen, robot, pose, X, Y);
  }

  #grid(pen, width, height, X, Y) {
    const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((each) => each * this.#scale >= 46) ?? 100;
    const [halfX, halfY] = [width / 2 / this.#scale, height / 2 / this.#scale];
    pen.strokeStyle = css("--edge");
    pen.lineWidth = 1;
    for (const [along, middle, half] of [["x", this.#centre[0], halfX], ["y", this.#centre[1], halfY]]) {
      for (let at = Math.ceil((middle - half) / step) * step; at <= middle + half; at += step) {
        pen.globalAlpha = Math.abs(at) < step / 1000 ? 1 : 0.55;
        pen.beginPath();
        if (along === "x") {
          pen.moveTo(X(at), 0);
          pen.lineTo(X(at), height);
        } else {
          pen.moveTo(0, Y(at));
          pen.lineTo(width, Y(at));
        }
        pen.stroke();
      }
    }
    pen.globalAlpha = 1;
    const long = step * this.#scale;
    pen.strokeStyle = pen.fillStyle = css("--quiet");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(14, height - 20);
    pen.lineTo(14, height - 14);
    pen.lineTo(14 + long, height - 14);
    pen.lineTo(14 + long, height - 20);
    pen.stroke();
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(`${+step.toFixed(1)} m`, 20, height - 20);
  }

  #robot(pen, robot, [x, y, heading], X, Y) {
    const paint = colour(this.fleet.index(robot));
    const size = Math.max(9, RADIUS_M * this.#scale);
    const old = this.#isOld(robot);
    const free = old ? null : this.#free[robot];
    pen.save();
    if (old) pen.globalAlpha = 0.35;
    pen.translate(X(x), Y(y));
    pen.rotate(-heading);
    if (free !== undefined && free !== null) {
      pen.strokeStyle = paint;
      pen.setLineDash([5, 5]);
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.moveTo(size, 0);
      pen.lineTo(size + free * this.#scale, 0);
      pen.stroke();
      pen.setLineDash([]);
      pen.beginPath();
      pen.moveTo(size + free * this.#scale, -6);
      pen.lineTo(size + free * this.#scale, 6);
      pen.stroke();
    }
    pen.fillStyle = paint;
    pen.globalAlpha = old ? 0.05 : 0.22;
    pen.beginPath();
    pen.arc(0, 0, size, 0, 2 * Math.PI);
    pen.fill();
    pen.globalAlpha = old ? 0.35 : 1;
    pen.strokeStyle = paint;
    pen.setLineDash(old ? [4, 4] : []);
    pen.lineWidth = robot === this.fleet.chosen ? 2.5 : 1.5;
    pen.stroke();
    pen.beginPath();
    pen.moveTo(size * 0.72, 0);
    pen.lineTo(-size * 0.45, size * 0.5);
    pen.lineTo(-size * 0.2, 0);
    pen.lineTo(-size * 0.45, -size * 0.5);
    pen.closePath();
    pen.fill();
    pen.restore();
    pen.fillStyle = css("--text");
    pen.font = "600 12px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.fillText(old ? `${robot} was here` : robot, X(x), Y(y) + size + 15);
    pen.textAlign = "left";
  }
}
