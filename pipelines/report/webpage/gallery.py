"""The gallery: of each environment of the thesis a page of the tree that is the easiest to read, and their index."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd

from pipelines.config.run import RunConfig
from pipelines.engine.store import read_json, read_summary
from pipelines.errors import MissingInputError
from pipelines.report.cells import METHOD_NAMES, TASK_NAMES, method_name
from pipelines.report.frames import load_runs
from pipelines.report.webpage.front import policy_table
from pipelines.report.webpage.page import Policies, Shown, policies_of, write_page
from pipelines.report.webpage.policy import Detail
from pipelines.runs.below_random import random_returns
from pipelines.runs.derived import opened_run
from pipelines.runs.stage_table import stages_of

# So that a page is below 200 kB, of which the scripts are 126.
OF_GALLERY = Detail(16, frame_width=144, export_bytes=12_000, tree_bytes=300_000, n_steps=200, links_run=False)
LEAVES = 2, 40  # of a tree that is shown: it tests something, and is drawn as boxes
GOOD = 0.95  # of the way from random actions' return to that of the best tree of so many leaves
N_EPISODES = 10  # around whose states a tree is proved, where the environment has no box
FORMS = {"pruned_tree": "pruned", "polished": "polished", "simplified": "simplified"}
RULE = (
    f"Of each environment the tree with the fewest leaves, {LEAVES[0]} to {LEAVES[1]}, that reaches "
    f"{100 * GOOD:.0f} % of the way from random actions' return to that of the best such tree."
)


def write_gallery(results_dir: Path, folder: Path, load_config: Callable[[Path], RunConfig]) -> Path:
    """Write a page for each environment and their index into a folder, and return the index."""
    chosen = readable_trees(load_runs(results_dir))
    if chosen.empty:
        raise MissingInputError(f"{results_dir}/runs: no run there has a tree of {LEAVES[0]} to {LEAVES[1]} leaves")
    listed = []
    for row in chosen.itertuples():
        task, method, run_dir = TASK_NAMES[row.task], METHOD_NAMES[row.method], results_dir / "runs" / row.run
        shown = Shown(f"{method} ({row.depth}), {row.budget}, seed {row.seed}", task, run_dir, FORMS[row.form],
                      _certificate(load_config(run_dir), run_dir))  # fmt: skip
        out = folder / f"{row.task}.html"
        policies = policies_of([shown], OF_GALLERY, out, load_config)
        head = '<nav><a href="index.html">The gallery</a></nav>'
        (policy,) = policies.choices
        title = f"{task}: a tree of {policy.data['verdict']['n_leaves']} leaves ({row.run})"
        write_page(out, title, head, "", policies, {})
        listed.append(replace(policy, file=out.name, picture=_moving(policy.data["episode"], out.with_suffix(".webp"))))
    text = f"<p>{RULE} Every page compares with a network, an oracle and a linear policy.</p>"
    return write_page(folder / "index.html", "A readable tree for each environment", text, policy_table(listed),
                      Policies({}, [], []), {})  # fmt: skip


def readable_trees(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row of `load_runs` a task: the tree that RULE names, with its number of leaves."""
    is_one = (runs["env"] == runs["task"]) & runs["form"].isin(FORMS) & ~runs["budget"].str.startswith("smoke")
    own = runs[is_one & (runs["method"] != "pid")]  # whose leaves are controllers with a memory
    own = own.reindex(columns=[*own.columns, *{"polish.n_leaves", "simplify.n_leaves"} - {*own.columns}])
    leaves = own["pruned_leaves"].mask(own["form"] == "polished", own["polish.n_leaves"])
    leaves = leaves.mask(own["form"] == "simplified", own["simplify.n_leaves"])
    own = own.assign(leaves=leaves, method=method_name(own["method"]))[leaves.between(*LEAVES)]
    random = own["task"].map(random_returns())
    best = own.groupby("task")["return_mean"].transform("max")
    good = own[own["return_mean"] >= random + GOOD * (best - random)]
    first = good.sort_values(["leaves", "return_mean"], ascending=[True, False], kind="stable").groupby("task").head(1)
    order = [*TASK_NAMES]
    return first.sort_values("task", key=lambda tasks: tasks.map(order.index))


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
