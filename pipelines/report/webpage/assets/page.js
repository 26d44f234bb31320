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

function lines(container, figures) {
  const names = Object.keys(figures);
  const size = (name) => figures[name].series.reduce((sum, { points }) => sum + Math.min(points.length, 20), 0);
  const first = names.reduce((best, name) => (size(name) > size(best) ? name : best)); // there is most to see
  const options = names.map((name) => element("option", { selected: name === first }, name));
  const select = element("select", { "aria-label": "environment" }, ...options);
  const place = element("div");
  let chart = null;
  const ink = getComputedStyle(document.body).color;
  const draw = () => {
    chart?.destroy();
    const { x, y, series, log } = figures[select.value];
    const colour = (i) => ["#0072b2", "#d55e00", "#009e73", "#b0568a", "#b87f00", "#3d8fc0", "#7a7000", "#888888"][i % 8];
    const data = uPlot.join(series.map(({ points }) => [points.map(([at]) => at), points.map(([, value]) => value)]));
    const axis = { stroke: ink, grid: { stroke: "#8884", width: 1 }, ticks: { stroke: "#8884" } };
    chart = new uPlot({
      width: Math.min(900, Math.max(280, container.clientWidth)), height: 280,
      scales: { x: { time: false, distr: log ? 3 : 1 } },
      axes: [{ ...axis, label: x }, { ...axis, label: y, size: 70 }],
      series: [{ label: x }, ...series.map(({ label, points }, i) => ({ label, stroke: colour(i), width: 1.5, dash: i < 8 ? [] : [5, 3], spanGaps: true, points: { show: points.length < 20, size: 6 } }))],
    }, data, place);
    chart.root.setAttribute("role", "img");
    chart.root.setAttribute("aria-label", `${select.value}: ${y} against ${x} of ${series.map(({ label }) => label).join("; ")}`);
  };
  select.addEventListener("change", draw);
  container.replaceChildren(select, place);
  draw();
}

async function start() {
  for (const button of document.querySelectorAll("th button")) button.addEventListener("click", () => sortBy(button.parentElement));
  const choice = document.getElementById("choice");
  for (const link of document.querySelectorAll("a[data-policy]")) {
    link.addEventListener("click", () => {
      choice.value = link.dataset.policy;
      otr.ready = showPolicy(choice.value);
    });
  }
  choice?.addEventListener("change", () => (otr.ready = showPolicy(choice.value)));
  window.addEventListener("resize", () => otr.view?.resize());
  const first = choice?.value ?? document.querySelector("script.policy")?.id;
  if (first) await showPolicy(first);
  if (document.getElementById("figures-data")) {
    const figures = await stored("figures-data");
    for (const [name, of] of Object.entries(figures)) lines(document.getElementById(`figure-${name}`), of);
  }
}

otr.ready = start();
