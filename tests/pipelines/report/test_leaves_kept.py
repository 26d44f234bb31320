"""The figure of the return against the leaves kept: which runs it shows, what their mean is, and what is missing."""

import re
from pathlib import Path

import pandas as pd
import pytest

from pipelines.engine.store import write_csv, write_json
from pipelines.errors import MissingInputError, PipelineError
from pipelines.report.figures.leaves_kept import load_leaves, mean_return, return_against_leaves
from pipelines.stages.leaves import COLUMNS

SMALL, LARGE = "pendulum/otr/depth-6/quick/seed-0", "pendulum/otr/depth-32/quick/seed-0~0a1b2c3d"


def leave(run_dir: Path, *returns: tuple[int, float]) -> None:
    (run_dir / "leaves").mkdir(parents=True)
    write_csv(run_dir / "leaves/returns.csv", [dict(zip(COLUMNS, (k, 1.0, mean, 0.5, 7), strict=True))
                                               for k, mean in returns], COLUMNS)  # fmt: skip
    write_json(run_dir / "leaves/report.json", {"n_reached": returns[-1][0]})
    (run_dir / "config.yaml").write_text("env: {}\n")


def test_several_runs_have_a_mean_and_the_legend_has_the_whole_return(tmp_path: Path) -> None:
    few, many = pd.Series({1: 0.0, 2: 4.0, 3: 6.0}), pd.Series({1: 2.0, 2: 4.0, 4: 8.0, 5: 10.0})
    assert mean_return([few, many]).to_dict() == {1: 1.0, 2: 4.0, 4: 7.0, 5: 8.0}  # a run keeps its last return
    runs = [tmp_path / f"pendulum/otr/depth-6/quick/seed-{seed}" for seed in (0, 1)]
    leave(runs[0], (1, -9.0), (2, -4.0), (3, -2.0))
    leave(runs[1], (1, -7.0), (2, -3.0))
    figure = return_against_leaves(load_leaves(runs))
    mean = figure.axes[0].lines[-1]
    assert (mean.get_xdata().tolist(), mean.get_ydata().tolist()) == ([1, 2, 3], [-8, -3.5, -2.5])
    (label,) = [text.get_text() for text in figure.legends[0].get_texts()]
    assert label == "otr, depth 6, quick: -2.5 with all 2 to 3 leaves (marker)"
    assert figure.get_suptitle() == "mean over 7 episodes; 2 runs, thick: their mean"


def test_other_settings_and_a_polished_tree_have_labels_of_their_own(tmp_path: Path) -> None:
    seeds = ("0", "1", "0~0a1b2c3d")
    plain, polished, changed = (tmp_path / f"pendulum/otr/depth-6/quick/seed-{seed}" for seed in seeds)
    for run in (plain, polished, changed):
        leave(run, (1, -9.0))
    write_json(polished / "leaves/report.json", {"n_reached": 1, "policy": "polished"})
    write_json(changed / "summary.json", {"changes": "algo.gamma=0.5, oracle=[8, 8]"})
    labels = load_leaves([plain, polished, changed])["label"].tolist()
    usual = "otr, depth 6, quick"
    assert labels == [usual, f"{usual}, polished", f"{usual}, algo.gamma=0.5, oracle=[8, 8]"]


def test_a_run_that_was_not_measured_names_the_command(tmp_path: Path) -> None:
    command = f"Run: otr-run env=pendulum depth=6 budget=quick seed=0 results_dir={tmp_path} leaves=true"
    with pytest.raises(MissingInputError, match=re.escape(command)):
        load_leaves([tmp_path / "runs" / SMALL])
    leave(tmp_path / SMALL, (1, -9.0), (2, -4.0))
    path = tmp_path / SMALL / "leaves/returns.csv"
    path.write_text(path.read_text()[:-8])
    with pytest.raises(PipelineError, match=f"{re.escape(str(path))} cannot be read: its row"):
        load_leaves([tmp_path / SMALL])


def test_the_command_takes_several_runs_and_writes_the_numbers(command, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    leave(tmp_path / "runs" / SMALL, (1, -9.0), (2, -4.0))
    leave(tmp_path / "runs" / LARGE, (1, -9.0), (2, -8.0), (4, -1.0))
    there = f"results_dir={tmp_path}"
    for words in ([f"run={SMALL}", f"run={LARGE}"], [f"run=[{SMALL},{LARGE}]"], ["run=pendulum"]):
        done = command("tabulate", "leaves", *words, there, f"out={tmp_path / 'a.svg'}")
        assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'a.svg'}\n{tmp_path / 'a.csv'}\n"), done.stderr
        written = pd.read_csv(tmp_path / "a.csv")
        assert written.groupby("label")["n_leaves"].max().to_dict() == {
            "otr, depth 6, quick": 2, "otr, depth 32, quick, settings 0a1b2c3d": 4,
        }  # fmt: skip
    done = command("tabulate", "leaves", f"run={SMALL}", f"run={LARGE}", there)
    assert done.stdout.split() == [f"{tmp_path}/figures/leaves-pendulum-otr.{kind}" for kind in ("png", "csv")]
    refused = command("tabulate", "regions", f"run={SMALL}", f"run={LARGE}", there)
    assert refused.returncode == 2 and "figure=regions is of one run" in refused.stderr
