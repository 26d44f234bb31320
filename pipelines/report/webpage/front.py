"""The front of the page: tables with the thesis's numbers and ours and intervals drawn, and the data of the figures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from pipelines.errors import MissingInputError
from pipelines.report.cells import METHOD_NAMES, TASK_NAMES
from pipelines.report.figures.learning_curves import STEPS, load_curves

BAR_WIDTH, BAR_HEIGHT = 96, 14
MOST_SHOWN = 12  # policies of a list; a longer one scrolls


def cell_table(caption: str, head: Sequence[str], rows: Mapping[str, pd.DataFrame], policies: Mapping[Any, str]) -> str:
    """Return a table that sorts: a row a task, a cell a method, ours over the thesis's, drawn on the row's own scale.

    Args:
        caption: of the table.
        head: of its columns, the tasks' first.
        rows: by the task's name its cells, as the tables' `make_cells` returns them.
        policies: by a cell's (task, method, depth) the policy of the page that it links to.
    """
    lines = []
    for name, cells in rows.items():
        scale = _scale(cells)
        tds = "".join(_td(cell, scale, policies) for cell in cells.itertuples())
        lines.append(f"<tr><th scope=row>{escape(name)}</th>{tds}</tr>")
    return _table(caption, head, "".join(lines))


def plain_table(caption: str, head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table of texts that sorts."""
    rows = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in line)}</tr>" for line in lines)
    return _table(caption, head, rows)


@dataclass(frozen=True)
class Listed:
    """A policy in the list of a page: its names and data, and its id on that page or the file that shows it."""

    group: str
    name: str
    data: Mapping[str, Any]
    key: str = ""
    file: str = ""
    picture: str = ""  # a file


def policy_table(policies: Sequence[Listed]) -> str:
    """Return the list of policies: a table that sorts, by whose links one is chosen."""
    head, rows = ["Environment", "Policy", "Return", "Leaves", "Numbers", "Proved"], []
    for each in policies:
        verdict = each.data["verdict"]
        value, text = verdict["return"] or ("", "not evaluated")
        link = (
            f'href="{escape(each.file)}" target=_top' if each.file else f'href="#view" data-policy="{escape(each.key)}"'
        )
        shown = f'<img src="{escape(each.picture)}" alt="an episode" loading=lazy><br>' if each.picture else ""
        cells = [(value, text), *((verdict[size], f"{verdict[size]:,}") for size in ("n_leaves", "n_numbers")),
                 (verdict["proved"], verdict["proved"])]  # fmt: skip
        tds = (f'<td data-name={name} data-value="{value}">{text}</td>'
               for name, (value, text) in zip(head[2:], cells, strict=True))  # fmt: skip
        rows.append(
            f"<tr><td data-name={head[0]}>{escape(each.group)}</td>"
            f"<th scope=row><a {link}>{shown}{escape(each.name)}</a></th>{''.join(tds)}</tr>"
        )
    table = _table("Return: mean ± deviation over the evaluation episodes", head, "".join(rows))
    kind = "list long" if len(policies) > MOST_SHOWN else "list"
    return (
        f'<h2>The policies</h2><div class="{kind}" role=region aria-label="list of policies" tabindex=0>{table}</div>'
    )


def _table(caption: str, head: Sequence[str], rows: str) -> str:
    heads = "".join(f"<th scope=col><button type=button>{escape(name)}</button></th>" for name in head)
    return (
        f"<figure class=scroll><table><caption class=quiet>{escape(caption)}</caption><thead><tr>{heads}</tr></thead>"
        f"<tbody>{rows}</tbody></table></figure>"
    )


def figures_data(run_dirs: Sequence[Path], runs: pd.DataFrame) -> dict[str, Any]:
    """Return what the page draws: by figure, by environment, the axes' names and the lines' points."""
    figures: dict[str, Any] = {}
    try:
        curves = load_curves(run_dirs)
        curves = curves[curves["unit"] == STEPS]
        figures["curves"] = {
            TASK_NAMES.get(panel, panel): _lines(
                group, "label", "spent", "mean", STEPS, "return of the policies judged", log=False
            )
            for panel, group in curves.groupby("panel", sort=True)
        }
    except MissingInputError:
        pass
    runs = runs[runs["form"].isin(("tree", "polished"))]
    runs = runs.assign(label=runs["method"].map(METHOD_NAMES) + ", " + runs["budget"], trained=_seconds(runs))
    of_trees, of_policies = ("leaves_pruned", "return_pruned"), ("trained", "return_mean")
    for name, (x, y) in (("leaves", of_trees), ("seconds", of_policies)):
        known = runs[runs[x] > 0]
        of_depth = known.groupby(["task", "label", "depth"], sort=False)[[x, y]].mean().reset_index()
        figures[name] = {
            TASK_NAMES.get(task, task): _lines(group, "label", x, y, name, "return", log=True)
            for task, group in of_depth.groupby("task", sort=False)
        }
    return {name: figure for name, figure in figures.items() if figure}


def _seconds(runs: pd.DataFrame) -> pd.Series:
    """Return the seconds in which each run's policy was made, polishing included where it is the polished one."""
    polishing = runs.get("seconds.polish", 0) * (runs["method"].str.endswith("-polished"))
    stages = [runs[name] for name in ("seconds.train", "seconds.imitate") if name in runs]
    return pd.concat([*stages, polishing.rename("polish")], axis=1).astype(float).sum(axis=1)


def _lines(group: pd.DataFrame, by: str, x: str, y: str, x_name: str, y_name: str, *, log: bool) -> dict[str, Any]:
    series = []
    for label, line in group.groupby(by, sort=True):
        ordered = line.groupby(x)[y].mean().sort_index()
        thinned = ordered.iloc[:: max(1, len(ordered) // 100)]
        series.append({"label": label, "points": [[float(f"{a:.6g}"), float(f"{b:.5g}")] for a, b in thinned.items()]})
    return {"x": x_name, "y": y_name, "log": log, "series": series}


def _scale(cells: pd.DataFrame) -> tuple[float, float]:
    """Return the least and the greatest value that a row draws."""
    spread = cells["std"].fillna(0.0)
    low = [*(cells["mean"] - spread), *cells["ci_low"], *map(_number, cells["published_mean"])]
    high = [*(cells["mean"] + spread), *cells["ci_high"], *map(_number, cells["published_mean"])]
    known = [value for value in (*low, *high) if not math.isnan(value)]
    return (min(known), max(known)) if known and max(known) > min(known) else (0.0, 1.0)


def _td(cell: Any, scale: tuple[float, float], policies: Mapping[Any, str]) -> str:
    ours = escape(cell.ours)
    policy = policies.get((cell.task, cell.method, getattr(cell, "depth", "")))
    if policy:
        ours = f'<a href="#view" data-policy="{escape(policy)}">{ours}</a>'
    runs = f"<span class=note>{escape(cell.runs)}</span>" if getattr(cell, "runs", "") else ""
    thesis = f"<span class=thesis>thesis {escape(str(cell.thesis))}</span>" if str(cell.thesis) != "-" else ""
    value = "" if math.isnan(cell.mean) else f"{cell.mean:.6g}"
    return f'<td data-value="{value}"><span class=ours>{ours}</span>{runs}{thesis}{_bar(cell, scale)}</td>'


def _bar(cell: Any, scale: tuple[float, float]) -> str:
    """Return ours as a dot with its interval (thick) and its deviation (thin), the thesis's as a ring."""
    thesis = _number(cell.published_mean)
    if math.isnan(cell.mean) and math.isnan(thesis):
        return ""
    low, high = scale

    def at(value: float) -> str:
        return f"{4 + (BAR_WIDTH - 8) * (value - low) / (high - low):.1f}"

    def line(start: float, end: float, width: int) -> str:
        y = f'y1="{BAR_HEIGHT / 2}" y2="{BAR_HEIGHT / 2}"'
        return f'<line x1="{at(start)}" x2="{at(end)}" {y} stroke="currentColor" stroke-width="{width}"/>'

    def dot(value: float, look: str) -> str:
        return f'<circle cx="{at(value)}" cy="{BAR_HEIGHT / 2}" r="3" {look}/>'

    marks, shown = [], []
    if not math.isnan(cell.mean):
        shown.append(f"ours {cell.mean:.4g}")
        if not math.isnan(cell.std):
            marks.append(line(cell.mean - cell.std, cell.mean + cell.std, 1))
        if not math.isnan(cell.ci_low):
            marks.append(line(cell.ci_low, cell.ci_high, 4))
            shown.append(f"95 % interval of our mean {cell.ci_low:.4g} to {cell.ci_high:.4g}")
        marks.append(dot(cell.mean, 'fill="currentColor"'))
    if not math.isnan(thesis):
        marks.append(dot(thesis, 'fill="none" stroke="var(--on)" stroke-width="1.5"'))
        shown.append(f"thesis {thesis:.4g}")
    return (
        f'<svg width="{BAR_WIDTH}" height="{BAR_HEIGHT}" role="img" aria-label="{escape("; ".join(shown))}">'
        f"{''.join(marks)}</svg>"
    )


def _number(text: Any) -> float:
    try:
        return float(text)
    except (TypeError, ValueError):
        return math.nan


def name_of_cell(task: str, method: str, depth: str) -> str:
    """Return a cell's name in the list of policies."""
    return f"{TASK_NAMES.get(task, task)}: {METHOD_NAMES.get(method, method)} ({depth})"
