// The page: tables that sort, figures, and the view of the chosen policy.
"use strict";

/** Return the JSON of a script element that holds it compressed (gzip, base64). */
async function stored(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return JSON.parse(await new Response(stream).text());
}

const otr = { view: null, ready: null }; // what is shown, for who asks from outside

async function showPolicy(id) {
  const container = document.getElementById("view");
  container.setAttribute("aria-busy", "true");
  const data = await stored(id);
  otr.view?.close();
  otr.view = new PolicyView(container, data);
  container.removeAttribute("aria-busy");
  for (const link of document.querySelectorAll(".list a[data-policy]")) {
    if (link.dataset.policy === id) link.setAttribute("aria-current", "true");
    else link.removeAttribute("aria-current");
  }
}

function sortBy(header) {
  const [row, table] = [header.parentElement, header.closest("table")];
  const column = [...row.children].indexOf(header);
  const descending = header.getAttribute("aria-sort") === "ascending";
  for (const other of row.children) other.removeAttribute("aria-sort");
  header.setAttribute("aria-sort", descending ? "descending" : "ascending");
  const key = (line) => line.children[column]?.dataset.value ?? line.children[column]?.textContent ?? "";
  const sign = descending ? -1 : 1;
  const compared = (a, b) => {
    const [one, two] = [key(a), key(b)];
    if (one === "" || two === "") return (one === "") - (two === ""); // what was not run comes last
    return sign * (Number(one) - Number(two) || one.localeCompare(two));
  };
  const body = table.tBodies[0];
  body.append(...[...body.rows].sort(compared));
}

/** Show one environment's lines of a figure: the eight that rise highest at once, any others from the legend. */
function lines(container, figures) {
  const names = Object.keys(figures);
  const size = (name) => figures[name].series.reduce((sum, { points }) => sum + Math.min(points.length, 20), 0);
  const first = names.reduce((best, name) => (size(name) > size(best) ? name : best)); // there is most to see
  const options = names.map((name) => element("option", { selected: name === first }, name));
  const select = element("select", { "aria-label": "environment" }, ...options);
  const [place, note] = [element("div"), element("p", { class: "quiet" })];
  const draw = () => {
    const { x, y, series, log } = figures[select.value];
    const top = ({ points }) => Math.max(...points.map(([, value]) => value));
    const sorted = [...series].sort((a, b) => top(b) - top(a));
    const [at, ...values] = uPlot.join(sorted.map(({ points }) => [points.map(([where]) => where), points.map(([, value]) => value)]));
    place.replaceChildren();
    addChart(place, { x, y, log, height: 300, spans: true }, at, sorted.map(({ label }, i) => ({ label, values: values[i], show: i < MOST_LINES })));
    note.textContent = series.length > MOST_LINES ? `Of ${series.length} lines the eight that rise highest are drawn; a click on another in the legend shows it in the place of one.` : "";
  };
  select.addEventListener("change", draw);
  container.replaceChildren(select, place, note);
  draw();
}

async function start() {
  for (const button of document.querySelectorAll("th button")) button.addEventListener("click", () => sortBy(button.parentElement));
  for (const link of document.querySelectorAll("a[data-policy]")) {
    link.addEventListener("click", () => (otr.ready = showPolicy(link.dataset.policy)));
  }
  window.addEventListener("resize", () => otr.view?.resize());
  const first = document.querySelector("script.policy")?.id;
  if (first) await showPolicy(first);
  if (document.getElementById("figures-data")) {
    const figures = await stored("figures-data");
    for (const [name, of] of Object.entries(figures)) lines(document.getElementById(`figure-${name}`), of);
  }
}

otr.ready = start();
