// Trees: their numbers, those of the run or these as float32, and what they answer. No drawing here.
"use strict";

const ARRAYS = { f8: Float64Array, f4: Float32Array, i4: Int32Array, u2: Uint16Array, u1: Uint8Array };

/** Return the numbers of an array that was packed as base64 of little-endian bytes. */
function unpacked(packed) {
  const bytes = Uint8Array.from(atob(packed.data), (c) => c.charCodeAt(0));
  return new ARRAYS[packed.dtype](bytes.buffer);
}

/** An oblique tree: node i tests P_i . x + v_i <= 0 and goes left where that holds; a child ~k is leaf k. */
class Tree {
  constructor(data) {
    this.nInputs = data.P.shape[1];
    this.nNodes = data.P.shape[0];
    for (const name of ["left", "right", "P", "v", "shares"]) this[name] = unpacked(data[name]);
    this.isRounded = data.P.dtype === "f4";
    this.nLeaves = this.shares.length;
    this.colours = data.colours;
    this.head = data.head;
    this.labels = data.labels && unpacked(data.labels);
    if (!this.labels) {
      this.nOutputs = data.c.shape[1];
      this.M = unpacked(data.M);
      this.c = unpacked(data.c);
    }
    this.parent = new Map(); // of a reference: the node above it
    for (let i = 0; i < this.nNodes; i++) {
      this.parent.set(this.left[i], i);
      this.parent.set(this.right[i], i);
    }
  }

  /** Return a number of the tree with all digits that it is known to. */
  exact(number) { return String(this.isRounded ? Number(number.toPrecision(7)) : number); }

  get root() { return this.nNodes ? 0 : ~0; }

  value(node, x) {
    let sum = 0;
    for (let j = 0, at = node * this.nInputs; j < this.nInputs; j++) sum += this.P[at + j] * x[j];
    return sum + this.v[node];
  }

  /** Return the leaf of a state. */
  apply(x) {
    let at = this.root;
    while (at >= 0) at = this.value(at, x) <= 0 ? this.left[at] : this.right[at];
    return ~at;
  }

  /** Return the nodes from the root to a leaf, and the reference of the leaf at the end. */
  pathTo(leaf) {
    const path = [~leaf];
    while (this.parent.has(path[0])) path.unshift(this.parent.get(path[0]));
    return path;
  }

  outputs(leaf, x) {
    const y = new Float64Array(this.nOutputs);
    for (let o = 0; o < this.nOutputs; o++) {
      let sum = 0;
      const at = (leaf * this.nOutputs + o) * this.nInputs;
      for (let j = 0; j < this.nInputs; j++) sum += this.M[at + j] * x[j];
      y[o] = sum + this.c[leaf * this.nOutputs + o];
    }
    return y;
  }

  /** Return what a leaf answers at a state: a label, or an array of actions. */
  answer(leaf, x) {
    if (this.labels) return this.labels[leaf];
    return answerOf(this.head, this.outputs(leaf, x));
  }
}

/** Return what a head makes of outputs; the heads are those of otr/core/heads.py. */
function answerOf(head, y) {
  const squashed = (u, j) => {
    const half = (head.high[j] - head.low[j]) / 2;
    return head.low[j] + half + Math.tanh(u) * half;
  };
  switch (head.name) {
    case "identity": return Array.from(y);
    case "exp": return Array.from(y, Math.exp);
    case "clip_box": return Array.from(y, (value, j) => Math.min(Math.max(value, head.low[j]), head.high[j]));
    case "tanh_box": return Array.from(y, squashed);
    case "pid_box": {
      const n = y.length / (head.low.length + 1);
      return head.low.map((_, j) => {
        let u = 0;
        for (let m = 0; m < n; m++) u += y[(j + 1) * n + m] * y[m];
        return squashed(u, j);
      });
    }
    case "sign": return y[0] > 0 ? 1 : 0;
    case "argmax": return y.reduce((best, value, j) => (value > y[best] ? j : best), 0);
    default: throw new Error(`unknown head ${head.name}`);
  }
}

/** Return a number with three significant digits. */
function digits(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e4 || size < 1e-3 ? value.toExponential(1) : String(Number(value.toPrecision(3)));
}

/** Return the terms of a row of weights, the largest over the ranges of its inputs first. */
function termsOf(row, features) {
  return features.map(({ name, low, high }, j) => ({ weight: row[j], name, size: Math.abs(row[j]) * (high - low) }))
    .filter(({ weight }) => weight !== 0).sort((a, b) => b.size - a.size);
}

/** Return a sum in words, a term each: its largest terms, how many more there are, and the constant. */
function sumTexts(row, constant, features, most = Infinity) {
  const terms = termsOf(row, features);
  const signed = (number, text, first) => `${number < 0 ? (first ? "−" : "− ") : first ? "" : "+ "}${text}`;
  const texts = terms.slice(0, most).map(({ weight, name }, i) => signed(weight, Math.abs(weight) === 1 ? name : `${digits(Math.abs(weight))} ${name}`, !i));
  if (terms.length > most) texts.push(`+ ${terms.length - most} more`);
  if (constant !== 0 || !texts.length) texts.push(signed(constant, digits(Math.abs(constant)), !texts.length));
  return texts;
}

/** Return a node's test as a list of terms, the last with the comparison. */
function testTexts(tree, node, features, most = Infinity) {
  const texts = sumTexts(tree.P.subarray(node * tree.nInputs, (node + 1) * tree.nInputs), tree.v[node], features, most);
  return [...texts.slice(0, -1), `${texts.at(-1)} ≤ 0`];
}

/** Return a node's test in words, with its largest terms alone where there are more. */
function testText(tree, node, features, most = Infinity) { return testTexts(tree, node, features, most).join(" "); }

/** Return what a leaf does as a list of texts, one an output: a label, or sums. */
function leafTexts(tree, leaf, features, { answers, outputs }, most = Infinity) {
  if (tree.labels) return [answers[tree.labels[leaf]]];
  return Array.from({ length: tree.nOutputs }, (_, o) => {
    const at = leaf * tree.nOutputs + o;
    return `${outputs[o]} = ${sumTexts(tree.M.subarray(at * tree.nInputs, (at + 1) * tree.nInputs), tree.c[at], features, most).join(" ")}`;
  });
}

/** Return what a leaf does in words. */
function leafText(tree, leaf, features, data) { return leafTexts(tree, leaf, features, data).join("; "); }
