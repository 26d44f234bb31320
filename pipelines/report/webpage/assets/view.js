// The view of one policy: its tree, sliders for the state, a recorded episode, its programs.
"use strict";

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

/** An episode as it was recorded; states are known to 1/255 of their range. */
class Episode {
  constructor(data) {
    Object.assign(this, data);
    const [codes, d] = [unpacked(data.states), data.low.length];
    this.leaves = unpacked(data.leaves);
    this.length = this.leaves.length;
    this.answers = unpacked(data.answers);
    this.nActions = this.answers.length / this.length;
    this.states = Array.from({ length: this.length }, (_, t) =>
      data.low.map((low, j) => low + (codes[t * d + j] / 255) * (data.high[j] - low)));
    if (data.sprite) {
      this.picture = new Image();
      this.picture.src = `data:image/webp;base64,${data.sprite}`;
    }
  }

  answer(t) {
    const answer = Array.from(this.answers.subarray(t * this.nActions, (t + 1) * this.nActions));
    return answer;
  }
}

class PolicyView {
  constructor(container, data) {
    this.data = data;
    this.features = data.features;
    this.tree = new Tree(data.tree);
    this.episode = new Episode(data.episode);
    this.x = this.episode.states[0].slice();
    this.playing = null;
    this.charts = [];
    this.actionBox = element("div", { class: "action", "aria-live": "polite" });
    this.pathList = element("ol", { class: "path" });
    this.treeBox = element("div", { class: "tree" });
    [this.sumsBox, this.nearestBox] = [element("div"), element("div")];
    container.replaceChildren(
      element("p", { class: "quiet" }, data.about),
      element("div", { class: "view" },
        element("section", { class: "panel", "aria-label": "state" }, element("h3", {}, "The state, and what the policy does"),
          this.actionBox, this.sliders(), element("p", { class: "quiet" },
            "Ranges are the environment's, or a tenth beyond what was visited where it has none.",
            ...(this.tree.isRounded ? [" The tree's numbers are rounded to seven digits: in visited states it takes the same leaves, and actions differ by less than 1/10,000 of the largest. ",
              element("code", {}, data.page_command), " writes a page with all digits."] : []))),
        element("section", { class: "panel", "aria-label": "tree" }, element("h3", {}, "The tree"), this.search(), this.treeBox,
          element("h3", {}, "The path of this state"), this.pathList),
        element("section", { class: "panel wide", "aria-label": "why this action" }, element("h3", {}, "Why this action"), element("div", { class: "halves" }, this.sumsBox, this.nearestBox)),
        element("section", { class: "panel wide", "aria-label": "episode" }, element("h3", {}, "A recorded episode"), ...this.player()),
        element("section", { class: "panel wide", "aria-label": "what matters" }, ...importanceTable(data)),
        element("section", { class: "panel wide", "aria-label": "programs" }, ...this.programs()),
      ),
    );
    this.drawing = drawTree(this.treeBox, this.tree, this.features, (leaf) => this.leafText(leaf), (leaf) => this.goTo(leaf));
    this.drawCharts();
    this.showStep(0);
  }

  // The state

  sliders() {
    this.inputs = this.features.map(({ name, unit, low, high }, j) => {
      const output = element("output", { for: `state-${j}` });
      const input = element("input", { type: "range", id: `state-${j}`, min: low, max: high, step: "any" });
      input.addEventListener("input", () => {
        this.stop();
        this.x[j] = Number(input.value);
        this.show(this.tree.apply(this.x));
      });
      input.addEventListener("keydown", (event) => {
        const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10 }[event.key];
        if (!steps) return; // step=any moves too little by keys
        event.preventDefault();
        input.value = Number(input.value) + (steps * (high - low)) / 100;
        input.dispatchEvent(new Event("input"));
      });
      return { input, output, unit, label: element("label", { for: `state-${j}` }, unit ? `${name} (${unit})` : name, output, input) };
    });
    return element("div", { class: "sliders" }, ...this.inputs.map(({ label }) => label));
  }

  /** Show the path to a leaf, and what the policy does at the state. */
  show(leaf, answer = this.tree.answer(leaf, this.x)) {
    this.leaf = leaf;
    this.answer = answer;
    const path = this.tree.pathTo(leaf);
    this.drawing.show(path);
    this.inputs.forEach(({ input, output, unit }, j) => {
      if (Number(input.value) !== this.x[j]) input.value = this.x[j];
      output.textContent = digits(this.x[j]);
      input.setAttribute("aria-valuetext", `${digits(this.x[j])} ${unit}`);
    });
    this.showAction();
    this.showPath(path);
    showWhy(this);
  }

  showAction() {
    const colour = element("span", { class: "swatch", style: `background:${this.tree.colours[this.leaf]}` });
    const leaf = element("div", {}, colour, ` leaf ${this.leaf + 1} of ${this.tree.nLeaves.toLocaleString("en")}`);
    if (!Array.isArray(this.answer)) {
      this.actionBox.replaceChildren(leaf, element("strong", {}, this.data.answers[this.answer]));
      return;
    }
    const rows = this.answer.map((value, j) => {
      const [low, high] = this.data.limits ? [this.data.limits[0][j], this.data.limits[1][j]] : [-1, 1];
      const at = (number) => (100 * (Math.min(Math.max(number, low), high) - low)) / (high - low);
      const zero = at(0);
      const [from, to] = [Math.min(zero, at(value)), Math.max(zero, at(value))];
      return element("div", {}, `${this.data.answers[j]} ${digits(value)}`,
        element("div", { class: "bar", "aria-hidden": "true" }, element("i", { style: `left:${from}%;width:${to - from}%` })));
    });
    this.actionBox.replaceChildren(leaf, ...rows);
  }

  showPath(path) {
    const open = new Set([...this.pathList.querySelectorAll("details[open]")].map((each) => each.dataset.node));
    this.pathList.replaceChildren(...path.slice(0, -1).map((node, i) => {
      const value = this.tree.value(node, this.x);
      const holds = path[i + 1] === this.tree.left[node];
      const summary = element("summary", {}, `${testText(this.tree, node, this.features, 3)}: ${holds ? "yes" : "no"}, ${digits(value)}`);
      const row = termsOf(this.tree, node, this.features)
        .map(({ weight, name }) => `${this.tree.exact(weight)} ${name}`).concat(this.tree.exact(this.tree.v[node])).join("\n+ ");
      const details = element("details", { "data-node": node, open: open.has(String(node)) }, summary, element("pre", {}, `${row} ≤ 0`));
      return element("li", {}, details);
    }));
  }

  leafText(leaf) {
    if (this.tree.labels) return this.data.answers[this.tree.labels[leaf]];
    const row = (o) => {
      const at = (leaf * this.tree.nOutputs + o) * this.tree.nInputs;
      const terms = this.features.map(({ name, low, high }, j) => ({ name, weight: this.tree.M[at + j], size: Math.abs(this.tree.M[at + j]) * (high - low) }))
        .filter(({ weight }) => weight !== 0).sort((a, b) => b.size - a.size);
      const c = this.tree.c[leaf * this.tree.nOutputs + o];
      return terms.slice(0, 1).map(({ weight, name }) => `${digits(weight)} ${name}`).concat(terms.length > 1 ? "…" : [], digits(c)).join(" + ");
    };
    const names = this.tree.nOutputs === this.data.answers.length ? this.data.answers : null;
    return Array.from({ length: this.tree.nOutputs }, (_, o) => `${names ? `${names[o]} = ` : ""}${row(o)}`).join(", ");
  }

  /** Go to a recorded state of a leaf, where there is one. */
  goTo(leaf) {
    const step = this.episode.leaves.indexOf(leaf);
    this.stop();
    if (step >= 0) this.showStep(step);
    else this.drawing.show(this.tree.pathTo(leaf));
  }

  search() {
    const [found, box] = [element("span", { class: "quiet", "aria-live": "polite" }), element("input", { type: "search", "aria-label": "find a leaf by its number, or tests and leaves by a word", placeholder: "find: 12, or a name" })];
    box.addEventListener("input", () => {
      const word = box.value.trim().toLowerCase();
      const refs = [];
      if (/^\d+$/.test(word)) {
        if (Number(word) >= 1 && Number(word) <= this.tree.nLeaves) refs.push(~(Number(word) - 1));
      } else if (word) {
        for (let i = 0; i < this.tree.nNodes; i++) if (testText(this.tree, i, this.features).toLowerCase().includes(word)) refs.push(i);
        for (let k = 0; k < this.tree.nLeaves; k++) if (this.leafText(k).toLowerCase().includes(word)) refs.push(~k);
      }
      this.drawing.find(refs);
      found.textContent = word ? ` ${refs.length} found` : "";
    });
    return element("p", {}, box, found);
  }

  // The episode

  player() {
    const { episode } = this;
    const kept = episode.stride > 1 ? `, every ${["", "", "second", "third"][episode.stride] ?? `${episode.stride}th`} of which is kept` : "";
    this.playButton = element("button", { type: "button" }, "Play");
    this.playButton.addEventListener("click", () => (this.playing ? this.stop() : this.play()));
    this.stepInput = element("input", { type: "range", min: 0, max: episode.length - 1, step: 1, value: 0, "aria-label": "step of the episode" });
    this.stepInput.addEventListener("input", () => {
      this.stop();
      this.showStep(Number(this.stepInput.value));
    });
    this.stepText = element("output", { class: "quiet" });
    this.strip = element("canvas", { class: "strip", height: 48, width: episode.length, role: "img", "aria-label": "the active leaf over time" });
    this.chartBox = element("div", { class: "charts" });
    const parts = [
      element("p", { class: "quiet" }, `It starts from seed ${episode.seed} and returns ${Math.abs(episode.return) < 1 ? digits(episode.return) : episode.return.toFixed(1)} in ${episode.n_steps.toLocaleString("en")} steps${kept}.`),
      element("div", { class: "player" }, this.playButton, this.stepInput, this.stepText),
    ];
    if (episode.picture) {
      this.frame = element("canvas", { class: "frame", width: episode.frame_width, height: episode.frame_height, role: "img", "aria-label": "what the environment shows" });
      episode.picture.addEventListener("load", () => this.showFrame());
    } else if (episode.no_frames) {
      parts.push(element("p", { class: "quiet" }, `No pictures: ${episode.no_frames}`));
    }
    const overTime = element("div", {}, element("h3", {}, "The active leaf over time"), this.strip, this.chartBox);
    return [...parts, element("div", { class: "episode" }, ...(this.frame ? [this.frame] : []), overTime)];
  }

  play() {
    if (this.step >= this.episode.length - 1) this.showStep(0);
    this.playButton.textContent = "Pause";
    const [began, from] = [performance.now(), this.step];
    const tick = (now) => {
      const step = Math.min(from + Math.floor((now - began) / 1000 / this.episode.seconds_a_step), this.episode.length - 1);
      if (step !== this.step) this.showStep(step);
      this.playing = step < this.episode.length - 1 ? requestAnimationFrame(tick) : null;
      if (!this.playing) this.playButton.textContent = "Play";
    };
    this.playing = requestAnimationFrame(tick);
  }

  stop() {
    if (this.playing) cancelAnimationFrame(this.playing);
    const wasPlaying = this.playing;
    this.playing = null;
    this.playButton.textContent = "Play";
    if (wasPlaying) showWhy(this);
  }

  /** Show a step as it was recorded: its leaf and its answer are those of the exact state. */
  showStep(step) {
    this.step = step;
    this.x = this.episode.states[step].slice();
    const answer = this.episode.answer(step);
    this.show(this.episode.leaves[step], this.tree.labels || ["sign", "argmax"].includes(this.tree.head.name) ? answer[0] : answer);
    this.stepInput.value = step;
    this.stepText.textContent = `step ${(step * this.episode.stride).toLocaleString("en")}`;
    this.showFrame();
    this.drawStrip();
    for (const chart of this.charts) chart.setCursor({ left: chart.valToPos(step * this.episode.stride, "x"), top: -10 }, false);
  }

  showFrame() {
    const { episode } = this;
    if (!this.frame || !episode.picture.complete) return;
    const i = Math.min(Math.floor(this.step / episode.frame_stride), episode.n_frames - 1);
    const [column, row] = [i % episode.frame_columns, Math.floor(i / episode.frame_columns)];
    const [w, h] = [episode.frame_width, episode.frame_height];
    this.frame.getContext("2d").drawImage(episode.picture, column * w, row * h, w, h, 0, 0, w, h);
  }

  drawStrip() {
    const [context, { width, height }] = [this.strip.getContext("2d"), this.strip];
    context.clearRect(0, 0, width, height);
    const row = height / this.tree.nLeaves;
    for (let t = 0; t < this.episode.length; t++) {
      const leaf = this.episode.leaves[t];
      context.fillStyle = this.tree.colours[leaf];
      context.fillRect(t, Math.min(leaf * row, height - 3), 1, Math.max(row, 3));
    }
    context.fillStyle = getComputedStyle(this.strip).getPropertyValue("color");
    context.fillRect(this.step, 0, 1, height);
  }

  drawCharts() {
    const steps = Array.from({ length: this.episode.length }, (_, t) => t * this.episode.stride);
    const labels = this.episode.nActions === 1 && (this.tree.labels || !this.data.limits);
    const actions = labels ? ["action"] : this.data.answers;
    const series = (values) => [steps, ...values];
    const ofActions = actions.map((_, j) => steps.map((__, t) => this.episode.answers[t * this.episode.nActions + j]));
    const ofStates = this.features.map((_, j) => this.episode.states.map((x) => x[j]));
    this.chart("actions", series(ofActions), actions, labels ? this.data.answers : null);
    this.chart("states", series(ofStates), this.features.map(({ name, unit }) => (unit ? `${name} (${unit})` : name)), null, 4);
  }

  chart(title, data, names, words, shown = 8) {
    const colour = (i) => ["#0072b2", "#d55e00", "#009e73", "#b0568a", "#b87f00", "#3d8fc0", "#7a7000", "#888888"][i % 8];
    const ink = getComputedStyle(document.body).color;
    const axis = { stroke: ink, grid: { stroke: "#8884", width: 1 }, ticks: { stroke: "#8884" } };
    const chart = new uPlot({
      title, width: Math.max(280, this.chartBox.clientWidth || 800), height: 180,
      cursor: { y: false }, scales: { x: { time: false }, y: { range: (_, low, high) => (low === high ? [low - 1, high + 1] : uPlot.rangeNum(low, high, 0.1, true)) } },
      axes: [{ ...axis, label: "step", labelSize: 16 }, { ...axis, size: words ? 110 : 56, ...(words ? { splits: () => words.map((_, k) => k), values: (_, at) => at.map((k) => words[k] ?? "") } : {}) }],
      series: [{ label: "step" }, ...names.map((label, i) => ({ label, stroke: colour(i), width: 1.2, show: i < shown }))],
    }, data, this.chartBox);
    chart.root.setAttribute("role", "img");
    chart.root.setAttribute("aria-label", `${title} over the steps of the episode: ${names.join(", ")}`);
    chart.over.addEventListener("click", () => {
      if (chart.cursor.idx === null) return;
      this.stop();
      this.showStep(chart.cursor.idx);
    });
    this.charts.push(chart);
  }

  // The programs

  programs() {
    const parts = [element("h3", {}, "The program")];
    const copied = (text) => {
      const button = element("button", { type: "button" }, "Copy");
      button.addEventListener("click", async () => {
        await navigator.clipboard.writeText(text);
        button.textContent = "Copied";
      });
      return button;
    };
    if (this.data.program) parts.push(element("pre", { class: "program", tabindex: 0, "aria-label": "the program" }, this.data.program), copied(this.data.program));
    else parts.push(element("p", {}, `${this.tree.nLeaves.toLocaleString("en")} leaves, too many to read as nested ifs.`));
    for (const [language, text] of Object.entries(this.data.exports)) {
      parts.push(element("details", {}, element("summary", {}, `In ${language}`), element("pre", { class: "program", tabindex: 0, "aria-label": language }, text), copied(text)));
    }
    if (this.data.left_out.length) parts.push(element("p", { class: "quiet" }, `${this.data.left_out.join(", ")}: too long for this page; `, element("code", {}, this.data.export_command), " writes it, with NAME one of c, python, structured_text."));
    if (this.data.proof) parts.push(element("p", { class: "proof" }, this.data.proof));
    const folder = this.data.folder === "." ? "this page's folder" : this.data.folder;
    parts.push(element("p", { class: "quiet" }, "The run's files: ", element("a", { href: this.data.folder }, folder)));
    return parts;
  }

  resize() {
    for (const chart of this.charts) chart.setSize({ width: Math.max(280, this.chartBox.clientWidth), height: 180 });
  }

  close() {
    this.stop();
    for (const chart of this.charts) chart.destroy();
  }
}
