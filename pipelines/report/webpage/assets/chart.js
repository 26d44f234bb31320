// Lines over steps or seconds, at most eight at a time, which differ without colour, too: by dashes and marks.
"use strict";

const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#b0568a", "#b87f00", "#3d8fc0", "#7a7000", "#888888"];
const DASHES = [[], [8, 3], [2, 3], [8, 3, 2, 3], [14, 4], [4, 4], [14, 3, 2, 3, 2, 3], [1, 5]];
const MARKS = ["●", "▲", "■", "◆", "○", "△", "□", "◇"];
const MOST_LINES = MARKS.length;

/** Return tick labels: 12000 as 12K, others with up to six digits. */
function tickTexts(values) {
  const compact = new Intl.NumberFormat("en", { notation: "compact" });
  return values.map((value) => (value === null ? "" : Math.abs(value) >= 1e4 ? compact.format(value) : String(Number(value.toPrecision(6)))));
}

/** Draw each line's mark about every 90 pixels, and at every point where there are few. */
function drawMarks(chart) {
  const { ctx, data, series } = chart;
  ctx.save();
  ctx.font = `${12 * devicePixelRatio}px sans-serif`;
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  series.forEach(({ show, stroke, scale }, i) => {
    if (!i || !show) return;
    ctx.fillStyle = typeof stroke === "function" ? stroke(chart, i) : stroke;
    const known = data[i].map((value, k) => k).filter((k) => data[i][k] !== null && data[i][k] !== undefined);
    let next = known.length > 20 ? chart.bbox.left + i * 11 * devicePixelRatio : -Infinity;
    for (const k of known) {
      const x = chart.valToPos(data[0][k], "x", true);
      if (x < next) continue;
      ctx.fillText(MARKS[(i - 1) % MOST_LINES], x, chart.valToPos(data[i][k], scale ?? "y", true));
      if (known.length > 20) next = x + 90 * devicePixelRatio;
    }
  });
  ctx.restore();
}

/** Add a chart to a place: `lines` are [{label, values, show}] over `at`; with `words` the values are their numbers. */
function addChart(place, { title, x, y, height = 180, log = false, words = null, spans = false }, at, lines) {
  const axis = { stroke: getComputedStyle(document.body).color, grid: { stroke: "#8884", width: 1 }, ticks: { stroke: "#8884" } };
  const stepped = words ? { paths: uPlot.paths.stepped({ align: 1 }) } : {};
  const ticks = words ? { splits: () => words.map((_, k) => k), values: (_, all) => all.map((k) => words[k] ?? "") } : { values: (_, all) => tickTexts(all) };
  const range = (_, low, high) => (words ? [-0.5, words.length - 0.5] : low === high ? [low - 1, high + 1] : uPlot.rangeNum(low, high, 0.1, true));
  const series = lines.map(({ label, show = true }, i) => ({
    label: `${MARKS[i % MOST_LINES]} ${label}`, stroke: COLOURS[i % MOST_LINES], dash: DASHES[i % MOST_LINES], width: 1.4,
    show, spanGaps: spans, points: { show: false }, ...stepped,
    value: (_, value) => (value === null || value === undefined ? "–" : words ? words[value] : digits(value)),
  }));
  const chart = new uPlot({
    title, width: widthIn(place), height: words ? Math.max(height, 70 + 20 * words.length) : height,
    cursor: { y: false }, scales: { x: { time: false, distr: log ? 3 : 1 }, y: { range } },
    axes: [
      { ...axis, label: x, labelSize: 18, space: 64, values: (_, all) => tickTexts(all) },
      { ...axis, ...(y ? { label: y, labelSize: 22, labelGap: 4 } : {}), size: (_, texts) => 20 + 7 * Math.max(3, ...(texts ?? []).map((text) => text.length)), ...ticks },
    ],
    series: [{ label: x }, ...series], hooks: { draw: [drawMarks], setSeries: [hideAlike] },
  }, [at, ...lines.map(({ values }) => values)], place);
  chart.ctx.canvas.setAttribute("role", "img");
  chart.ctx.canvas.setAttribute("aria-label", `${title ?? y}, over ${x}: ${lines.map(({ label }) => label).join("; ")}`);
  for (const label of chart.root.querySelectorAll(".u-legend .u-series:not(:first-child) th")) {
    label.tabIndex = 0;
    label.setAttribute("role", "button");
    label.addEventListener("keydown", (event) => {
      if (event.key === "Enter") label.click();
    });
  }
  return chart;
}

/** Hide the line that looks as one that is shown now. */
function hideAlike(chart, shown, { show }) {
  if (!show || shown === null) return;
  chart.series.forEach((series, i) => {
    if (i && i !== shown && series.show && (i - shown) % MOST_LINES === 0) chart.setSeries(i, { show: false });
  });
}

function widthIn(place) { return Math.min(1200, Math.max(240, place.clientWidth || 800)); }
