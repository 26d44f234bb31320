"""Play a finished run's evaluation episodes again from its stored policies and compare them with what was recorded."""

from pathlib import Path

import numpy as np

from pipelines.config.run import RunConfig
from pipelines.engine.archive import is_whole
from pipelines.engine.store import exists, read_csv
from pipelines.play.episodes import play_each
from pipelines.runs.derived import opened_run
from pipelines.stages.evaluate import EVALUATE, episodes_file, load_policies
from pipelines.stages.polish import load_searched

TOLERANCE = 1e-6  # of the return, relative


def replay(config: RunConfig, run_dir: Path) -> int:
    """Print one line a policy form and return how many of a run's episodes came out differently.

    The polished form, where there is one, is the last. Other versions of the simulators give other episodes; on the
    recorded versions all of them are reproduced.
    """
    has_tree = is_whole(run_dir / config.method.tree_stage)
    if not has_tree:
        print(f"{run_dir}: tree: not played again, as the archive has the pruned one alone", flush=True)
    with opened_run(config, run_dir) as whole:
        inputs = {name: whole / name for name in config.method.stages}
        policies = load_policies(inputs, EVALUATE.of(config), tree=has_tree)
        recorded_in = {name: run_dir / "evaluate" / episodes_file(name) for name in policies}
        if exists(run_dir / "polish" / "episodes.csv"):
            policies["polished"] = load_searched(whole / "polish")
            recorded_in["polished"] = run_dir / "polish" / "episodes.csv"
    played = play_each(policies, EVALUATE.of(config))
    n_different = 0
    for name in played:
        recorded = np.array([float(row["return"]) for row in read_csv(recorded_in[name])])
        again = played[name].returns
        different = np.flatnonzero(np.abs(again - recorded) > TOLERANCE * np.maximum(1.0, np.abs(recorded)))
        n_different += len(different)
        verdict = f"{len(different)} differ, the first is episode {different[0]}" if len(different) else "as recorded"
        print(f"{run_dir}: {name.replace('_', ' ')}: {len(again):,} episodes played again, {verdict}", flush=True)
    return n_different
