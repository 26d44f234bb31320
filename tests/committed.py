"""The committed runs, which lie packed or in folders."""

import shutil
from pathlib import Path

import otr
from pipelines.cli.runs import load_config
from pipelines.engine.archive import opened
from pipelines.engine.store import CONFIG, exists
from pipelines.runs.derived import opened_run

RESULTS = Path(__file__).parent.parent / "results"


def committed_tree(run: str, stage: str = "prune") -> otr.ObliqueTree:
    """Return the tree of a run's stage; the full tree of a network is not committed."""
    with opened(RESULTS / "runs" / run, [stage]) as whole:
        tree = otr.load(whole / stage / "tree")
    assert isinstance(tree, otr.ObliqueTree)
    return tree


def copy_run(run: str, folder: Path, *without: str) -> None:
    """Copy a run's folder with all files of its stages, but for some stages."""
    place = RESULTS / "runs" / run
    is_oracle = not exists(place / CONFIG)
    with opened(place, ["train"]) if is_oracle else opened_run(load_config(place, None), place) as whole:
        shutil.copytree(whole, folder, ignore=shutil.ignore_patterns(*without))
