// The nearest state of another leaf or label: best first over paths, as in otr/explanation/nearest.py.
"use strict";

const CLEAR = 1e-6; // of the ranges, by which a state is clear of every test on its path
const dot = (a, b) => a.reduce((sum, value, j) => sum + value * b[j], 0);

/** Return u with A u = b, for a small positive definite matrix. */
function solved(A, b) {
  const [n, rows] = [b.length, A.map((row, i) => [...row, b[i]])];
  for (let k = 0; k < n; k++) {
    for (let i = k + 1; i < n; i++) {
      const factor = rows[i][k] / rows[k][k];
      for (let j = k; j <= n; j++) rows[i][j] -= factor * rows[k][j];
    }
  }
  const u = new Array(n);
  for (let k = n - 1; k >= 0; k--) {
    u[k] = rows[k][n];
    for (let j = k + 1; j < n; j++) u[k] -= rows[k][j] * u[j];
    u[k] /= rows[k][k];
  }
  return u;
}

/** Return the shortest z with g . z + h >= 0 for all rows [g, h], or null: by non-negative least squares. */
function shortestMove(rows) {
  const d = rows[0].length - 1;
  const unit = Math.max(...rows.map((row) => -row[d]));
  const columns = rows.map((row) => [...row.slice(0, d), -row[d] / unit]);
  let [held, u] = [[], []];
  const total = (j) => held.reduce((sum, i, k) => sum + u[k] * columns[i][j], 0);
  for (let round = 0; round < 10 * rows.length; round++) {
    const residual = columns[0].map((_, j) => (j === d ? 1 : 0) - total(j));
    const pull = columns.map((column, i) => (held.includes(i) ? 0 : dot(column, residual)));
    const entering = pull.indexOf(Math.max(...pull));
    if (pull[entering] < 1e-10) break;
    [held, u] = [[...held, entering], [...u, 0]];
    for (;;) {
      const s = solved(held.map((i) => held.map((k) => dot(columns[i], columns[k]))), held.map((i) => columns[i][d]));
      const step = Math.min(1, ...s.map((value, k) => (value > 0 ? 1 : u[k] / (u[k] - value))));
      u = u.map((value, k) => value + step * (s[k] - value));
      if (step === 1) break;
      const keep = held.map((_, k) => s[k] > 0 || u[k] > 1e-14);
      [held, u] = [held.filter((_, k) => keep[k]), u.filter((_, k) => keep[k])];
    }
  }
  const left = 1 - total(d);
  const move = Array.from({ length: d }, (_, j) => (unit * total(j)) / left);
  return rows.every((row) => dot(row.slice(0, d), move) + row[d] >= -CLEAR / 2) ? move : null;
}

/** Return the nearest {state, distance, leaf, answer} of another label or, of actions, leaf; null if there is none.
 * Distances are Euclidean, in shares of the ranges, within which a state is. */
function nearestOther(tree, x, features) {
  const scales = features.map(({ low, high }) => high - low);
  const leaf = tree.apply(x);
  const answer = tree.answer(leaf, x);
  if (tree.labels?.every((label) => label === answer)) return null;
  const box = features.flatMap(({ low, high }, j) => [[1, (x[j] - Math.min(low, x[j])) / scales[j]], [-1, (Math.max(high, x[j]) - x[j]) / scales[j]]]
    .map(([sign, h]) => [...scales.map((_, k) => (k === j ? sign : 0)), h]));
  const open = [{ distance: 0, ref: tree.root, rows: box, move: x.map(() => 0) }];
  while (open.length) {
    const at = open.reduce((best, each, i) => (each.distance < open[best].distance ? i : best), 0);
    const [place] = open.splice(at, 1);
    if (!place.move) {
      place.move = shortestMove(place.rows);
      if (place.move) open.push({ ...place, distance: Math.hypot(...place.move) });
    } else if (place.ref >= 0) {
      const weights = scales.map((scale, j) => tree.P[place.ref * x.length + j] * scale);
      const [value, length] = [tree.value(place.ref, x), Math.hypot(...weights)];
      for (const [sign, ref] of [[-1, tree.left[place.ref]], [1, tree.right[place.ref]]]) {
        if (!length) {
          if (value > 0 === sign > 0) open.push({ ...place, ref });
          continue;
        }
        const row = [...weights.map((weight) => (sign * weight) / length), (sign * value) / length - CLEAR];
        const holds = dot(row.slice(0, -1), place.move) + row[x.length] >= 0;
        open.push({ distance: place.distance, ref, rows: [...place.rows, row], move: holds ? place.move : null });
      }
    } else {
      const state = x.map((value, j) => value + scales[j] * place.move[j]);
      const found = { state, distance: place.distance, leaf: tree.apply(state) };
      found.answer = tree.answer(found.leaf, state);
      if (Array.isArray(answer) ? found.leaf !== leaf : found.answer !== answer) return found;
    }
  }
  return null;
}
