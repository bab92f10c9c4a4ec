// The page: its tabs, its connection, and its messages to a person and to the server.

import { Board, make, pathOf, tray } from "./board.js";
import { Pen } from "./draw.js";
import { Solving } from "./solve.js";

const $ = (id) => document.getElementById(id);
const LIMIT = 10e6; // bytes of a file
const AGAIN_MS = 2000;
const RESTART_MS = 700; // after the last key that moved a tan
const SHUT = 4403;
const FULL = 4429;

const per_cent = (share) => `${(100 * share).toFixed(1)} %`;

class Studio {
  constructor({ figures, tokens, side, area }) {
    this.board = new Board($("board"), tokens);
    this.pen = new Pen(this.board, side);
    this.area = area;
    this.number = 0; // of the newest request: answers to older ones are dropped
    this.goal = null;
    this.over = true;
    this.name = "figure";
    this.board.onDrag = (done, byKey) => this.dragged(done, byKey);
    this.solving = new Solving(this.board, {
      say: (text, numbers) => this.say(text, false, numbers),
      reveal: (k) => { $("seen-pieces").children[k].style.display = ""; },
      next: () => this.send({ ask: "next" }),
    });
    this.begun = 0; // moves of this figure whose showing has begun
    this.board.onMove = (move) => {
      this.begun += move.token !== null;
      this.want();
    };
    this.board.onShown = (move) => this.shown(move);
    this.pen.onChange = (next) => this.measured(next);
    this.pen.onEnd = () => this.fillDrawing();
    this.pen.again = (event) => {
      if (this.kind !== "draw" || !this.over || this.looking || event.target.matches(".tan")) return false;
      this.source("draw");
      return true;
    };
    this.library(figures);
    this.controls();
    this.source("library");
    this.connect();
  }

  // The connection

  connect() {
    const address = new URL("api/play", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.resume();
    this.socket.onmessage = ({ data }) => this.hear(data);
    this.socket.onclose = ({ code }) => this.closed(code);
  }

  // Send again a request that was lost, or go on with a figure that was being laid.
  resume() {
    this.banner("");
    this.begun = 0; // another session counts anew
    if (this.looking) {
      if (this.last) this.send(this.last);
    } else if (this.goal && !this.over) this.play(this.board.scene);
  }

  async closed(code) {
    clearTimeout(this.timer);
    this.board.halt();
    this.asking = false;
    if (code === FULL) {
      this.banner("Too many pages are open on this studio: close one, then load this page again.");
      return;
    }
    // A refused socket looks like a failed connection, so ask for the reason in plain HTTP.
    const door = await fetch("api/figures").catch(() => null);
    if (code === SHUT || door?.status === 403) {
      this.banner("tangram-studio was restarted: open the new address that it printed.");
      return;
    }
    this.banner("Lost the connection to tangram-studio: is it still running? Trying again.");
    setTimeout(() => this.connect(), AGAIN_MS);
  }

  banner(text) {
    $("banner").textContent = text;
    $("banner").hidden = !text;
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  hear(data) {
    if (typeof data !== "string") {
      this.file(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.told === "pages") {
      $("pages").textContent = message.count > 1 ? `${message.count} pages are open, each with a table of its own` : "";
    } else if (message.told === "saved") this.saving = message;
    else if (message.told === "unsaved") this.say(`Nothing was saved: ${message.why}`, true);
    else if (message.number !== null && message.number !== this.number) return;
    else if (message.told === "filled") this.filled(message);
    else if (message.told === "move") this.moved(message);
    else if (message.told === "wait") {
      this.say("The studio is busy; your request starts by itself.", false, `${message.ahead} before yours`);
    } else if (message.told === "refused") this.refused(message.why);
  }

  say(text, bad = false, numbers = "") {
    $("status").textContent = text;
    $("status").classList.toggle("bad", bad);
    $("numbers").hidden = !numbers;
    $("numbers").lastElementChild.textContent = numbers;
  }

  refused(why) {
    this.board.halt();
    if (this.looking) this.clear(); // the answer on the page is that to an older request
    this.looking = false;
    this.over = true;
    this.say(`That did not work: ${why}`, true);
  }

  // What is to be laid

  library(figures) {
    $("library").append(...figures.map(({ name, outline }) => {
      const button = document.createElement("button");
      const every = outline.flat();
      const [xs, ys] = [0, 1].map((i) => every.map((point) => point[i]));
      const side = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)) * 1.1;
      const x = (Math.max(...xs) + Math.min(...xs) - side) / 2;
      const y = (-Math.max(...ys) - Math.min(...ys) - side) / 2;
      const picture = make("svg", { viewBox: `${x} ${y} ${side} ${side}`, "aria-hidden": true });
      picture.append(make("path", { d: pathOf(outline), transform: "scale(1,-1)", "fill-rule": "evenodd" }));
      button.append(picture, name.replaceAll("_", " "));
      button.dataset.figure = name;
      button.addEventListener("click", () => {
        this.name = name;
        this.fill({ puzzle: name });
      });
      return button;
    }));
  }

  source(kind) {
    this.kind = kind;
    for (const panel of document.querySelectorAll("[data-source]")) {
      panel.hidden = !panel.dataset.source.split(" ").includes(kind);
    }
    const hint = {
      library: "Choose a figure: the agent lays it.",
      solve: "Choose a figure, and lay it yourself.",
      lay: "Lay a figure with the seven tans, then show it to the agent.",
      draw: "Draw a figure on the table; when it is closed, the agent begins.",
      file: "Drop a picture on the table.",
    }[kind];
    const mine = kind !== "library" && kind !== "file"; // the person uses the table
    if (!mine && this.board.mode === "play") {
      if (this.over) this.say(hint); // otherwise the agent goes on with its figure
      return;
    }
    clearTimeout(this.timer);
    this.looking = false;
    this.over = true;
    this.number += 1;
    this.board.halt();
    this.clear();
    this.board.put(tray(this.board.tokens));
    this.table(kind === "solve" ? "lay" : mine ? kind : "play");
    this.say(hint);
    if (mine) $("board").scrollIntoView({ block: "nearest" });
  }

  // Take the figure off the table.
  clear() {
    this.goal = null;
    this.solving.answer = null;
    this.board.holds = [];
    this.board.show([]);
    $("answer").hidden = true;
  }

  // Set the table's mode, which decides what the pointer does.
  table(mode) {
    this.board.mode = mode;
    this.board.choose(-1);
    const drawing = mode === "draw";
    $("board").classList.toggle("pen", drawing);
    if (drawing) $("board").setAttribute("tabindex", 0);
    else $("board").removeAttribute("tabindex");
    for (const tan of this.board.tans) tan.style.display = drawing ? "none" : "";
    this.pen.clear();
  }

  // Begin with a new figure, and drop the one before.
  look(what) {
    clearTimeout(this.timer);
    this.dropping?.abort();
    this.board.halt();
    this.number += 1;
    this.looking = true;
    this.last = null;
    this.say(`The agent looks at ${what} …`);
    $("board").scrollIntoView({ block: "nearest" });
  }

  fill(what) {
    this.look("the figure");
    this.last = { ask: "fill", number: this.number, ...what };
    this.send(this.last);
  }

  fillDrawing() {
    const outline = this.pen.whole();
    if (!outline.length) {
      this.say("Nothing is drawn yet: draw at least three corners.", true);
      return;
    }
    this.name = "drawing";
    this.fill({ outlines: [outline], free: this.pen.kind === "free" });
  }

  async drop(file) {
    if (!file) return;
    this.look(file.name);
    const own = this.number;
    if (file.size > LIMIT) {
      this.refused(`${file.name} is larger than 10 MB: make it smaller`);
      return;
    }
    this.name = file.name.replace(/\.[^.]*$/, "").replace(/[^A-Za-z0-9_-]+/g, "_").slice(0, 40) || "file";
    this.dropping = new AbortController();
    const query = new URLSearchParams({ name: file.name });
    const answer = await fetch(`api/drop?${query}`, { method: "POST", body: file, signal: this.dropping.signal }).catch(() => null);
    const content = await answer?.json().catch(() => null);
    if (own !== this.number) return;
    if (!content) this.refused("the connection to tangram-studio was lost: is it still running?");
    else if (content.error) this.refused(content.error);
    else this.filled(content);
  }

  measured(next) {
    const area = this.pen.area(next) / this.area;
    $("area").textContent = area
      ? `Area: ${area.toFixed(2)} of the seven tans. Any size works: it will be scaled to 1.00.`
      : "";
  }

  // What the agent answers

  filled(answer) {
    this.looking = false;
    this.goal = answer.goal;
    this.exact = answer.exact;
    this.iou = answer.iou;
    this.answer = answer;
    $("answer").hidden = this.kind === "solve";
    $("seen-picture").src = answer.seen;
    const [width, height] = answer.size;
    $("seen-pieces").setAttribute("viewBox", `0 0 ${width} ${height}`);
    $("seen-pieces").replaceChildren(...answer.pieces.map((piece, k) => make("polygon", {
      points: piece.map((point) => point.join(",")).join(" "), fill: this.board.tokens[k].colour,
    })));
    const share = `The red dashes are your figure; its IoU, shared area over united area, is ${per_cent(answer.iou)}.`;
    $("told").textContent = answer.exact
      ? `What the agent sees, and where the tans go: ${answer.how}.`
      : `Seven tans do not fill it; this is the nearest figure found. ${share} ${answer.how}`;
    if (this.kind === "solve") {
      this.solving.begin(answer);
      return;
    }
    this.table("play");
    this.board.show(answer.laid, answer.exact ? [] : answer.outline);
    this.play(null);
  }

  race() {
    if (!this.solving.race()) return;
    for (const piece of $("seen-pieces").children) piece.style.display = "none";
    $("told").textContent = "What the agent has laid so far.";
    $("answer").hidden = false;
    this.number += 1;
    this.send({ ask: "play", number: this.number, goal: this.goal, start: null, shown: 0, motion: "lift" });
  }

  play(start) {
    clearTimeout(this.timer);
    this.board.halt();
    this.number += 1;
    this.asking = true;
    this.over = false;
    if (!start) {
      this.say("The agent lays the figure.");
      this.begun = 0;
    }
    const [goal, shown, motion] = [this.goal, this.begun, $("motion").value];
    this.send({ ask: "play", number: this.number, goal, start, shown, motion });
  }

  moved(move) {
    if (this.kind === "solve") {
      this.solving.raced(move);
      return;
    }
    this.asking = false;
    this.over = move.over;
    this.board.add(move);
    this.want();
  }

  // Ask for moves ahead, so that two are ready and nobody waits.
  want() {
    if (this.over || this.asking || this.board.queue.length > 1) return;
    this.asking = true;
    this.send({ ask: "next" });
  }

  dragged(done, byKey = false) {
    if (this.kind === "solve" && done) this.solving.look();
    if (this.board.mode !== "play") return;
    clearTimeout(this.timer);
    this.board.halt();
    if (!this.goal || this.looking) return;
    this.number += 1; // moves asked for are no longer wanted
    this.over = true;
    this.say("You moved a tan: the agent goes on from here.");
    if (done) this.timer = setTimeout(() => this.play(this.board.scene), byKey ? RESTART_MS : 0);
  }

  shown(move) {
    const so_far = `The tans cover ${per_cent(move.coverage)} of the figure, IoU ${move.iou.toFixed(3)}.`;
    if (!move.over) {
      const told = move.blocked ? "Other tans are in the way: the agent tries another one." : "The agent lays the figure.";
      this.say(told, false, so_far);
    } else if (move.iou >= 0.95) {
      this.say(this.exact ? "Solved!" : "Laid: the nearest figure of seven tans.", false, so_far);
    } else this.say("The agent can do no more.", false, so_far);
  }

  // Files

  save(kind) {
    if (!this.goal) return;
    this.say("Making the file …");
    const tokens = kind === "json" ? this.goal : this.board.scene;
    this.send({ ask: "save", kind, tokens, name: this.name, shown: this.begun });
  }

  // Save where each tan lies; the answer has it.
  solution() {
    this.saving = { kind: "solution.json", type: "application/json", name: this.name };
    this.file(new TextEncoder().encode(JSON.stringify(this.answer.solution, null, 1)));
  }

  file(data) {
    const { kind, type, name } = this.saving;
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([data], { type }));
    link.download = `${name}.${kind}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    this.say(`Saved ${link.download}, ${Math.ceil(data.byteLength / 1000)} kB.`);
  }

  controls() {
    for (const one of document.querySelectorAll("[name=source]")) {
      one.addEventListener("change", () => this.source(one.value));
    }
    const pens = {
      polygon: "Click each corner, then the first one again. With keys: Tab to the table, arrows move, Space sets a corner, Enter closes the figure.",
      free: "Draw the outline in one stroke. Lines need not be straight: the agent finds the nearest figure of tans.",
    };
    for (const one of document.querySelectorAll("[name=pen]")) {
      one.addEventListener("change", () => {
        this.pen.kind = one.value;
        $("draw-help").textContent = pens[one.value];
        $("snap").parentElement.hidden = one.value === "free";
        this.source("draw");
      });
    }
    $("draw-help").textContent = pens.polygon;
    $("snap").addEventListener("change", () => { this.pen.snaps = $("snap").checked; });
    $("draw-undo").addEventListener("click", () => this.pen.undo());
    $("draw-clear").addEventListener("click", () => this.source("draw"));
    $("draw-done").addEventListener("click", () => this.fillDrawing());
    $("lay-clear").addEventListener("click", () => {
      if (this.kind === "solve" && this.solving.answer) {
        $("answer").hidden = true;
        this.solving.begin(this.answer);
      }
      else this.source(this.kind);
    });
    $("hint").addEventListener("click", () => this.solving.hint());
    $("race").addEventListener("click", () => this.race());
    $("save-solution").addEventListener("click", () => this.solution());
    $("lay-done").addEventListener("click", () => {
      this.name = "layout";
      this.fill({ pieces: this.board.scene });
    });
    const chosen = (act) => () => {
      if (this.board.mode !== "lay") this.say("Start again to lay another figure.");
      else if (this.board.chosen >= 0) {
        act(this.board.chosen);
        this.board.onDrag(true, true);
      }
      else this.say("Click a tan first.");
    };
    $("turn-left").addEventListener("click", chosen((k) => this.board.turn(k)));
    $("turn-right").addEventListener("click", chosen((k) => this.board.turn(k, -Math.PI / 4)));
    $("turn-over").addEventListener("click", chosen((k) => this.board.over(k)));
    $("again").addEventListener("click", () => this.play(null));
    $("motion").addEventListener("change", () => {
      if (this.goal && !this.looking) this.play(this.over ? null : this.board.scene);
    });
    for (const kind of ["gif", "svg", "json"]) $(`save-${kind}`).addEventListener("click", () => this.save(kind));
    $("file").addEventListener("change", () => {
      this.drop($("file").files[0]);
      $("file").value = ""; // so that the same one can be chosen again
    });
    const board = $("board");
    document.addEventListener("dragover", (event) => {
      event.preventDefault();
      board.classList.add("over");
    });
    document.addEventListener("dragleave", () => board.classList.remove("over"));
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      board.classList.remove("over");
      document.querySelector("[name=source][value=file]").click();
      this.drop(event.dataTransfer.files[0]);
    });
  }
}

const begin = async () => {
  const answer = await fetch("api/figures").catch(() => null);
  if (!answer?.ok) {
    $("banner").hidden = false;
    $("banner").textContent = "tangram-studio is still loading its agents, or has ended: trying again.";
    setTimeout(begin, AGAIN_MS);
    return;
  }
  window.studio = new Studio(await answer.json());
};
begin();
