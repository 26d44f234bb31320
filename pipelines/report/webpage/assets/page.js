// The page: tables that sort, and the view of the chosen policy.
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
}

otr.ready = start();
