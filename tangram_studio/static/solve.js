// A person lays a figure against the clock. A hint lays one tan, and the agent may race.

import { MOVE_MS, pathOf, tray } from "./board.js";

const PIXELS = 240; // along the table, to compare figure and tans
const SOLVED = 0.95; // IoU of tans and figure, as everywhere
const NEAR = 0.03; // arena units: corners so near to their place in the answer count as there
const OVER = 0.03; // of the tans' area that may lie on other tans

const CHOOSE = "Choose a figure first.";
const clock = (ms) => `${Math.floor(ms / 60_000)}:${String(Math.floor(ms / 1000) % 60).padStart(2, "0")}`;

export class Solving {
  // `say` shows a line, `reveal(k)` shows a tan of the answer, `next` asks for the agent's next move.
  constructor(board, { say, reveal, next }) {
    Object.assign(this, { board, say, reveal, next, solved: false, racing: false });
    this.canvas = new OffscreenCanvas(PIXELS, PIXELS);
  }

  begin(answer) {
    this.answer = answer;
    this.racing = false;
    this.board.holds = answer.laid;
    this.board.show(answer.laid);
    this.again();
  }

  again() {
    this.solved = false;
    this.begun = performance.now();
    this.board.put(tray(this.board.tokens));
    this.say("Drag the tans onto the figure. R turns a tan, F turns the parallelogram over.");
  }

  // Check whether the figure is solved, after a person has let go of a tan.
  look() {
    if (!this.answer || this.solved) return;
    const { iou, twice } = this.compared();
    if (iou >= SOLVED && twice <= OVER) {
      this.solved = true;
      this.took = performance.now() - this.begun;
      const first = this.racing ? " You were faster than the agent." : "";
      this.say(`Solved! It took you ${clock(this.took)}.${first}`, `IoU ${iou.toFixed(3)}`);
    }
  }

  // Lay one tan, that is not in its place yet, where the answer has it.
  hint() {
    if (!this.answer || this.solved) {
      this.say(this.solved ? "The figure is solved already." : CHOOSE);
      return;
    }
    const { poses, flipped } = this.answer.goal;
    const k = poses.findIndex((_, i) => !this.lies(i, i) && !this.taken(i));
    if (k < 0) {
      this.say("All tans are in their places.");
      return;
    }
    this.board.poses[k] = [...poses[k]];
    this.board.flipped[k] = flipped[k];
    this.board.raise(k);
    this.board.draw();
    this.say(`The ${this.board.tokens[k].name.replaceAll("_", " ")} is laid in its place.`);
    this.look();
  }

  // Whether another tan of the same shape lies in a tan's place already.
  taken(k) {
    const alike = (token) => token.name === this.board.tokens[k].name;
    return this.board.tokens.some((token, other) => other !== k && alike(token) && this.lies(other, k));
  }

  // Whether a tan lies in a place, its own or another's: each corner is near to one of the place.
  lies(own, place) {
    const { poses, flipped } = this.answer.goal;
    const wanted = this.board.corners(place, poses[place], flipped[place]);
    return this.board.corners(own).every(([x, y]) =>
      wanted.some(([u, v]) => Math.hypot(x - u, y - v) <= NEAR));
  }

  race() {
    if (!this.answer) {
      this.say(CHOOSE);
      return false;
    }
    this.again();
    this.racing = true;
    this.say("The agent has begun: watch it in the small picture.");
    return true;
  }

  // Show a move of the agent in a race; it takes as long as on the table.
  raced(move) {
    const own = this.begun;
    setTimeout(() => {
      if (this.begun !== own || !this.racing) return;
      if (move.token !== null) this.reveal(move.token);
      if (!move.over) this.next();
      else if (!this.solved) {
        this.racing = false;
        const took = clock(performance.now() - this.begun);
        const told = move.iou >= SOLVED ? `The agent was first, in ${took}.` : "The agent can do no more.";
        this.say(`${told} Go on, or start again.`);
      }
    }, move.token === null ? 0 : MOVE_MS);
  }

  // IoU of tans and figure, and the share of the tans' area that lies on other tans.
  compared() {
    const draw = (paths) => {
      const context = this.canvas.getContext("2d", { willReadFrequently: true });
      context.setTransform(PIXELS / 2, 0, 0, -PIXELS / 2, PIXELS / 2, PIXELS / 2);
      context.clearRect(-1, -1, 2, 2);
      for (const path of paths) context.fill(new Path2D(path), "evenodd");
      return context.getImageData(0, 0, PIXELS, PIXELS).data.filter((_, i) => i % 4 === 3).map((a) => a > 127);
    };
    const every = this.board.tokens.map((_, k) => pathOf([this.board.corners(k)]));
    const [figure, tans] = [draw([pathOf(this.answer.laid)]), draw(every)];
    const count = (pixels) => pixels.reduce((sum, one) => sum + one, 0);
    const shared = figure.filter((one, i) => one && tans[i]).length;
    const alone = every.reduce((sum, path) => sum + count(draw([path])), 0);
    return { iou: shared / (count(figure) + count(tans) - shared), twice: 1 - count(tans) / alone };
  }
}
