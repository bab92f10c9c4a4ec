// Drawing a silhouette on the table: corner by corner with snapping, or freehand.

import { make, pathOf } from "./board.js";

const NEAR = 0.06; // arena units within which a corner snaps
const CLOSE = 0.05; // within this of the first corner, a click closes the outline
const POINT = 0.012; // between points of a freehand line, at least
const KEY = 0.05; // that an arrow key moves
const MOST = 1500; // points of an outline

const far = ([ax, ay], [bx, by]) => Math.hypot(ax - bx, ay - by);
const areaOf = (ring) => Math.abs(ring.reduce((sum, [x, y], i) => {
  const [u, v] = ring[(i + 1) % ring.length];
  return sum + (x * v - u * y) / 2;
}, 0));

export class Pen {
  // `side`: side of the full square that the tans are cut from.
  constructor(board, side) {
    this.board = board;
    this.kind = "polygon";
    this.snaps = true;
    this.ring = []; // the closed outline
    this.line = []; // the outline that is being drawn
    this.spot = null; // the cursor of the keyboard
    this.onChange = () => {};
    this.onEnd = () => {}; // an outline is closed
    this.again = () => false; // (event): whether a new drawing begins
    const lengths = [];
    for (let a = 0; a <= 4; a += 1) {
      for (let b = 0; b <= 4; b += 1) {
        if (a + b) lengths.push(side * (a / 2 + (b * Math.SQRT2) / 4));
      }
    }
    this.lengths = lengths.filter((one) => one <= 2.6 * side);
    const svg = board.svg;
    svg.addEventListener("pointerdown", (event) => this.down(event));
    svg.addEventListener("pointermove", (event) => this.hover(event));
    svg.addEventListener("pointerup", () => this.up());
    svg.addEventListener("pointercancel", () => this.up());
    svg.addEventListener("keydown", (event) => this.key(event));
  }

  get on() {
    return this.board.mode === "draw";
  }

  clear() {
    this.ring = [];
    this.line = [];
    this.stroke = false;
    this.draw();
  }

  undo() {
    if (this.line.length) this.line.pop();
    else this.ring = [];
    this.draw();
  }

  // The corner that a point snaps to.
  snapped(point) {
    if (!this.snaps || !this.line.length) return point;
    if (this.line.length > 2 && far(point, this.line[0]) < CLOSE) return this.line[0];
    const [x, y] = this.line.at(-1);
    let best = point;
    let least = NEAR;
    for (let turn = 0; turn < 8; turn += 1) {
      for (const length of this.lengths) {
        const angle = (turn * Math.PI) / 4;
        const there = [x + length * Math.cos(angle), y + length * Math.sin(angle)];
        if (far(there, point) < least) [best, least] = [there, far(there, point)];
      }
    }
    return best;
  }

  down(event) {
    if (event.button || !(this.on || this.again(event))) return;
    event.preventDefault();
    this.board.svg.focus({ preventScroll: true });
    const point = this.board.at(event);
    if (this.kind === "free") {
      this.ring = [];
      this.line = [point];
      this.stroke = true;
      this.board.svg.setPointerCapture(event.pointerId);
      this.draw();
    } else this.corner(point);
  }

  corner(point) {
    const there = this.snapped(point);
    const first = this.line[0];
    if (this.line.length > 2 && far(there, first) < CLOSE) {
      this.close();
      return;
    }
    if (this.line.length && far(there, this.line.at(-1)) < 1e-6) return;
    this.ring = []; // a new outline begins
    if (this.line.length < MOST) this.line.push(there);
    this.spot = there;
    this.draw();
  }

  hover(event) {
    if (!this.on) return;
    this.spot = null;
    const point = this.board.at(event);
    if (this.stroke) {
      if (far(point, this.line.at(-1)) > POINT && this.line.length < MOST) this.line.push(point);
      this.draw();
    } else if (this.kind === "polygon" && this.line.length) this.draw(this.snapped(point));
  }

  up() {
    if (!this.stroke) return;
    this.stroke = false;
    if (this.line.length > 5) this.close();
    else {
      this.line = [];
      this.draw();
    }
  }

  close() {
    if (this.line.length > 2) this.onEnd();
  }

  // The drawing as a closed outline; the next corner begins a new one.
  whole() {
    if (this.line.length > 2) {
      this.ring = this.line;
      this.line = [];
      this.draw();
    }
    return this.ring;
  }

  key(event) {
    if (!this.on || event.target !== this.board.svg) return;
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const way = ways[event.key];
    this.spot ??= this.line.at(-1) ?? [0, 0];
    if (way) {
      const step = event.shiftKey ? KEY / 5 : KEY;
      this.spot = this.spot.map((v, i) => Math.max(-1, Math.min(1, v + step * way[i])));
      this.draw(this.snapped(this.spot), this.spot);
    } else if (event.key === " ") this.corner(this.spot);
    else if (event.key === "Enter") this.close();
    else if (event.key === "Backspace") this.undo();
    else if (event.key === "Escape") this.clear();
    else return;
    event.preventDefault();
  }

  draw(next = null, spot = null) {
    const ink = [make("path", { class: "drawn", d: this.ring.length ? pathOf([this.ring]) : "" })];
    const points = (line) => line.map((p) => p.join(",")).join(" ");
    if (this.line.length) {
      ink.push(make("polyline", { class: "line", points: points(this.line) }));
      if (next) ink.push(make("polyline", { class: "line next", points: points([this.line.at(-1), next]) }));
      if (this.kind === "polygon") {
        this.line.forEach(([cx, cy], i) => {
          ink.push(make("circle", { class: i ? "corner" : "corner first", cx, cy, r: i ? 0.012 : 0.025 }));
        });
      }
    }
    if (spot) ink.push(make("circle", { class: "corner", cx: next[0], cy: next[1], r: 0.016 }));
    this.board.ink.replaceChildren(...ink);
    this.onChange(next);
  }

  area(next = null) {
    if (!this.line.length) return areaOf(this.ring);
    return areaOf(next ? [...this.line, next] : this.line);
  }
}
