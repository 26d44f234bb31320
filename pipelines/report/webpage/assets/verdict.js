// What is read before the tree is looked at: how good the policy is, and its shortest program.
"use strict";

/** Return the verdict: a sentence, a table of returns, how similarly it acts, and what is proved. */
function verdictParts({ lead, rows, lines, proof, unproved }) {
  const body = rows.map(([name, about, text]) => element("tr", {}, element("th", { scope: "row" }, name, element("span", { class: "note" }, about)), element("td", {}, text)));
  return [
    element("p", { class: "lead" }, lead),
    element("table", { class: "returns" }, element("thead", {}, element("tr", {}, element("td"), element("th", { scope: "col" }, "Return"))), element("tbody", {}, ...body)),
    ...lines.map((line) => element("p", {}, line)),
    element("p", { class: "proof" }, proof || unproved),
  ];
}

/** Return a program whose long lines go on further in than they begin. */
function programBox(label, text) {
  const lines = text.trimEnd().split("\n").map((line) => {
    const indent = line.length - line.trimStart().length + 2;
    return element("span", { style: `padding-left:${indent}ch;text-indent:-${indent}ch` }, line || " ");
  });
  const button = element("button", { type: "button" }, "Copy");
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
  });
  return [element("pre", { class: "program", tabindex: 0, "aria-label": label }, ...lines), button];
}

const SHORT = 40; // lines of a program that is shown at once

/** Return the programs, the shortest first, the others and the exports behind what opens them. */
function programParts(data, nLeaves) {
  const parts = [element("h3", {}, "The program")];
  const folded = (title, text, open = false) => element("details", { open }, element("summary", {}, title), ...programBox(title, text));
  data.texts.forEach(([title, text], i) => parts.push(folded(title, text, i === 0 && text.split("\n").length <= SHORT)));
  if (!data.texts.length) parts.push(element("p", {}, `${nLeaves.toLocaleString("en")} leaves, ${data.verdict.n_numbers.toLocaleString("en")} numbers: too many to read as nested ifs.`));
  for (const [language, text] of Object.entries(data.exports)) parts.push(folded(`The ${data.form} tree in ${language}`, text));
  if (data.left_out.length) parts.push(element("p", { class: "quiet" }, `${data.left_out.join(", ")}: too long for this page; `, element("code", {}, data.export_command), " writes it, with NAME one of c, python, structured_text."));
  const folder = data.folder === "." ? "this page's folder" : data.folder;
  if (folder) parts.push(element("p", { class: "quiet" }, "The run's files: ", element("a", { href: data.folder }, folder)));
  return parts;
}
