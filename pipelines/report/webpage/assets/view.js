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
    this.treeBox = element("div", { class: "tree", tabindex: 0, role: "region", "aria-label": "the tree" });
    this.chosenBox = element("p", { class: "quiet", "aria-live": "polite" });
    [this.sumsBox, this.nearestBox] = [element("div"), element("div")];
    const part = (label, title, ...parts) => element("section", { class: "panel wide", "aria-label": label }, ...(title ? [element("h3", {}, title)] : []), ...parts);
    const rounded = [" The tree's numbers are rounded to seven digits: in visited states it takes the same leaves, and actions differ by less than 1/10,000 of the largest. ",
      element("code", {}, data.page_command), " writes a page with all digits."];
    const state = element("section", { class: "panel", "aria-label": "state" }, element("h3", {}, "The state, and what the policy does"), this.actionBox, this.sliders(),
      element("p", { class: "quiet" }, "Ranges are the environment's, or a tenth beyond what was visited where it has none.", ...(this.tree.isRounded ? rounded : [])));
    const tree = element("section", { class: "panel", "aria-label": "tree" }, element("h3", {}, "The tree"), this.search(), this.treeBox, this.chosenBox,
      element("h3", {}, "The path of this state"), this.pathList);
    container.replaceChildren(element("p", { class: "quiet" }, data.about), element("div", { class: "view" },
      part("verdict", "", ...verdictParts(data.verdict)),
      part("programs", "", ...programParts(data, this.tree.nLeaves)), state, tree,
      part("why this action", "Why this action", element("div", { class: "halves" }, this.sumsBox, this.nearestBox)),
      part("what matters", "", ...importanceTable(data)),
      part("episode", "A recorded episode", ...this.player())));
    this.drawing = drawTree(this.treeBox, this.tree, this.features, data, {
      goTo: (leaf) => this.goTo(leaf),
      choose: (text) => (this.chosenBox.textContent = text),
    });
    this.drawCharts();
    this.showStep(0);
    this.isWhole = true;
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
    this.drawing.show(path, this.isWhole);
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
      const row = termsOf(this.tree.P.subarray(node * this.x.length, (node + 1) * this.x.length), this.features)
        .map(({ weight, name }) => `${this.tree.exact(weight)} ${name}`).concat(this.tree.exact(this.tree.v[node])).join("\n+ ");
      const details = element("details", { "data-node": node, open: open.has(String(node)) }, summary, element("pre", {}, `${row} ≤ 0`));
      return element("li", {}, details);
    }));
  }

  /** Go to a recorded state of a leaf, where there is one. */
  goTo(leaf) {
    const step = this.episode.leaves.indexOf(leaf);
    this.stop();
    if (step >= 0) this.showStep(step);
    else this.drawing.show(this.tree.pathTo(leaf), true);
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
        for (let k = 0; k < this.tree.nLeaves; k++) if (leafText(this.tree, k, this.features, this.data).toLowerCase().includes(word)) refs.push(~k);
      }
      this.drawing.find(refs);
      found.textContent = word ? ` ${refs.length} found` : "";
    });
    const whole = element("button", { type: "button", "aria-pressed": "false" }, "The whole tree");
    whole.addEventListener("click", () => {
      whole.setAttribute("aria-pressed", this.treeBox.classList.toggle("whole"));
      this.drawing.fit();
    });
    return element("p", {}, box, " ", whole, found);
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

  /** Draw the actions, and of the inputs the eight that matter most, the first four at once. */
  drawCharts() {
    const at = Array.from({ length: this.episode.length }, (_, t) => t * this.episode.stride);
    const labels = this.episode.nActions === 1 && (this.tree.labels || !this.data.limits);
    const actions = (labels ? ["action"] : this.data.answers).map((label, j) => ({ label, values: at.map((_, t) => this.episode.answers[t * this.episode.nActions + j]) }));
    const inputs = byImportance(this.data).slice(0, MOST_LINES).map((j, i) => ({
      label: this.features[j].unit ? `${this.features[j].name} (${this.features[j].unit})` : this.features[j].name,
      values: this.episode.states.map((x) => x[j]), show: i < 4,
    }));
    this.chart("actions", actions.slice(0, MOST_LINES), labels ? this.data.answers : null);
    this.chart(this.features.length > MOST_LINES ? "the eight states that matter most" : "states", inputs, null);
  }

  chart(title, lines, words) {
    const chart = addChart(this.chartBox, { title, x: "step", words }, Array.from({ length: this.episode.length }, (_, t) => t * this.episode.stride), lines);
    chart.over.addEventListener("click", () => {
      if (chart.cursor.idx === null) return;
      this.stop();
      this.showStep(chart.cursor.idx);
    });
    this.charts.push(chart);
  }

  resize() {
    for (const chart of this.charts) chart.setSize({ width: widthIn(this.chartBox), height: chart.height });
    this.drawing.fit();
  }

  close() {
    this.stop();
    for (const chart of this.charts) chart.destroy();
  }
}
