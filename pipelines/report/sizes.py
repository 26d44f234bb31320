"""How large policies are, and what they have cost: numbers, free and written, leaves, and steps of the environment."""

import io
import json
from math import nan, prod
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.engine.store import exists, read_bytes

ACTORS = ("train/actor.safetensors", "imitate/actor.safetensors")
EXPERTS = ("experts", "distilled-experts")  # of which the tree repeats the maps along its paths
GAINS = "pid"  # whose network gives gains, of which the tree is written with other inputs
SIZES = ["free_numbers", "written_numbers", "leaves", "total_steps"]


def with_sizes(runs: pd.DataFrame, results_dir: Path) -> pd.DataFrame:
    """Return runs of tables with SIZES.

    * free_numbers: the parameters of a policy that is a network or experts, else the numbers of the tree itself.
    * written_numbers: those of the pruned tree that are not 0: coefficients and thresholds of tests, maps of leaves.
    * leaves: of the pruned tree, polished where the policy is.
    * total_steps: what the policy has learnt from, as `steps_in_all` counts it.
    """
    rows = [_sizes(run, results_dir) for run in runs.to_dict("records")]
    return runs.assign(**pd.DataFrame(rows, index=runs.index, columns=SIZES).astype(float))


def steps_in_all(run: dict[str, Any]) -> float:
    """Return the steps of the training, the oracle's where there is one, and of the imitation and the polish.

    Those that only chose an iterate of a training, or of a polish by critics, are not counted, as in a summary's
    `total_steps`; of a search and an imitation they are.
    """
    learnt = ["imitate.n_steps"] if run["form"] != "oracle" else []
    if run["form"] == "polished":
        learnt += ["polish.n_steps"] if run.get("polish.by") != "critic" else ["polish.n_refill_steps",
                                                                              "polish.n_learning_steps"]  # fmt: skip
    return float(run["steps"]) + sum(_number(run.get(name), 0.0) for name in learnt)


def _sizes(run: dict[str, Any], results_dir: Path) -> tuple[float, float, float, float]:
    steps = steps_in_all(run)
    if run["form"] not in ("tree", "polished"):  # an oracle, or a soft tree
        return nan, nan, nan, steps
    folder = results_dir / "runs" / run["run"]
    is_polished = run["form"] == "polished"
    leaves = _number(run.get("polish.n_leaves") if is_polished else run["pruned_leaves"], nan)
    actor = next((each for name in ACTORS if exists(each := folder / name)), None)
    weights = _shapes(actor) if actor else []
    written = nan
    for name in (["polish/tree.npz"] if is_polished else []) + ["prune/tree.npz"]:
        if exists(folder / name):
            written, _ = written_numbers(folder / name)
            break
    else:
        if weights:  # kept as its paths alone: a test fewer than leaves, each of them affine
            (n_inputs, n_outputs) = weights[0][-1], weights[-1][0]
            written = (leaves - 1) * (n_inputs + 1) + leaves * n_outputs * (n_inputs + 1)
    method, free = run["method"].removesuffix("-polished"), written
    if method == GAINS:
        free = nan
    elif method in EXPERTS:
        free = _parameters_of_experts(int(run["depth"]), folder / "prune/tree.npz")
    elif actor and not (is_polished and run.get("polish.numbers") == "tree"):
        free = float(sum(map(prod, weights)) + sum(shape[0] for shape in weights))
    return free, written, leaves, steps


def _shapes(actor: Path) -> list[list[int]]:
    """Return the shapes of an actor's weights, layer by layer, from the head of its file; each has as many biases."""
    data = read_bytes(actor)
    head = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    named = {name: entry["shape"] for name, entry in head.items() if name != "__metadata__"}
    return [named[name] for name in sorted(named) if len(named[name]) == 2]


def written_numbers(tree: Path) -> tuple[float, int]:
    """Return how many numbers of a kept tree are not 0, its leaves' labels among them, and how many tests it has."""
    arrays = np.load(io.BytesIO(read_bytes(tree)), allow_pickle=False)
    return float(sum(
        len(arrays[name]) if name == "labels" else np.count_nonzero(arrays[name])
        for name in (["P", "v"] + (["labels"] if "labels" in arrays else ["M", "c"]))
    )), len(arrays["v"])  # fmt: skip


def _parameters_of_experts(n_experts: int, tree: Path) -> float:
    """Return the numbers of the router's and the experts' affine maps; NaN where the tree is not kept."""
    if not exists(tree):
        return nan
    _, n_outputs, n_inputs = np.load(io.BytesIO(read_bytes(tree)), allow_pickle=False)["M"].shape
    return float(n_experts * (n_outputs + 1) * (n_inputs + 1))


def _number(value: Any, otherwise: float) -> float:
    return otherwise if value is None or pd.isna(value) else float(value)
