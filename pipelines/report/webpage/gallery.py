"""The gallery: of each environment of the thesis a page of the tree with the shortest program, and their index."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from pipelines.config.run import RunConfig
from pipelines.engine.store import exists, read_json, read_summary
from pipelines.errors import MissingInputError
from pipelines.report.cells import METHOD_NAMES, TASK_NAMES, method_name, run_in_words
from pipelines.report.frames import load_runs
from pipelines.report.sizes import written_numbers
from pipelines.report.webpage.front import policy_table
from pipelines.report.webpage.page import Policies, Shown, policies_of, write_page
from pipelines.report.webpage.policy import MOST_LEAVES, Detail
from pipelines.runs.below_random import random_returns
from pipelines.runs.derived import opened_run
from pipelines.runs.stage_table import stages_of

# So that a page is below 200 kB, of which the scripts are 126.
OF_GALLERY = Detail(16, frame_width=144, export_bytes=12_000, tree_bytes=300_000, n_steps=200, links_run=False)
LEAVES, MOST_NUMBERS = (2, MOST_LEAVES), 4_000  # of a tree that is shown: it tests something, and its program is there
GOOD = 0.95  # of the way from random actions' return to that of the best such tree
N_EPISODES = 10  # around whose states a tree is proved, where the environment has no box
FORMS = {"pruned_tree": "pruned", "polished": "polished", "simplified": "simplified"}
NOT_SHOWN = ("pid", "program")  # leaves that are controllers with a memory; what somebody wrote
RULE = (
    f"Of each environment's trees of at most {MOST_NUMBERS:,} numbers the one with the fewest that reaches "
    f"{100 * GOOD:.0f} % of the way from random actions' return to that of the best of them."
)


def write_gallery(results_dir: Path, folder: Path, load_config: Callable[[Path], RunConfig]) -> Path:
    """Write a page for each environment and their index into a folder, and return the index."""
    chosen = readable_trees(load_runs(results_dir), results_dir)
    if chosen.empty:
        raise MissingInputError(
            f"{results_dir}/runs: no run there has a tree that tests and is short enough to be read"
        )
    listed = []
    for row in chosen.itertuples():
        task, method, run_dir = TASK_NAMES[row.task], METHOD_NAMES[row.method], results_dir / "runs" / row.run
        shown = Shown(f"{method} ({row.depth}), {run_in_words(row.budget, row.seed)}", task, run_dir, FORMS[row.form],
                      _certificate(load_config(run_dir), run_dir))  # fmt: skip
        out = folder / f"{row.task}.html"
        policies = policies_of([shown], OF_GALLERY, out, load_config)
        head = f'<nav><a href="index.html">The gallery</a></nav><p class=quiet>The run {row.run}</p>'
        (policy,) = policies.choices
        title = f"{task}: a tree of {policy.data['verdict']['n_leaves']} leaves"
        write_page(out, title, head, "", policies, {})
        listed.append(replace(policy, file=out.name, picture=_moving(policy.data["episode"], out.with_suffix(".webp"))))
    compared = "Every page compares with the best linear policy and, where there are such, its network and an oracle."
    text = f"<p>{RULE} {compared}</p>"
    return write_page(folder / "index.html", "A readable tree for each environment", text, policy_table(listed),
                      Policies({}, [], []), {})  # fmt: skip


def readable_trees(runs: pd.DataFrame, results_dir: Path) -> pd.DataFrame:
    """Return a row of `load_runs` a task: the tree that RULE names, with its numbers of leaves and numbers."""
    is_one = (runs["env"] == runs["task"]) & runs["form"].isin(FORMS) & ~runs["budget"].str.startswith("smoke")
    own = runs[is_one & ~runs["method"].isin(NOT_SHOWN)]
    own = own.reindex(columns=[*own.columns, *{"polish.n_leaves", "simplify.n_leaves"} - {*own.columns}])
    leaves = own["pruned_leaves"].mask(own["form"] == "polished", own["polish.n_leaves"])
    leaves = leaves.mask(own["form"] == "simplified", own["simplify.n_leaves"])
    own = own.assign(leaves=leaves, method=method_name(own["method"]))[leaves.between(*LEAVES)]
    own = own.assign(numbers=[_n_numbers(results_dir / "runs" / row.run, row.form) for row in own.itertuples()])
    own = own[own["numbers"] <= MOST_NUMBERS]
    random = own["task"].map(random_returns())
    best = own.groupby("task")["return_mean"].transform("max")
    good = own[own["return_mean"] >= random + GOOD * (best - random)]
    best_first = good.sort_values(["numbers", "return_mean"], ascending=[True, False], kind="stable")
    first = best_first.groupby("task").head(1)
    order = [*TASK_NAMES]
    return first.sort_values("task", key=lambda tasks: tasks.map(order.index))


def _n_numbers(folder: Path, form: str) -> float:
    """Return how many numbers and tests a form of a run's tree is written with; NaN where it is kept as its paths."""
    file = folder / {"pruned_tree": "prune", "polished": "polish", "simplified": "simplify"}[form] / "tree.npz"
    return sum(written_numbers(file)) if exists(file) else math.nan


def _certificate(run: RunConfig, folder: Path) -> dict[str, Any] | None:
    """Return the report of stage certify of a network's tree that the run lacks, on the states of fewer episodes."""
    summary = read_summary(folder)
    if "certify" in summary or not run.method.is_mapped:
        return None
    stage = stages_of(run.method.name, polished=bool(summary.get("polish", {}).get("kept")))["certify"]
    quick = replace(run, prune=replace(run.prune, n_episodes=N_EPISODES))
    with opened_run(run, folder, *stage.inputs) as whole, TemporaryDirectory(prefix="otr-") as out:
        stage.run({name: whole / name for name in stage.inputs}, quick, Path(out))
        return dict(read_json(Path(out) / "report.json"))


def _moving(episode: Mapping[str, Any], path: Path) -> str:
    """Write an episode's frames as a moving picture and return its name; none where there are no frames."""
    from PIL import Image

    if "sprite" not in episode:
        return ""
    sheet = Image.open(io.BytesIO(base64.b64decode(episode["sprite"])))
    width, height, columns = (episode[f"frame_{name}"] for name in ("width", "height", "columns"))
    corners = [(i % columns * width, i // columns * height) for i in range(episode["n_frames"])]
    frames = [sheet.crop((x, y, x + width, y + height)) for x, y in corners]
    frame_ms = round(1000 * episode["seconds_a_step"] * episode["frame_stride"])
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=frame_ms, loop=0, quality=40)
    return path.name
