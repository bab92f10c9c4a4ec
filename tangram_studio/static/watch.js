// Watching runs: one or two, their scores in one chart. Whatever a run says is shown as text.

const LIVE_MS = 2000;
const GONE_MS = 5000; // no master answers, but one may come
const ENDED_MS = 15000;
const PATIENCE_MS = 20000;
const SVG = "http://www.w3.org/2000/svg";
const LOST = "Lost the connection to tangram-studio: is it still running? Trying again.";
const ANEW = "tangram-studio was started anew: open the address that it printed now.";
const STATES = { training: "training", waiting: "waiting", ended: "ended", stopped: "no master answers" };
const MEASURES = {
  mean_reward: ["mean reward", "mean reward of tests (-1 to 1)"],
  coverage: ["covered share", "covered share of targets (0 to 1)"],
  share_solved: ["share solved", "share of tests solved (0 to 1)"],
};
const AXES = {
  updates: ["updates", (p) => p.updates],
  minutes: ["minutes of training", (p) => p.train_s / 60],
};
const HEIGHT = 300;
const EDGE = { top: 14, right: 16, bottom: 46, left: 54 };
const TABLE_ROWS = 20;
const DOTS = 60; // points of a curve that each get a mark

const count = (n) => n.toLocaleString("en");

function make(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function draw(name, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

// A live region is read out whenever it is written to.
function tell(where, text) {
  if (where.textContent !== text) where.textContent = text;
}

// Round numbers from low to high, about `many`.
function ticks(low, high, many) {
  const rough = (high - low) / many;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((one) => one * power >= rough * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  return found;
}

class Panel {
  constructor(page, index) {
    this.page = page;
    this.index = index;
    this.run = ""; // that is watched
    this.view = null;
    this.points = [];
    this.asked = 0; // answers to an earlier question are dropped
    this.input = make("input", {
      id: `watch-run-${index}`, list: "watch-runs", autocomplete: "off", spellcheck: "false",
      autocapitalize: "off", placeholder: "runs/my_run", required: "",
    });
    const label = index ? "The other run" : "A run folder, or host:port of a master";
    const button = make("button", { type: "submit", class: "main" }, "Watch");
    const fields = make("div", { class: "watch-fields" }, this.input, button);
    if (index) {
      const away = make("button", { type: "button" }, "Remove");
      away.addEventListener("click", () => page.remove(this));
      fields.append(away);
    }
    const form = make("form", {}, make("label", { for: this.input.id }, label), fields);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.watch(this.input.value.trim());
    });
    this.status = make("p", { class: "watch-status", "aria-live": "polite" });
    this.head = make("div", { class: "watch-head" }, form, this.status);
    this.body = make("article", { class: "watch-body", hidden: "" });
    this.title = make("h2");
    this.state = make("span", { class: "watch-state" });
    this.told = make("ul", { class: "watch-told" });
    this.progress = make("progress", { max: "1", "aria-label": "Done of the run" });
    this.stage = make("p", { class: "watch-stage" });
    this.rows = make("dl");
    this.workers = make("div", { class: "watch-wide", tabindex: "0", role: "region", "aria-label": "Workers" });
    this.picture = make("figure");
    this.body.append(
      make("header", {}, this.title, this.state), this.told, this.progress, this.stage,
      this.rows, this.workers, this.picture,
    );
  }

  get label() {
    const { page, view } = this;
    const same = page.panels.filter((other) => other.view?.name === view.name).length > 1;
    return same ? this.run : view.name;
  }

  watch(run) {
    if (!run) return;
    this.run = run;
    this.forget();
    this.say(`Looking at ${run} …`);
    this.ask();
  }

  forget() {
    this.view = null;
    this.points = [];
    this.drawn = undefined;
    this.picture.replaceChildren();
    this.body.hidden = true;
    this.page.chart.draw();
  }

  say(text, bad = false) {
    this.status.classList.toggle("bad", bad);
    tell(this.status, text);
  }

  later(ms) {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.ask(), ms);
  }

  stop() {
    clearTimeout(this.timer);
    this.asked += 1;
  }

  async ask() {
    this.stop();
    if (!this.run || this.page.hidden) return;
    const mine = this.asked;
    let answer;
    let content;
    try {
      const signal = AbortSignal.timeout(PATIENCE_MS);
      answer = await fetch(`api/watch?run=${encodeURIComponent(this.run)}`, { signal });
      content = answer.ok ? await answer.json() : await answer.json().catch(() => ({}));
    } catch {
      if (mine === this.asked) {
        this.lost(LOST);
        this.later(LIVE_MS);
      }
      return;
    }
    if (mine !== this.asked) return;
    if (answer.ok) this.show(content);
    else if (answer.status === 403) this.lost(ANEW);
    else this.refused(content.error ?? `the server's answer is ${answer.status}`);
  }

  lost(text) {
    this.body.classList.toggle("old", Boolean(this.view));
    this.say(text, true);
  }

  // A wrong name stays wrong; what was there before may come back.
  refused(error) {
    const before = this.view;
    this.lost(before ? `It went away: ${error}. Trying again; below is what was known last.` : error);
    if (before) this.later(GONE_MS);
  }

  show(view) {
    this.view = view;
    this.body.hidden = false;
    this.body.classList.remove("old");
    this.keep(view);
    this.say(view.told[0] ?? "", view.state === "stopped");
    this.title.textContent = this.label;
    this.title.title = view.folder ?? view.source;
    this.state.textContent = STATES[view.state] ?? view.state;
    this.state.dataset.state = view.state;
    this.told.replaceChildren(...view.told.slice(1).map((one) => make("li", {}, one)));
    this.progress.hidden = view.share === null;
    this.progress.value = view.share ?? 0;
    this.showStage(view.stage);
    this.rows.replaceChildren(
      ...view.rows.map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text))),
    );
    this.showWorkers(view.workers);
    this.showPicture(view);
    this.page.chart.draw();
    this.later({ ended: ENDED_MS, stopped: GONE_MS }[view.state] ?? LIVE_MS);
  }

  // Of a master alone only its newest score is told: the page keeps what it has seen.
  keep({ folder, curve }) {
    if (folder !== null) this.points = curve;
    else this.points.push(...curve.filter((p) => !this.points.some((q) => q.updates === p.updates)));
  }

  showStage(stage) {
    this.stage.hidden = !stage;
    if (stage) tell(this.stage, `Curriculum: ${stage.told}${stage.then ? `. Next: ${stage.then}` : ""}.`);
  }

  showWorkers({ columns, rows, more }) {
    this.workers.hidden = !rows.length;
    const head = make("tr", {}, ...columns.map((one) => make("th", { scope: "col" }, one)));
    const cells = ([first, ...rest]) =>
      make("tr", {}, make("th", { scope: "row" }, first), ...rest.map((one) => make("td", {}, one)));
    const table = make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows.map(cells)));
    this.workers.replaceChildren(table);
    if (more) this.workers.append(make("p", {}, `and ${count(more)} more`));
  }

  showPicture({ episodes, name, folder, state }) {
    const key = episodes ? `run=${encodeURIComponent(this.run)}&at=${episodes.at}` : state;
    if (key === this.drawn) return;
    this.drawn = key;
    if (!episodes) {
      const why = folder === null ? "A master sends no pictures: name its run folder."
        : state === "ended" ? "This run left no picture of test episodes."
        : "Test episodes are drawn after the first evaluation.";
      this.picture.replaceChildren(make("figcaption", {}, why));
      return;
    }
    const when = new Date(1000 * episodes.at).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
    const image = make("img", { src: `api/episodes?${key}`, alt: `Test episodes of ${name}, as they ended` });
    const link = make("a", { href: image.src, target: "_blank", rel: "noopener", title: "In full size" }, image);
    const caption = make("figcaption", {}, `Test episodes, drawn ${when}`);
    image.addEventListener("error", () => {
      link.remove();
      caption.textContent = "The picture of test episodes could not be loaded.";
    });
    this.picture.replaceChildren(link, caption);
  }
}

class Chart {
  constructor(page) {
    this.page = page;
    this.axis = "updates";
    this.measure = "mean_reward";
    this.svg = draw("svg", { role: "img", height: HEIGHT });
    this.legend = make("ul", { class: "watch-legend" });
    this.choose = make("select", { "aria-label": "What is drawn" });
    for (const [name, [short]] of Object.entries(MEASURES)) this.choose.append(make("option", { value: name }, short));
    this.choose.addEventListener("change", () => {
      this.measure = this.choose.value;
      this.draw();
    });
    const axes = make("fieldset", {}, make("legend", {}, "Against"));
    for (const [name, [long]] of Object.entries(AXES)) {
      const input = make("input", { type: "radio", name: "watch-axis", value: name });
      input.checked = name === this.axis;
      input.addEventListener("change", () => {
        this.axis = name;
        this.draw();
      });
      axes.append(make("label", {}, input, long));
    }
    this.values = make("div", { class: "watch-values" });
    const table = make("details", {}, make("summary", {}, "The newest values as a table"), this.values);
    this.empty = make("p", { class: "watch-empty" }, "No test scores yet: an evaluator sends them.");
    const controls = make("div", { class: "watch-controls" }, this.choose, axes);
    this.box = make("div", { class: "watch-chart", hidden: "" }, controls, this.legend, this.svg, this.empty, table);
    new ResizeObserver(() => this.draw()).observe(this.box);
  }

  curves() {
    const at = AXES[this.axis][1];
    return this.page.panels
      .filter((panel) => panel.view)
      .map((panel) => ({
        name: panel.label,
        index: panel.index,
        points: panel.points.filter((p) => this.measure in p).map((p) => ({ ...p, x: at(p), y: p[this.measure] })),
      }));
  }

  draw() {
    const watched = this.page.panels.filter((panel) => panel.view);
    this.box.hidden = !watched.length;
    const several = watched.some((panel) => panel.points.some((p) => "coverage" in p));
    this.choose.hidden = !several;
    if (!several) this.choose.value = this.measure = "mean_reward";
    const curves = this.curves();
    const full = curves.filter((curve) => curve.points.length);
    this.empty.hidden = full.length > 0;
    this.svg.toggleAttribute("hidden", !full.length);
    this.writeLegend(curves);
    this.writeValues(full);
    this.svg.setAttribute("aria-label", this.spoken(curves));
    if (full.length && this.box.clientWidth) this.paint(full);
  }

  spoken(curves) {
    const [short] = MEASURES[this.measure];
    const last = ({ name, points }) => {
      const end = points.at(-1);
      return end ? `${name}: ${end.y.toFixed(3)} after ${count(end.updates)} updates` : `${name}: none yet`;
    };
    return `Chart of the ${short} against ${AXES[this.axis][0]}. Last values: ${curves.map(last).join("; ")}.`;
  }

  writeLegend(curves) {
    this.legend.hidden = curves.length < 2;
    const entry = ({ name, index, points }) => {
      const swatch = draw("svg", { width: 34, height: 12, "aria-hidden": "true" });
      swatch.append(draw("line", { x1: 1, y1: 6, x2: 33, y2: 6, class: `curve curve-${index}` }), this.mark(17, 6, index));
      const end = points.at(-1);
      return make("li", {}, swatch, make("span", {}, end ? `${name}: ${end.y.toFixed(3)}` : `${name}: no scores yet`));
    };
    this.legend.replaceChildren(...curves.map(entry));
  }

  writeValues(curves) {
    const [short] = MEASURES[this.measure];
    const head = ["updates", "minutes", short];
    const tables = curves.map(({ name, points }) => {
      const rows = points.slice(-TABLE_ROWS).reverse().map((p) => [count(p.updates), (p.train_s / 60).toFixed(2), p.y.toFixed(3)]);
      return make("table", {}, make("caption", {}, name),
        make("thead", {}, make("tr", {}, ...head.map((one) => make("th", { scope: "col" }, one)))),
        make("tbody", {}, ...rows.map((row) => make("tr", {}, ...row.map((one) => make("td", {}, one))))));
    });
    this.values.replaceChildren(...tables);
  }

  mark(x, y, index) {
    const common = { class: `mark mark-${index}` };
    return index
      ? draw("rect", { x: x - 3.5, y: y - 3.5, width: 7, height: 7, ...common })
      : draw("circle", { cx: x, cy: y, r: 3.5, ...common });
  }

  paint(curves) {
    const style = getComputedStyle(this.box);
    const width = this.box.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight);
    const [right, bottom] = [width - EDGE.right, HEIGHT - EDGE.bottom];
    const all = curves.flatMap((curve) => curve.points);
    const [, long] = MEASURES[this.measure];
    const high_x = Math.max(...all.map((p) => p.x)) || 1;
    const ys = all.map((p) => p.y);
    let [low, high] = [Math.min(...ys), Math.max(...ys)];
    const room = Math.max(0.02, (high - low) * 0.06);
    [low, high] = [low - room, high + room];
    const at = (x) => EDGE.left + (x / high_x) * (right - EDGE.left);
    const up = (y) => bottom - ((y - low) / (high - low)) * (bottom - EDGE.top);
    const parts = [];
    const y_ticks = ticks(low, high, 5);
    const digits = Math.min(6, Math.max(1, -Math.floor(Math.log10(y_ticks[1] - y_ticks[0] || 1) + 1e-9)));
    for (const y of y_ticks) {
      parts.push(draw("line", { x1: EDGE.left, x2: right, y1: up(y), y2: up(y), class: "grid" }));
      parts.push(draw("text", { x: EDGE.left - 8, y: up(y) + 4, class: "end" }, y.toFixed(digits)));
    }
    for (const x of ticks(0, high_x, Math.min(10, Math.max(3, Math.floor(width / 75))))) {
      parts.push(draw("line", { x1: at(x), x2: at(x), y1: bottom, y2: bottom + 5, class: "axis" }));
      parts.push(draw("text", { x: at(x), y: bottom + 19, class: "middle" }, count(Number(x.toPrecision(6)))));
    }
    parts.push(draw("path", { d: `M${EDGE.left} ${EDGE.top}V${bottom}H${right}`, class: "axis" }));
    parts.push(draw("text", { x: (EDGE.left + right) / 2, y: HEIGHT - 7, class: "middle name" }, AXES[this.axis][0]));
    const middle = (EDGE.top + bottom) / 2;
    parts.push(draw("text", { x: 13, y: middle, transform: `rotate(-90 13 ${middle})`, class: "middle name" }, long));
    for (const { points, index } of curves) {
      const d = points.map((p) => `${at(p.x).toFixed(1)} ${up(p.y).toFixed(1)}`).join("L");
      parts.push(draw("path", { d: `M${d}`, class: `curve curve-${index}` }));
      const marked = points.length <= DOTS ? points : points.slice(-1);
      for (const p of marked) {
        const mark = this.mark(at(p.x), up(p.y), index);
        mark.append(draw("title", {}, `${p.y.toFixed(3)} after ${count(p.updates)} updates, ${(p.train_s / 60).toFixed(2)} minutes`));
        parts.push(mark);
      }
    }
    this.svg.setAttribute("width", width);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    this.svg.replaceChildren(...parts);
  }
}

class Watch {
  constructor(root) {
    this.root = root;
    this.panels = [];
    this.heads = make("div", { class: "watch-heads" });
    this.bodies = make("div", { class: "watch-bodies" });
    this.runs = make("datalist", { id: "watch-runs" });
    this.another = make("button", { type: "button" }, "Compare with another run");
    this.another.addEventListener("click", () => {
      this.add().input.focus();
      this.another.hidden = true;
    });
    this.chart = new Chart(this);
    root.replaceChildren(this.runs, this.heads, this.another, this.chart.box, this.bodies);
    this.add();
    new MutationObserver(() => this.wake()).observe(root, { attributes: true, attributeFilter: ["hidden"] });
    document.addEventListener("visibilitychange", () => this.wake());
    this.wake();
  }

  get hidden() {
    return document.hidden || this.root.hidden;
  }

  add() {
    const panel = new Panel(this, this.panels.length);
    this.panels.push(panel);
    this.heads.append(panel.head);
    this.bodies.append(panel.body);
    return panel;
  }

  remove(panel) {
    panel.stop();
    panel.head.remove();
    panel.body.remove();
    this.panels = this.panels.filter((one) => one !== panel);
    this.another.hidden = false;
    this.another.focus();
    this.chart.draw();
  }

  // Nothing is asked for while nobody looks.
  wake() {
    for (const panel of this.panels) {
      if (this.hidden) panel.stop();
      else panel.ask();
    }
    if (!this.hidden) this.list();
  }

  async list() {
    try {
      const { runs } = await (await fetch("api/runs")).json();
      this.runs.replaceChildren(...runs.map((run) => make("option", { value: run })));
      if (runs.length) this.panels[0].input.placeholder = runs[0];
    } catch {
      // The list is a help, and a run can be typed without it.
    }
  }
}

export function startWatch(root) {
  return new Watch(root);
}
