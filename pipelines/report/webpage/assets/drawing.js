// Drawings of trees: nodes and links where there are few leaves, an icicle of all leaves by visits where there are many.
"use strict";

const MOST_DRAWN = 40; // leaves drawn as nodes
const BOX = { most: 230, line: 15, pad: 7, gap: 9, between: 48 }; // pixels; letters are 12 pixels high
const TERMS = 3; // of a test that a box shows; what opens a box says all of them
const outputsIn = (tree) => (tree.nLeaves > 16 ? 1 : 3); // likewise, of a leaf
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

const measured = document.createElement("canvas").getContext("2d");

/** Return how many pixels a text is wide in a box. */
function widthOf(text) {
  measured.font = "12px system-ui, sans-serif";
  return measured.measureText(text).width;
}

/** Return a text in lines that fit a box, broken at spaces, or within a word that is longer. */
function wrapped(text) {
  const lines = [""];
  for (const part of text.split(/(?<= )/).flatMap((word) => word.match(/.{1,30}/gu) ?? [])) {
    if (lines.at(-1) && widthOf(lines.at(-1) + part.trimEnd()) > BOX.most - 2 * BOX.pad) lines.push("");
    lines[lines.length - 1] += part;
  }
  return lines.map((line) => line.trimEnd());
}

function share(value) { return `${value > 0 && value < 0.0005 ? "< 0.1" : (100 * value).toFixed(1)} % of visited states`; }

/** Return what is in a node's box: its lines, all that they leave out, and its share of visits. */
function boxOf(tree, ref, visits, features, data) {
  const visited = share(visits);
  if (ref >= 0) return { lines: [...testTexts(tree, ref, features, TERMS).flatMap(wrapped), visited], full: testText(tree, ref, features), visited };
  const [texts, name] = [leafTexts(tree, ~ref, features, data, 1), `leaf ${~ref + 1}`];
  const [most, labelled] = [outputsIn(tree), tree.labels !== null];
  const shown = labelled ? [`${name}: ${texts[0]}`] : [name, ...texts.slice(0, most)];
  if (texts.length > most) shown.push(`and ${texts.length - most} more outputs`);
  return { lines: [...shown.flatMap(wrapped), visited], full: `${name}: ${leafText(tree, ~ref, features, data)}`, visited };
}

function inkOn(colour) {
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
  return 0.299 * r + 0.587 * g + 0.114 * b > 120 ? "#1a1a1a" : "#ffffff";
}

/** Draw a tree into a container and return {isDrawn, show(path), find(refs), fit()}; `choose` says all of a box, `goTo` goes to a leaf. */
function drawTree(container, tree, features, data, { goTo, choose }) {
  const root = hierarchyOf(tree);
  const isDrawn = tree.nLeaves <= MOST_DRAWN;
  const svg = svgElement("svg", { role: "group", "aria-label": `the tree: ${tree.nLeaves} leaves` });
  const marks = (isDrawn ? drawNodes : drawIcicle)(svg, root, tree, features, data);
  const hint = element("p", { class: "quiet" });
  container.replaceChildren(svg);
  container.after(hint);
  const open = (target) => {
    const ref = target.closest("[data-ref]")?.dataset.ref;
    if (ref === undefined) return false;
    choose(boxOf(tree, Number(ref), 0, features, data).full);
    if (ref < 0) goTo(~ref);
    return true;
  };
  svg.addEventListener("click", (event) => open(event.target));
  svg.addEventListener("keydown", (event) => {
    if ((event.key === "Enter" || event.key === " ") && open(event.target)) event.preventDefault();
  });
  const marked = (name, refs) => {
    for (const element of svg.querySelectorAll(`.${name}`)) element.classList.remove(name);
    for (const ref of refs) for (const element of marks.get(ref) ?? []) element.classList.add(name);
  };
  const fit = () => {
    const isWide = container.scrollWidth > container.clientWidth + 1 || container.scrollHeight > container.clientHeight + 1;
    const how = isDrawn ? "Up is yes, down is no; a box opens all of its terms." : "A leaf is as wide as it is visited; what is pressed is said here.";
    hint.textContent = tree.nNodes === 0 ? "It tests nothing." : `${how}${isWide ? " The tree is larger than its frame: scroll in it." : ""}`;
  };
  container.scrollTop = (container.scrollHeight - container.clientHeight) / 2; // where the root is, about
  scrollTo(container, marks.get(tree.root)?.[0]);
  fit();
  return { isDrawn, show: (path, follows) => {
    marked("on", path);
    if (follows) scrollTo(container, marks.get(path.at(-1))?.at(-1));
  }, find: (refs) => marked("found", refs), fit };
}

/** Scroll a container, and nothing else, as far as needed for an element in it to be seen. */
function scrollTo(container, target) {
  if (!target) return;
  const [frame, box] = [container.getBoundingClientRect(), target.getBoundingClientRect()];
  const over = (low, high, from, to) => (low < from ? low - from - 12 : high > to ? high - to + 12 : 0);
  container.scrollBy(over(box.left, box.right, frame.left, frame.right), over(box.top, box.bottom, frame.top, frame.bottom));
}

function drawNodes(svg, root, tree, features, data) {
  root.each((d) => (d.box = boxOf(tree, d.data.ref, d.value, features, data)));
  const all = root.descendants();
  const width = Math.max(...all.flatMap(({ box }) => box.lines.map(widthOf))) + 2 * BOX.pad;
  const heightOf = ({ box }) => box.lines.length * BOX.line + BOX.pad;
  d3.tree().nodeSize([1, width + BOX.between]).separation((a, b) => (heightOf(a) + heightOf(b)) / 2 + BOX.gap)(root);
  const low = Math.min(...all.map((d) => d.x - heightOf(d) / 2)) - 4;
  const size = [root.height * (width + BOX.between) + width + 8, Math.max(...all.map((d) => d.x + heightOf(d) / 2)) + 4 - low];
  svg.setAttribute("viewBox", `-4 ${low} ${size[0]} ${size[1]}`);
  svg.setAttribute("width", size[0]);
  svg.setAttribute("height", size[1]);
  const marks = new Map();
  const mark = (ref, element) => marks.set(ref, [...(marks.get(ref) ?? []), element]);
  for (const { source, target } of root.links()) {
    const [x0, x1] = [source.y + width, target.y];
    const link = svgElement("path", {
      class: "link",
      d: `M${x0},${source.x}C${(x0 + x1) / 2},${source.x} ${(x0 + x1) / 2},${target.x} ${x1},${target.x}`,
      "stroke-width": 1 + 9 * target.value,
    });
    const isYes = target === source.children[0];
    svg.append(link, svgElement("text", { class: "edge", x: x1 - 5, y: target.x + (isYes ? -8 : 16), "text-anchor": "end" }, isYes ? "yes" : "no"));
    mark(target.data.ref, link);
  }
  for (const d of all) {
    const [{ ref }, { lines, full, visited }, height] = [d.data, d.box, heightOf(d)];
    const group = svgElement("g", {
      class: ref < 0 ? "leaf" : "test", transform: `translate(${d.y},${d.x - height / 2})`,
      tabindex: 0, role: "button", "aria-label": `${full}, ${visited}`, "data-ref": ref,
    });
    const rect = svgElement("rect", { width, height, rx: 4 });
    group.append(rect, svgElement("title", {}, `${full}\n${visited}`));
    lines.forEach((line, i) => {
      const text = svgElement("text", { x: BOX.pad, y: BOX.line * (i + 1) - 1, class: i === lines.length - 1 ? "visits" : "" }, line);
      if (ref < 0) text.style.fill = inkOn(tree.colours[~ref]);
      group.append(text);
    });
    if (ref < 0) rect.setAttribute("fill", tree.colours[~ref]);
    svg.append(group);
    mark(ref, group);
  }
  return marks;
}

function drawIcicle(svg, root, tree, features, data) {
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
    const visits = isLeaf ? tree.shares[~d.data.ref] : d.leaves().reduce((sum, leaf) => sum + tree.shares[~leaf.data.ref], 0);
    const cell = svgElement("rect", {
      class: isLeaf ? "cell" : "cell inner", x: d.x0, y: d.y0, width: Math.max(0.3, d.x1 - d.x0),
      height: isLeaf ? height - d.y0 : d.y1 - d.y0, "data-ref": d.data.ref,
    });
    if (isLeaf) cell.setAttribute("fill", tree.colours[~d.data.ref]);
    const { full, visited } = boxOf(tree, d.data.ref, visits, features, data);
    cell.append(svgElement("title", {}, `${full}\n${visited}`));
    svg.append(cell);
    marks.set(d.data.ref, [cell]);
  }
  return marks;
}
