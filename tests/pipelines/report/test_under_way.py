"""Learning curves of runs under way: every trainer's and imitation's are on disk, which drawing leaves alone."""

import json
from pathlib import Path

import pandas as pd
import pytest

from pipelines.cli.runs import load_config
from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.report.figures.learning_curves import FINISHED, STEPS, learning_curves, load_curves
from pipelines.training import checkpoints
from pipelines.training.checkpoints import History, evaluations_so_far

SHORT = ("train.steps=60", "train.eval_interval_steps=20")  # too short to learn anything
OF_SEARCH = ("algo=ars", "algo.n_directions=2", "algo.n_top=1", "algo.n_episodes=1")
SEARCH = (*OF_SEARCH, "train.steps=8000", "train.eval_interval_steps=2000")


def files(folder: Path) -> dict[Path, tuple[int, bytes]]:
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("words", [SHORT, ("trainer=fleet", *SHORT), SEARCH], ids=["sb3", "fleet", "ars"])
def test_a_training_that_was_stopped_is_drawn_as_far_as_it_came(  # type: ignore[no-untyped-def]
    command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words
) -> None:
    segment_done = History.segment_done

    def two_alone(self: History, *rows: object) -> None:
        if self.n_segments == 2:
            raise PipelineError("stopped")
        segment_done(self, *rows)  # type: ignore[arg-type]

    monkeypatch.setattr(History, "segment_done", two_alone)
    run = ("run", "env=pendulum", "depth=2", "budget=smoke", "stages=[train]", "n_workers=1", *words,
           f"results_dir={tmp_path}")  # fmt: skip
    assert command(*run).returncode == 1
    before = files(tmp_path)
    drawn = command("tabulate", "curves", "run=pendulum", f"results_dir={tmp_path}", f"out={tmp_path / 'a.svg'}")
    assert drawn.returncode == 0, drawn.stderr
    assert {path: found for path, found in files(tmp_path).items() if path.name != "a.svg"} == before

    (run_dir,) = (path.parent for path in tmp_path.rglob("config.yaml"))
    curves = load_curves([run_dir], lambda run_dir: load_config(run_dir, 1))
    config = load_config(run_dir, 1)
    assert len(curves) == 2 and set(curves["unit"]) == {STEPS} and curves["chosen"].sum() == 1
    n_steps = int(curves["spent"].iloc[-1])
    assert learning_curves(curves).get_suptitle() == f"under way, {n_steps:,} of {config.train.steps:,} steps"

    monkeypatch.undo()
    assert command(*run).returncode == 0
    whole = load_curves([run_dir], lambda run_dir: load_config(run_dir, 1))
    assert whole["mean"].tolist()[:2] == curves["mean"].tolist() and len(whole) > 2
    assert learning_curves(whole).get_suptitle() == ""


def test_an_imitation_that_was_stopped_is_drawn_by_its_rounds(  # type: ignore[no-untyped-def]
    command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stopped(self: object) -> None:
        raise PipelineError("stopped")

    monkeypatch.setattr("otr.control.dagger.loop._Run.choose", stopped)
    run = ("run", "env=pendulum", "method=viper", "depth=2", "oracle=4", "budget=smoke", "n_workers=1",
           f"results_dir={tmp_path}")  # fmt: skip
    assert command(*run).returncode == 1
    (run_dir,) = tmp_path.glob("runs/pendulum/viper/*/*/*")
    curves = load_curves([run_dir], lambda run_dir: load_config(run_dir, 1))
    n_rounds = load_config(run_dir, 1).imitate.n_rounds
    assert len(curves) == n_rounds and curves["spent"].is_monotonic_increasing and not curves["chosen"].any()
    assert learning_curves(curves).get_suptitle() == f"under way, {n_rounds} of {n_rounds} rounds"
    monkeypatch.undo()
    assert command(*run).returncode == 0
    first = [float(row["rollout_mean"]) for row in read_csv(run_dir / "imitate/iterates.csv")]
    assert first[:n_rounds] == pytest.approx(curves["mean"].tolist())


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_no_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert evaluations_so_far(tmp_path) == ([], 0)
    for n in (1, 2):
        (tmp_path / f"segment-{n:06d}").mkdir()
    about = {"evaluations": [{"steps": 20}], "counters": {"num_timesteps": 20}}
    (tmp_path / "segment-000002/history.json").write_text(json.dumps(about))
    seen = iter(["segment-000001", "segment-000002", "segment-000002"])
    monkeypatch.setattr(checkpoints, "last_segment", lambda folder: folder / next(seen))
    assert evaluations_so_far(tmp_path) == ([{"steps": 20}], 20)
    monkeypatch.setattr(checkpoints, "last_segment", lambda folder: folder / "segment-000001")
    with pytest.raises(PipelineError, match=r"history\.json is not there"):  # it stays, and is broken
        evaluations_so_far(tmp_path)


def test_the_title_of_several_runs_sums_up_what_is_done_and_each_has_a_cross_where_it_ends() -> None:
    row = {"panel": "hopper", "label": "otr", "unit": STEPS, "mean": 1.0, "std": 1.0, "chosen": False,
           "final": float("nan")}  # fmt: skip
    under_way = {"under_way": "steps", "whole": 3000}
    rows = [{**row, "run": run, "spent": spent, **under_way, "done": done}
            for run, done in (("a", 1000), ("b", 2000)) for spent in (500, 1000)]  # fmt: skip
    rows += [{**row, "run": "c", "spent": spent, **FINISHED} for spent in (500, 3000)]
    figure = learning_curves(pd.DataFrame(rows))
    assert figure.get_suptitle() == "3 runs; thick: their mean; 2 under way, 3,000 of 6,000 steps"
    rows = [{**row, **FINISHED, "run": run, "spent": spent, "final": final}
            for run, end, final in (("a", 1000, 5.0), ("b", 2000, 9.0)) for spent in (500, end)]  # fmt: skip
    (panel,) = learning_curves(pd.DataFrame(rows)).axes
    crosses = [line for line in panel.lines if line.get_marker() == "x"]
    assert [(list(line.get_xdata()), list(line.get_ydata())) for line in crosses] == [([1000], [5.0]), ([2000], [9.0])]
