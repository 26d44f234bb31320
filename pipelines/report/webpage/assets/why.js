// Why this action: what each input adds, the nearest state of another answer, and what matters over visited states.
"use strict";

const MOST_ROWS = 8; // of inputs; the others are counted

/** Return a bar from 0 to a value, in a box from -most to most, or from 0 to most. */
function barOf(value, most, signed = true) {
  const [zero, size] = signed ? [50, 50] : [0, 100];
  const width = most ? (size * Math.abs(value)) / most : 0;
  return element("div", { class: "bar", "aria-hidden": "true" }, element("i", { style: `left:${value < 0 ? zero - width : zero}%;width:${width}%` }));
}

function rowOf(...cells) {
  return element("tr", {}, ...cells.map((cell, i) => element(i ? "td" : "th", i ? {} : { scope: "row" }, ...[cell].flat())));
}

/** Return what each input adds to a sum, weights . x + constant, as a part that opens. */
function sumPart({ features, x, sumsBox }, summary, weights, constant, opens) {
  const terms = features.map(({ name }, j) => ({ name, share: weights[j] * x[j], from: `${digits(weights[j])} · ${digits(x[j])}` }))
    .filter(({ share }) => share !== 0).sort((a, b) => Math.abs(b.share) - Math.abs(a.share));
  const others = terms.splice(MOST_ROWS);
  if (others.length) terms.push({ name: `${others.length} more inputs`, share: others.reduce((all, { share }) => all + share, 0), from: "" });
  terms.push({ name: "constant", share: constant, from: "" });
  const most = Math.max(...terms.map(({ share }) => Math.abs(share)));
  const before = sumsBox.querySelectorAll("details").item(opens.number++);
  const rows = terms.map(({ name, share, from }) => rowOf(name, [digits(share), barOf(share, most)], from));
  return element("details", { open: before ? before.open : opens.number <= opens.first }, element("summary", {}, summary), element("table", { class: "why" }, ...rows));
}

/** Return the sums that decide: a leaf's outputs or, where it has a label, the tests of its path. */
function sumParts(view, leaf) {
  const { tree, x, features, data } = view;
  const opens = { number: 0, first: 1 };
  const row = (array, i) => array.subarray(i * x.length, (i + 1) * x.length);
  if (tree.labels) {
    const path = tree.pathTo(leaf);
    return path.slice(0, -1).map((node, i) => sumPart(view, `${testText(tree, node, features, 3)}: ${path[i + 1] === tree.left[node] ? "yes" : "no"}, ${digits(tree.value(node, x))}`, row(tree.P, node), tree.v[node], opens));
  }
  const [y, answer] = [tree.outputs(leaf, x), tree.answer(leaf, x)];
  const becomes = (o) => (answer.length === y.length && answer[o] !== y[o] ? ` → ${digits(answer[o])}` : "");
  return Array.from(y, (sum, o) => sumPart(view, `${data.outputs[o]} = ${digits(sum)}${becomes(o)}`, row(tree.M, leaf * tree.nOutputs + o), tree.c[leaf * tree.nOutputs + o], opens));
}

/** Return the nearest state with another answer in words, with a button that goes there. */
function nearestText(view) {
  const { features, x, data } = view;
  const found = nearestOther(view.tree, x, features);
  const what = Array.isArray(view.answer) ? "of another leaf" : "with another answer";
  if (!found) return [element("p", {}, `Within the ranges there is no state ${what}.`)];
  const shift = features.map(({ low, high }, j) => Math.abs(found.state[j] - x[j]) / (high - low));
  const order = features.map((_, j) => j).filter((j) => shift[j] > 1e-9).sort((a, b) => shift[b] - shift[a]);
  const shown = order.filter((j, i) => i < MOST_ROWS && shift[j] > shift[order[0]] / 100);
  const rows = shown.map((j) => rowOf(view.inputs[j].label.firstChild.textContent, `${digits(x[j])} → ${digits(found.state[j])}`));
  if (shown.length < order.length) rows.push(rowOf(`${order.length - shown.length} more inputs`, "by less"));
  const answers = Array.isArray(found.answer) ? found.answer.map((value, j) => `${data.answers[j]} ${digits(value)}`).join(", ") : data.answers[found.answer];
  const button = element("button", { type: "button" }, "Go there");
  button.addEventListener("click", () => {
    view.x = found.state;
    view.show(found.leaf);
  });
  const text = `The nearest state ${what} is ${Number((100 * found.distance).toPrecision(2))} % of the ranges away. There, leaf ${found.leaf + 1} answers: ${answers}.`;
  return [element("p", {}, text), element("table", { class: "why" }, ...rows), button];
}

/** Show why the policy answers as it does at the view's state; without the nearest state while an episode plays. */
function showWhy(view) {
  const leaf = view.tree.apply(view.x);
  const words = view.tree.labels ? "The tests decide: what each input adds to them, weight times value." : `What each input adds, weight times value. The answer: ${view.data.tree.head.words}.`;
  const parts = [element("p", {}, words), ...sumParts(view, leaf)];
  if (leaf !== view.leaf) parts.push(element("p", { class: "quiet" }, `The state was recorded in leaf ${view.leaf + 1}; rounded to 1/255 of its range, as it is shown, it is in leaf ${leaf + 1}.`));
  view.sumsBox.replaceChildren(...parts);
  if (!view.playing) view.nearestBox.replaceChildren(...nearestText(view));
  view.nearestBox.style.visibility = view.playing ? "hidden" : "";
}

/** Return the inputs' numbers, those that matter most in visited states first. */
function byImportance({ importance, features }) {
  const columns = [...(importance.outputs ?? []), importance.decisions];
  const most = columns.map((column) => Math.max(...column));
  const size = (j) => Math.max(...columns.map((column, c) => (most[c] ? column[j] / most[c] : 0)));
  return features.map((_, j) => j).sort((a, b) => size(b) - size(a));
}

/** Return the table of what matters over visited states. */
function importanceTable(data) {
  const { importance, outputs, features } = data;
  const columns = [...(importance.outputs ?? []), importance.decisions];
  const names = [...(importance.outputs ? outputs : []), "decisions"];
  const most = columns.map((column) => Math.max(...column));
  const order = byImportance(data);
  const rows = order.map((j) => rowOf(features[j].name, ...columns.map((column, c) => [digits(column[j]), barOf(column[j], most[c], false)])));
  const head = element("thead", {}, element("tr", {}, element("td"), ...names.map((name) => element("th", { scope: "col" }, name))));
  const text = `${importance.outputs ? "Of an output: its weight's size times the input's standard deviation, on average over visits. " : ""}Decisions: each test passed counts once, divided among its inputs by their weights' sizes times deviations.`;
  return [element("h3", {}, "What matters in visited states"), element("div", { class: "scroll" }, element("table", { class: "why" }, head, element("tbody", {}, ...rows))), element("p", { class: "quiet" }, text)];
}
