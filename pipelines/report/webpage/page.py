"""The page as one file: its template and scripts, the front of the tables, and the policies, compressed."""

from __future__ import annotations

import base64
import gzip
import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import pandas as pd

import otr
from pipelines.config.run import RunConfig
from pipelines.engine.command_text import command_text
from pipelines.engine.store import read_summary
from pipelines.engine.time_left import progress_lines
from pipelines.errors import MissingInputError, PipelineError
from pipelines.report import table_4_1, table_4_2
from pipelines.report.cells import KEY, SOURCE, TASK_NAMES, oracle_runs, run_in_words, table_runs, with_pruned_trees
from pipelines.report.certificates import certificate_lines
from pipelines.report.frames import load_fits, load_runs
from pipelines.report.text import write_file
from pipelines.report.webpage.front import Listed, cell_table, figures_data, name_of_cell, plain_table, policy_table
from pipelines.report.webpage.policy import Detail, policy_data

VENDOR = ("vendor/d3-hierarchy.min.js", "vendor/uPlot.iife.min.js")
SCRIPTS = (
    *VENDOR, "tree.js", "nearest.js", "drawing.js", "chart.js", "verdict.js", "why.js", "view.js", "page.js",
)  # fmt: skip
STYLES = ("vendor/uPlot.min.css", "page.css")
FORMS = {"tree": "pruned", "polished": "polished"}  # of a policy in the tables: the tree that the page shows
FIGURES = {
    "curves": "Learning curves, of the run nearest to each cell's mean",
    "leaves": "Return of the pruned tree against the number of its leaves, mean over runs",
    "seconds": "Return against seconds of training, an imitator's oracle apart, mean over runs",
}
PARTS = {"table-4-1": "Control", "table-4-2": "Molecules", "proofs": "What is proved", "figures": "Figures"}


OF_ONE = Detail(n_frames=120, frame_width=240, export_bytes=200_000, tree_bytes=None)
# So that a page of all results is below 10 MB: seven of its 147 trees have between 1 and 17 MB of numbers.
OF_MANY = Detail(n_frames=20, frame_width=160, export_bytes=12_000, tree_bytes=300_000)


@dataclass(frozen=True)
class Shown:
    """A policy of a page: what it is called, the run and form whose tree it is, and a proof that the run lacks."""

    name: str
    group: str
    folder: Path
    form: str
    certificate: Mapping[str, Any] | None = None  # the report of stage certify


@dataclass(frozen=True)
class Policies:
    """What a page holds of its policies: by id the compressed data, the list to choose from, and why others lack."""

    blocks: dict[str, str]
    choices: list[Listed]
    left_out: list[str]


def write_run_page(
    folders: Sequence[Path], form: str | None, out: Path, load_config: Callable[[Path], RunConfig]
) -> Path:
    """Write a page of some runs' policies, and return its path.

    Args:
        folders: the runs.
        form: of their trees, as `tree_of` names them; None for the polished one where that gained, else the pruned.
        out: the file.
        load_config: from a run's folder to the configuration that it was made with.
    """
    shown = []
    for folder in folders:
        config = load_config(folder)
        last = "polished" if _is_polished(folder) else "pruned"
        name = f"{config.method.name}, depth {_depth(config)}, seed {config.seed}"
        shown.append(Shown(name, config.env.name, folder, form or last))
    detail = OF_ONE if len(shown) == 1 else OF_MANY
    title = run_title(folders[0]) if len(shown) == 1 else f"{len(shown)} policies"
    return write_page(out, title, "", "", policies_of(shown, detail, out, load_config), {})


def run_title(folder: Path) -> str:
    """Return a page's title: the file that a run's policy was read from and its environment, else the run."""
    summary = read_summary(folder)
    file = Path(str(summary.get("model") or summary.get("program") or "")).name
    return f"{file} in {summary['env']}" if file else "/".join(folder.parts[-5:])


def write_results_page(results_dir: Path, out: Path, load_config: Callable[[Path], RunConfig]) -> Path:
    """Write the page of all finished runs and fits: the tables, the figures, what is proved, and a policy a cell.

    Where no run and no fit is one of those that tables are made of, it is a page of every run's policy.
    """
    runs = load_runs(results_dir)
    if runs.empty:
        command = command_text("otr-run", ["env=pendulum", "depth=6"], results_dir)
        raise MissingInputError(f"{results_dir}/runs: there is no finished run\nRun: {command}")
    own = with_pruned_trees(table_runs(runs), runs)
    cells = table_4_1.make_cells(pd.concat([own, oracle_runs(runs)]))
    shown, of_cells = _a_policy_a_cell(cells, own, results_dir)
    fits = load_fits(results_dir)
    if not shown and fits.empty:
        folders = [results_dir / "runs" / run for run in dict.fromkeys(runs["run"])]
        return write_run_page(folders, None, out, load_config)
    policies = policies_of(shown, OF_MANY, out, load_config)
    tables = [_table_4_1(cells, {cell: key for cell, key in of_cells.items() if key in policies.blocks})]
    if len(fits):
        tables.append(_table_4_2(fits))
    if lines := certificate_lines(runs):
        tables.append(
            '<h2 id="proofs">What is proved</h2>'
            "<p>A certificate says that a tree computes its network's function at every real point of a domain; "
            "<code>otr-verify run=...</code> checks it again in rational arithmetic.</p>"
            + plain_table("Certificates", lines[0], lines[1:])
        )
    figures = figures_data([each.folder for each in shown], own)
    drawn = "".join(
        f'<h3>{escape(title)}</h3><div id="figure-{name}"></div>' for name, title in FIGURES.items() if name in figures
    )
    front = "\n".join([*tables, f'<h2 id="figures">Figures</h2>{drawn}' if drawn else ""])
    links = "".join(f'<a href="#{key}">{name}</a>' for key, name in PARTS.items() if f'id="{key}"' in front)
    head = (
        "<p>Neural policies as oblique decision trees, with the published numbers of the thesis that otr implements "
        "(Orfanos 2023). Every number is read from the runs next to this page; what was not run says so.</p>"
        f'<nav>{links}<a href="#policies">Policies</a></nav>'
    )
    return write_page(out, "otr: policies as programs", head, front, policies, figures)


def _a_policy_a_cell(cells: pd.DataFrame, runs: pd.DataFrame, results_dir: Path) -> tuple[list[Shown], dict[Any, str]]:
    """Return the run nearest to each cell's mean, and by a cell's key its id; several cells may have one policy."""
    shown, ids, policies = list[Shown](), dict[tuple[Path, str], str](), dict[Any, str]()
    for cell in cells[(cells["n_runs"] > 0) & (cells["table"] != "other")].itertuples():
        at = pd.Series(True, runs.index)
        for name in (*KEY, *SOURCE):
            at &= runs[name] == getattr(cell, name)
        of_cell = runs[at & runs["form"].isin(FORMS)]
        if of_cell.empty:
            continue
        nearest = of_cell.loc[(of_cell["return_mean"] - cell.mean).abs().idxmin()]
        folder, form = results_dir / "runs" / nearest["run"], FORMS[nearest["form"]]
        if form == "polished" and not _is_polished(folder):
            form = "pruned"  # the same tree
        key = policies[cell.task, cell.method, cell.depth] = ids.setdefault((folder, form), f"policy-{len(shown)}")
        if key != f"policy-{len(shown)}":
            continue
        name = name_of_cell(cell.task, cell.method, cell.depth).partition(": ")[2]
        shown.append(
            Shown(
                f"{name}, {run_in_words(nearest['budget'], nearest['seed'])}",
                TASK_NAMES.get(cell.task, cell.task),
                folder,
                form,
            )
        )
    return shown, policies


def _table_4_1(cells: pd.DataFrame, policies: dict[Any, str]) -> str:
    head = ["Task", *table_4_1.HEAD[2:]]
    table = cells[cells["table"] == "4.1"]
    rows = {TASK_NAMES[task]: row for task, row in table.groupby("task", sort=False)}
    text = cells[(cells["table"] == "text") & (cells["n_runs"] > 0)]
    lines = [[TASK_NAMES.get(cell.task, cell.task), cell.method, cell.depth, cell.ours, cell.runs, str(cell.thesis)]
             for cell in text.itertuples()]  # fmt: skip
    return (
        '<h2 id="table-4-1">Control: return of tree policies</h2>'
        "<p>Mean and standard deviation over runs of each run's mean return; a cell never mixes budgets. A number "
        "opens its policy below. Dot: ours, thick line: 95 % interval of the mean (from five runs on), thin line: "
        "standard deviation, ring: the thesis. Each row has its own scale.</p>"
        + cell_table("Table 4.1", head, rows, policies)
        + "<details><summary>Beyond the table</summary>"
        + plain_table("", ["Task", "Method", "Depth", "Ours", "Runs", "Thesis"], lines)
        + "</details>"
    )


def _table_4_2(fits: pd.DataFrame) -> str:
    cells = table_4_2.make_cells(fits)
    table = cells[cells["table"] == "4.2"]
    data = [name for name in table_4_2.DATA if (table[table["task"] == name]["n_runs"] > 0).any()]
    rows = {
        table_4_2.LEARNERS[method]: row[row["task"].isin(data)] for method, row in table.groupby("method", sort=False)
    }
    return (
        '<h2 id="table-4-2">Molecules: AUC of trees on the test part</h2>'
        "<p>Mean and standard deviation over seeds. Linear is the tree of depth 0, which has one leaf.</p>"
        + cell_table("Table 4.2", ["Method", *(table_4_2.DATA[name] for name in data)], rows, {})
    )


def policies_of(
    shown: Sequence[Shown], detail: Detail, out: Path, load_config: Callable[[Path], RunConfig]
) -> Policies:
    """Return the policies of a page; one that cannot be shown is left out, and the page and the terminal say why."""
    policies = Policies({}, [], [])
    n_so_named = Counter((each.group, each.name) for each in shown)
    progress = progress_lines("page", "policies")
    for i, each in enumerate(shown):
        try:
            data = policy_data(load_config(each.folder), each.folder, each.form, detail, each.certificate)
        except PipelineError as error:
            policies.left_out.append(f"{each.group}, {each.name}: {error}")
            continue
        folder = (
            Path(os.path.relpath(each.folder.absolute(), out.absolute().parent)).as_posix() if detail.links_run else ""
        )
        digest = "".join(each.folder.name.partition("~")[1:])  # of the settings in which it is not as the others
        name = f"{each.name} {digest}".strip() if n_so_named[each.group, each.name] > 1 else each.name
        data |= {"about": f"{each.group}, {name}, {each.form} tree", "folder": folder}
        policies.blocks[f"policy-{i}"] = _stored(f"policy-{i}", data, "policy")
        policies.choices.append(Listed(each.group, name, data, key=f"policy-{i}"))
        progress(i + 1, len(shown))
    if not policies.blocks:
        raise PipelineError("\n".join(policies.left_out))
    for line in policies.left_out:
        print(f"left out: {line}")
    return policies


def write_page(out: Path, title: str, head: str, front: str, policies: Policies, figures: dict[str, Any]) -> Path:
    blocks = [*policies.blocks.values(), *([_stored("figures-data", figures, "figures")] if figures else [])]
    left_out = ""
    if policies.left_out:
        lines = "".join(f"<li>{escape(line)}</li>" for line in policies.left_out)
        summary = f"<summary>Left out: {len(policies.left_out)}</summary>"
        left_out = f"<details class=quiet>{summary}<ul>{lines}</ul></details>"
    choice = policy_table(policies.choices) if len(policies.choices) > 1 else ""
    parts = {
        "title": escape(title), "head": head, "front": front,
        "choice": choice, "left_out": left_out, "foot": f"Written by otr {otr.__version__}.",
        "style": _assets(STYLES), "script": _assets(SCRIPTS), "data": "\n".join(blocks),
    }  # fmt: skip
    template = (resources.files("pipelines.report.webpage") / "assets" / "page.html").read_text(encoding="utf-8")
    return write_file(out, Template(template).substitute(parts))


def _stored(key: str, data: Any, kind: str) -> str:
    """Return JSON-able data compressed in a script element that no browser runs."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    packed = base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")
    return f'<script type="text/plain" class="{kind}" id="{key}">{packed}</script>'


def _assets(names: Sequence[str]) -> str:
    folder = resources.files("pipelines.report.webpage") / "assets"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)


def _depth(config: RunConfig) -> str:
    return ", ".join(map(str, config.hidden_widths)) or "0"


def _is_polished(folder: Path) -> bool:
    return bool(read_summary(folder).get("polish", {}).get("kept"))
