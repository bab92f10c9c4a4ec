// The table: seven tans as polygons that can be dragged, and moves that are shown.
// Lengths are in arena units, y up; angles in radians.

const SVG = "http://www.w3.org/2000/svg";
export const MOVE_MS = 1000;
const LARGER = 0.12; // how much larger a carried tan looks
const STEP = 0.05;
const TURN = Math.PI / 4;
const SNAP = 0.05;

export const make = (name, attributes = {}) => {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
};

export const pathOf = (rings) =>
  rings.map((ring) => `M${ring.map(([x, y]) => `${x},${y}`).join("L")}Z`).join("");

const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

export class Board {
  // `tokens`: of each its name, body corners, colour, and whether its other side differs.
  constructor(svg, tokens) {
    this.svg = svg;
    this.tokens = tokens;
    this.mode = "play"; // or lay, draw
    this.holds = []; // polygons beside the tans that a tan snaps to
    this.queue = [];
    this.move = null;
    this.ms = MOVE_MS; // duration of a move
    this.frames = { shown: 0, moves: 0, waited: 0 };
    this.onDrag = () => {}; // (done): a person takes a tan, or has let it go
    this.onMove = () => {}; // (move): its showing begins
    this.onShown = () => {}; // (move): it is over
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
    this.table = make("g", { transform: "scale(1,-1)" });
    this.goal = make("path", { class: "goal", d: "" });
    this.wanted = make("path", { class: "wanted", d: "" });
    this.tans = tokens.map((token, k) => this.tan(token, k));
    this.shadow = make("polygon", { class: "shadow" });
    this.finger = make("circle", { class: "finger", r: 0.04 });
    this.ink = make("g");
    this.table.append(this.goal, this.wanted, ...this.tans, this.finger, this.ink);
    svg.append(this.table);
    this.put(tray(tokens));
  }

  tan(token, k) {
    const tan = make("polygon", {
      class: "tan", points: token.corners.map((c) => c.join(",")).join(" "), fill: token.colour,
      tabindex: 0, role: "button", "aria-label": token.name.replaceAll("_", " "),
    });
    tan.addEventListener("pointerdown", (event) => this.take(event, k));
    tan.addEventListener("keydown", (event) => this.key(event, k));
    tan.addEventListener("focus", () => this.choose(k));
    return tan;
  }

  put({ poses, flipped }) {
    this.poses = poses.map((pose) => [...pose]);
    this.flipped = [...flipped];
    this.draw();
  }

  get scene() {
    return { poses: this.poses.map(([x, y, a]) => [x, y, wrapped(a)]), flipped: [...this.flipped] };
  }

  draw(held = -1, height = 0) {
    this.tans.forEach((tan, k) => {
      const [x, y, angle] = this.poses[k];
      const size = k === held ? 1 + LARGER * height : 1;
      const mirror = this.flipped[k] ? -size : size;
      tan.setAttribute("transform",
        `translate(${x},${y}) rotate(${(angle * 180) / Math.PI}) scale(${size},${mirror})`);
      tan.classList.toggle("held", k === held && height > 0);
    });
    const lifted = held >= 0 && height > 0;
    this.shadow.style.display = lifted ? "" : "none";
    if (lifted) {
      const [dx, dy] = [0.05 * height, -0.07 * height];
      const points = this.corners(held).map(([x, y]) => `${x + dx},${y + dy}`);
      this.shadow.setAttribute("points", points.join(" "));
      if (this.shadow.nextSibling !== this.tans[held]) this.table.insertBefore(this.shadow, this.tans[held]);
    }
  }

  show(outline, wanted = []) {
    this.goal.setAttribute("d", pathOf(outline));
    this.wanted.setAttribute("d", pathOf(wanted));
  }

  // Moves of the agent

  add(move) {
    this.queue.push(move);
    if (!this.move) this.begin();
  }

  begin() {
    this.move = this.queue.shift() ?? null;
    if (!this.move) return;
    if (this.idle && this.move.token !== null) this.frames.waited += performance.now() - this.idle;
    this.flipped = [...this.move.flipped];
    this.since = performance.now();
    this.tans.forEach((tan, k) => {
      tan.classList.toggle("blocked", this.move.blocked && k === this.move.token);
    });
    if (this.move.token !== null && this.move.lifts) this.raise(this.move.token);
    this.onMove(this.move);
    const own = this.move;
    const tick = (now) => {
      if (this.move !== own) return;
      this.frames.shown += 1;
      const still = own.token === null || this.calm.matches;
      const share = still ? 1 : Math.min((now - this.since) / this.ms, 1);
      this.between(own, share);
      if (share < 1) {
        requestAnimationFrame(tick);
        return;
      }
      this.frames.moves += own.token !== null;
      this.idle = own.over ? 0 : performance.now();
      this.move = null;
      this.onShown(own);
      if (!this.move) this.begin();
    };
    requestAnimationFrame(tick);
  }

  // The tans at a share of a move's time.
  between({ frames, token, lifts, finger }, share) {
    const eased = lifts ? share * share * (3 - 2 * share) : share;
    const at = eased * (frames.length - 1);
    const first = Math.max(0, Math.min(Math.floor(at), frames.length - 2));
    const [here, there] = [frames[first], frames[Math.min(first + 1, frames.length - 1)]];
    this.poses = here.map(([x, y, angle], k) => {
      // A carried tan leaves the others alone until it is set down.
      const part = lifts && k !== token ? (share < 1 ? 0 : 1) : at - first;
      const [tx, ty, turned] = there[k];
      return [x + part * (tx - x), y + part * (ty - y), angle + part * wrapped(turned - angle)];
    });
    const tip = share < 1 && finger?.[Math.round(at)];
    this.finger.style.display = tip ? "inline" : "none";
    if (tip) ["cx", "cy"].forEach((name, i) => this.finger.setAttribute(name, tip[i]));
    this.draw(token ?? -1, lifts && share < 1 ? Math.sin(Math.PI * share) : 0);
  }

  halt() {
    this.queue = [];
    this.move = null;
    this.idle = 0;
    this.tans.forEach((tan) => tan.classList.remove("blocked"));
    this.finger.style.display = "none";
    this.draw();
  }

  // Actions of a person

  choose(k) {
    this.chosen = k;
    this.tans.forEach((tan, other) => tan.classList.toggle("chosen", this.mode === "lay" && other === k));
  }

  raise(k) {
    // Only if needed: an element that is moved in the document loses the focus.
    if (this.ink.previousSibling === this.tans[k]) return;
    const had = document.activeElement === this.tans[k];
    this.table.insertBefore(this.tans[k], this.ink);
    if (had) this.tans[k].focus();
  }

  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY);
    const { x, y } = point.matrixTransform(this.table.getScreenCTM().inverse());
    return [x, y];
  }

  take(event, k) {
    if (this.mode === "draw" || event.button) return;
    event.preventDefault();
    this.onDrag(false);
    this.raise(k);
    this.tans[k].focus({ preventScroll: true });
    this.choose(k);
    const [startX, startY] = this.at(event);
    const [x, y] = this.poses[k];
    const tan = this.tans[k];
    tan.setPointerCapture(event.pointerId);
    const drag = (moved) => {
      const [px, py] = this.at(moved);
      this.move_to(k, x + px - startX, y + py - startY);
      this.draw(k, 0.5);
    };
    const drop = () => {
      tan.removeEventListener("pointermove", drag);
      tan.removeEventListener("pointerup", drop);
      tan.removeEventListener("pointercancel", drop);
      if (this.mode === "lay") this.snap(k);
      this.draw();
      this.onDrag(true);
    };
    tan.addEventListener("pointermove", drag);
    tan.addEventListener("pointerup", drop);
    tan.addEventListener("pointercancel", drop);
  }

  move_to(k, x, y) {
    const inside = (v) => Math.max(-0.95, Math.min(0.95, v));
    this.poses[k][0] = inside(x);
    this.poses[k][1] = inside(y);
  }

  key(event, k) {
    if (this.mode === "draw" || event.ctrlKey || event.metaKey || event.altKey) return;
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const way = ways[event.key];
    const key = event.key.toLowerCase();
    if (!way && key !== "r" && !(key === "f" && this.mode === "lay")) return;
    event.preventDefault();
    this.onDrag(false);
    if (way) {
      const step = event.shiftKey ? STEP / 5 : STEP;
      this.move_to(k, this.poses[k][0] + step * way[0], this.poses[k][1] + step * way[1]);
      if (this.mode === "lay") this.snap(k, step * 0.45);
    } else if (key === "r") this.turn(k, event.shiftKey ? -TURN : TURN);
    else this.over(k);
    this.draw();
    this.onDrag(true, true);
  }

  turn(k, angle = TURN) {
    this.poses[k][2] = wrapped(this.poses[k][2] + angle);
    this.draw();
  }

  over(k) {
    if (this.tokens[k].chiral) this.flipped[k] = !this.flipped[k];
    this.draw();
  }

  corners(k, [x, y, angle] = this.poses[k], flipped = this.flipped[k]) {
    const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
    return this.tokens[k].corners.map(([u, v]) => {
      const w = flipped ? -v : v;
      return [x + cos * u - sin * w, y + sin * u + cos * w];
    });
  }

  // Move a tan by the shortest way that lays a corner onto another tan's corner or edge.
  snap(k, reach = SNAP) {
    let best = null;
    const offer = (dx, dy, cost) => {
      const way = Math.hypot(dx, dy);
      if (way < reach && (!best || way + cost < best.cost)) best = { dx, dy, cost: way + cost };
    };
    const others = this.tans.map((_, other) => other).filter((other) => other !== k);
    const mine = this.corners(k);
    for (const theirs of [...others.map((other) => this.corners(other)), ...this.holds]) {
      for (const [ps, qs, sign] of [[mine, theirs, 1], [theirs, mine, -1]]) {
        for (const [px, py] of ps) {
          qs.forEach(([qx, qy], i) => {
            offer(sign * (qx - px), sign * (qy - py), 0);
            const [rx, ry] = qs[(i + 1) % qs.length];
            const along = [rx - qx, ry - qy];
            const length = along[0] ** 2 + along[1] ** 2;
            const t = ((px - qx) * along[0] + (py - qy) * along[1]) / length;
            if (t > 0 && t < 1) {
              offer(sign * (qx + t * along[0] - px), sign * (qy + t * along[1] - py), reach / 2);
            }
          });
        }
      }
    }
    if (best) this.move_to(k, this.poses[k][0] + best.dx, this.poses[k][1] + best.dy);
  }
}

// The tans' places before a game: around the middle of the table.
export const tray = (tokens) => ({
  poses: tokens.map((_, k) => {
    const angle = Math.PI / 2 - (2 * Math.PI * k) / tokens.length;
    return [0.7 * Math.cos(angle), 0.7 * Math.sin(angle), 0];
  }),
  flipped: tokens.map(() => false),
});
