// Drawings of trees: nodes and links where there are few leaves, an icicle of all leaves by visits where there are many.
"use strict";

const MOST_DRAWN = 40; // leaves drawn as nodes
const BOX = { width: 178, height: 24, gap: 8, step: 226 };
const SVG = "http://www.w3.org/2000/svg";

function svgElement(name, attributes = {}, text = null) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  return element;
}

/** Return the tree as d3 holds hierarchies: {ref, children, share}. */
function hierarchyOf(tree) {
  const of = (ref) =>
    ref < 0 ? { ref, share: tree.shares[~ref] } : { ref, children: [of(tree.left[ref]), of(tree.right[ref])] };
  return d3.hierarchy(of(tree.root)).sum((d) => (d.children ? 0 : d.share));
}

function shortened(text, width) {
  const most = Math.floor(width / 6.6);
  return text.length <= most ? text : `${text.slice(0, most - 1)}…`;
}

function inkOn(colour) {
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
  return 0.299 * r + 0.587 * g + 0.114 * b > 120 ? "#1a1a1a" : "#ffffff";
}

/** Draw a tree into a container and return {show(path), find(test)}; `leafText(leaf)` names what a leaf does. */
function drawTree(container, tree, features, leafText, onLeaf) {
  const root = hierarchyOf(tree);
  const draw = tree.nLeaves <= MOST_DRAWN ? drawNodes : drawIcicle;
  const svg = svgElement("svg", { role: "group", "aria-label": `the tree: ${tree.nLeaves} leaves` });
  const marks = draw(svg, root, tree, features, leafText);
  container.replaceChildren(svg);
  svg.addEventListener("click", (event) => {
    const leaf = event.target.closest("[data-leaf]");
    if (leaf) onLeaf(Number(leaf.dataset.leaf));
  });
  svg.addEventListener("keydown", (event) => {
    const leaf = event.target.closest("[data-leaf]");
    if (leaf && (event.key === "Enter" || event.key === " ")) {
      event.preventDefault();
      onLeaf(Number(leaf.dataset.leaf));
    }
  });
  const marked = (name, refs) => {
    for (const element of svg.querySelectorAll(`.${name}`)) element.classList.remove(name);
    for (const ref of refs) for (const element of marks.get(ref) ?? []) element.classList.add(name);
  };
  return { show: (path) => marked("on", path), find: (refs) => marked("found", refs) };
}

function drawNodes(svg, root, tree, features, leafText) {
  d3.tree().nodeSize([BOX.height + BOX.gap, BOX.step]).separation(() => 1)(root);
  const [low, high] = [Math.min(...root.descendants().map((d) => d.x)), Math.max(...root.descendants().map((d) => d.x))];
  const width = root.height * BOX.step + BOX.width + 8;
  const height = high - low + BOX.height + 12;
  svg.style.cssText = `width: 100%; min-width: ${0.62 * width}px; max-width: ${width}px`;
  svg.setAttribute("viewBox", `-4 ${low - BOX.height / 2 - 6} ${width} ${height}`);
  const marks = new Map();
  const mark = (ref, element) => marks.set(ref, [...(marks.get(ref) ?? []), element]);
  for (const { source, target } of root.links()) {
    const [x0, x1] = [source.y + BOX.width, target.y];
    const link = svgElement("path", {
      class: "link",
      d: `M${x0},${source.x}C${(x0 + x1) / 2},${source.x} ${(x0 + x1) / 2},${target.x} ${x1},${target.x}`,
      "stroke-width": 1 + 9 * target.value,
    });
    svg.append(link);
    mark(target.data.ref, link);
  }
  for (const d of root.descendants()) {
    const isLeaf = d.data.ref < 0;
    const full = isLeaf ? `leaf ${~d.data.ref + 1}: ${leafText(~d.data.ref)}` : testText(tree, d.data.ref, features);
    const short = isLeaf ? full : testText(tree, d.data.ref, features, 2);
    const group = svgElement("g", { class: isLeaf ? "leaf" : "test", transform: `translate(${d.y},${d.x})` });
    const box = { y: -BOX.height / 2, width: BOX.width, height: BOX.height, rx: 4 };
    const label = { x: 7, y: 4 };
    if (isLeaf) {
      const colour = tree.colours[~d.data.ref];
      Object.assign(group.dataset, { leaf: ~d.data.ref });
      group.setAttribute("tabindex", 0);
      group.setAttribute("role", "button");
      group.setAttribute("aria-label", `${full}, ${(100 * d.value).toFixed(1)} % of visited states`);
      box.fill = colour;
      label.style = `fill:${inkOn(colour)}`;
    }
    group.append(svgElement("rect", box), svgElement("text", label, shortened(short, BOX.width - 12)));
    group.append(svgElement("title", {}, `${full}\n${(100 * d.value).toFixed(1)} % of visited states`));
    svg.append(group);
    mark(d.data.ref, group);
  }
  return marks;
}

function drawIcicle(svg, root, tree, features, leafText) {
  const [width, row] = [1000, Math.max(5, Math.min(22, 420 / (root.height + 1)))];
  const height = row * (root.height + 1);
  // Leaves that were never visited keep a sliver of width, so that all can be found.
  root.sum((d) => (d.children ? 0 : d.share + 0.25 / tree.nLeaves));
  d3.partition().size([width, height])(root);
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.setAttribute("width", "100%");
  const marks = new Map();
  for (const d of root.descendants()) {
    const isLeaf = d.data.ref < 0;
    const share = isLeaf ? tree.shares[~d.data.ref] : d.leaves().reduce((sum, leaf) => sum + tree.shares[~leaf.data.ref], 0);
    const cell = svgElement("rect", {
      class: isLeaf ? "cell" : "cell inner", x: d.x0, y: d.y0, width: Math.max(0.3, d.x1 - d.x0),
      height: isLeaf ? height - d.y0 : d.y1 - d.y0,
    });
    if (isLeaf) {
      cell.setAttribute("fill", tree.colours[~d.data.ref]);
      cell.dataset.leaf = ~d.data.ref;
    }
    const text = isLeaf ? `leaf ${~d.data.ref + 1}: ${leafText(~d.data.ref)}` : testText(tree, d.data.ref, features);
    cell.append(svgElement("title", {}, `${text}\n${(100 * share).toFixed(2)} % of visited states`));
    svg.append(cell);
    marks.set(d.data.ref, [cell]);
  }
  return marks;
}
