"""Learning curves: what they show, of which runs, and what is refused."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines.errors import ConfigError, MissingInputError
from pipelines.report.figures.learning_curves import ROWS, STEPS, learning_curves, load_curves
from pipelines.report.figures.run_figures import runs_below
from pipelines.runs.finished_run import find_run
from tests.committed import RESULTS

HOPPER = "hopper/otr/depth-6/quick/seed-0"


def curve(run: str, *points: tuple[float, float], **changes: object) -> pd.DataFrame:
    row = {"panel": "hopper", "label": "otr", "run": run, "unit": STEPS, "std": 1.0, "chosen": False, "final": 5.0}
    return pd.DataFrame([{**row, "spent": spent, "mean": mean} | changes for spent, mean in points])


def test_curves_of_committed_runs() -> None:
    trained = load_curves([RESULTS / "runs" / HOPPER])
    assert len(trained) == 20 and set(trained["unit"]) == {STEPS} and set(trained["label"]) == {"otr, depth 6, quick"}
    assert trained["spent"].iloc[[0, -1]].tolist() == [5000, 100_000]
    assert trained["chosen"].sum() == 1 and trained.loc[trained["chosen"], "mean"].item() == trained["mean"].max()
    imitated = load_curves([RESULTS / "runs/lunarlander/viper/depth-4/quick/seed-2"])
    assert set(imitated["unit"]) == {ROWS} and len(imitated) == 51 and imitated["std"].isna().all()
    with pytest.raises(MissingInputError, match="no learning curve is kept there"):
        load_curves([RESULTS / "runs/mountaincar/program/depth-1/thesis/seed-0~51b7cab2"])


def test_one_run_has_a_band_and_several_have_a_mean() -> None:
    (panel,) = learning_curves(curve("a", (0, 1.0), (10, 3.0))).axes
    assert len(panel.collections) == 1 and len(panel.lines) == 3  # the curve, the chosen one, the evaluated tree
    assert panel.lines[-1].get_ydata()[0] == 5.0
    several = pd.concat([curve("a", (0, 1.0), (10, 3.0)), curve("b", (0, 3.0), (5, 4.0), (20, 0.0))])
    (panel,) = learning_curves(several).axes
    assert not panel.collections
    mean = panel.lines[-1]
    assert mean.get_xdata().tolist() == [0, 5, 10]  # where both have a value
    np.testing.assert_allclose(mean.get_ydata(), [2.0, 3.0, (3 + 8 / 3) / 2])
    short, long = curve("a", (1, 1.0), (10, 3.0)), curve("b", (1, 1.0), (1000, 3.0), label="ars")
    scales = [learning_curves(each).axes[0].get_xscale() for each in (short, pd.concat([short, long]))]
    assert scales == ["linear", "log"]  # where one label spent much more


def test_each_run_has_a_cross_where_it_ends() -> None:
    figure = learning_curves(
        pd.concat([curve("a", (500, 1.0), (1000, 1.0)), curve("b", (500, 1.0), (2000, 1.0), final=9.0)])
    )
    assert figure.get_suptitle() == "2 runs; thick: their mean"
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    assert [(list(line.get_xdata()), list(line.get_ydata())) for line in crosses] == [([1000], [5.0]), ([2000], [9.0])]


def test_runs_are_found_below_a_folder_under_all_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hopper = RESULTS / "runs" / HOPPER
    below = runs_below(["hopper/otr/depth-6", HOPPER], RESULTS)
    assert below.count(hopper) == 1 and len(below) > 5
    assert runs_below([HOPPER], RESULTS) == runs_below([str(hopper)], RESULTS) == [hopper]
    for words, message in ((["hopper/nothing"], "there is no such folder"), ([], "which run")):
        with pytest.raises(ConfigError, match=message):
            runs_below(words, RESULTS)
    seed = Path("pendulum/otr/depth-6/quick/seed-0")
    place = tmp_path / "disk" / seed
    place.mkdir(parents=True)
    (place / "config.yaml").touch()
    (tmp_path / "results").mkdir()
    (tmp_path / "results/runs").symlink_to(tmp_path / "disk")
    monkeypatch.chdir(tmp_path)
    for run in ("pendulum", "pendulum/otr/depth-6", "results/runs/pendulum"):
        assert runs_below([run], Path("results")) == [Path("results/runs") / seed]
    assert find_run(str(seed), "results") == Path("results/runs") / seed
    place.with_name("seed-1").symlink_to(place)
    monkeypatch.chdir(tmp_path / "disk/pendulum/otr")
    assert find_run("depth-6/quick/seed-1", "results").name == "seed-1"
    assert runs_below(["."], Path("results")) == [find_run("depth-6/quick/seed-0", "results")] == [place]


def test_the_commands(command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setenv("OTR_RESULTS_DIR", str(RESULTS))
    car = "run=mountaincar/otr/depth-1/quick/seed-0"
    done = command("tabulate", "curves", car, f"out={tmp_path / 'a.svg'}")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'a.svg'}\n"), done.stderr
    assert (tmp_path / "a.svg").read_bytes().startswith(b"<?xml")
    refused = command("tabulate", "curves", car, f"out={tmp_path / 'a.gif'}")
    assert refused.returncode == 2 and "expected .png, .svg, .pdf" in refused.stderr
    (tmp_path / "file").touch()
    refused = command("tabulate", "curves", car, f"out={tmp_path}/file/a.png")
    assert refused.returncode == 1 and refused.stderr.startswith(f"otr-tabulate: {tmp_path}/file"), refused.stderr
    for words, message in (
        (["4.1", car], "only figure=curves, figure=leaves take it"),
        (["4.1", "budget=quick"], "budget=quick: only figure=4.6, figure=4.7 take it"),
    ):
        assert message in command("tabulate", *words).stderr
