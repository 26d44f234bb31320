"""Learning curves and maps of regions: what they show, of which runs, and what is refused."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

import otr
from otr.programs.picture.colours import label_colours, level_colour
from pipelines.errors import ConfigError, MissingInputError
from pipelines.report.figures.learning_curves import ROWS, STEPS, curve_rows, learning_curves, load_curves
from pipelines.report.figures.regions import chosen_inputs, draw_regions
from pipelines.report.figures.run_figures import runs_below
from pipelines.runs.finished_run import find_run
from tests.committed import RESULTS
from tests.core.test_tree import small_tree

HOPPER = "hopper/otr/depth-6/quick/seed-0"
STATES = np.array([[-1.0, 0.0, 5.0], [1.0, 2.0, 7.0], [0.5, 0.5, 6.0]])


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
    rows = curve_rows(trained)
    assert list(rows) == ["env", "method", "depth", "budget", "seed", "step", "unit", "metric", "value"]
    assert rows.iloc[0].tolist()[:8] == ["hopper", "otr", "6", "quick", "0", 5000, STEPS, "return_mean"]
    assert rows["value"].tolist() == [*trained["mean"], *trained["std"]]
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
    solid, dashed = (line.get_linestyle() for line in learning_curves(pd.concat([short, long])).axes[0].lines[::3])
    assert (solid, dashed) == ("-", "--")
    scales = [learning_curves(each).axes[0].get_xscale() for each in (short, pd.concat([short, long]))]
    assert scales == ["linear", "log"]  # where one label spent much more


def test_each_run_has_a_cross_where_it_ends() -> None:
    figure = learning_curves(
        pd.concat([curve("a", (500, 1.0), (1000, 1.0)), curve("b", (500, 1.0), (2000, 1.0), final=9.0)])
    )
    assert figure.get_suptitle() == "2 runs; thick: their mean"
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    assert [(list(line.get_xdata()), list(line.get_ydata())) for line in crosses] == [([1000], [5.0]), ([2000], [9.0])]


def three_inputs(**changes: object) -> otr.ObliqueTree:
    """x2 <= 6.5: leaf 0; else leaf 1, of which the first input decides nothing."""
    arrays: dict = {"P": [[0.0, 0.0, 1.0]], "v": [-6.5], "M": np.zeros((2, 1, 3)), "c": [[-1.0], [1.0]]}
    return otr.ObliqueTree([~0], [~1], **(arrays | changes))


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


def test_inputs_are_those_asked_for_or_those_that_weigh_most() -> None:
    names = ["a", "b", "c"]
    assert chosen_inputs(three_inputs(), STATES, names, ["c", "a"]) == (2, 0)
    assert chosen_inputs(three_inputs(P=[[9.0, 1.0, 2.0]]), STATES * [0.001, 1, 1], names, []) == (1, 2)
    one = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[2.0]]], [[-1.0]])
    for tree, given, message in (
        (three_inputs(), ["a", "d"], r"no input 'd'.*a, b, c"),
        (three_inputs(), ["a"], r"inputs=\[a\]: give two inputs, as inputs=\[a,b\]"),
        (one, [], "a map needs two inputs, the tree has 1"),
    ):
        with pytest.raises(ConfigError, match=message):
            chosen_inputs(tree, STATES[:, : tree.n_inputs], names[: tree.n_inputs], given)


def draw(tree: otr.ObliqueTree, inputs: tuple[int, int] = (0, 1), outputs: list[str] | None = None, states=STATES):  # type: ignore[no-untyped-def]
    names = ["a", "b", "c"][: tree.n_inputs]
    return draw_regions(tree, states, inputs, feature_names=names, output_names=outputs or ["force"], title="a map")


def test_other_inputs_are_at_their_medians_and_the_picture_says_so() -> None:
    figure = draw(three_inputs(head=otr.ClipBox(-1.0, 1.0)))
    values = figure.axes[0].images[0].get_array()
    assert set(np.unique(values)) == {-1.0}  # the median of c is 6, which is at most 6.5
    assert "all other inputs at their medians over 3 visited states" in figure.get_supxlabel()
    assert "1 of 2 leaves" in figure.get_supxlabel()
    across = draw(three_inputs(head=otr.ClipBox(-1.0, 1.0)), (2, 0))
    values = across.axes[0].images[0].get_array()
    low, high = across.axes[0].get_xlim()
    assert (values == -1).mean() == pytest.approx((6.5 - low) / (high - low), abs=0.01)
    assert to_hex(across.axes[0].images[0].cmap(1.0)) == level_colour(1.0)


def test_labels_have_the_colours_of_the_tree_and_equal_leaves_no_border() -> None:
    states = STATES[:, :2]
    figure = draw(small_tree(labels=[1, 0, 0]), outputs=["none", "left"], states=states)
    pixels, border = (image.get_array() for image in figure.axes[0].images)
    assert {to_hex(pixel) for pixel in pixels.reshape(-1, 3)[::97]} == {label_colours(0)[1], label_colours(1)[1]}
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["none", "left"]
    assert (border[:, :, 3] > 0).any(axis=0).sum() == 1  # one upright line
    dots = figure.axes[0].lines[0]
    np.testing.assert_array_equal(np.column_stack(dots.get_data()), states)
    assert f"dots: {len(states):,} visited states" in figure.get_supxlabel()
    assert "medians" not in figure.get_supxlabel()


def test_the_commands(command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setenv("OTR_RESULTS_DIR", str(RESULTS))
    car = "run=mountaincar/otr/depth-1/quick/seed-0"
    for words in (["curves", car], ["figure=regions", car, "inputs=[velocity,position]"]):
        done = command("tabulate", *words, f"out={tmp_path / 'a.svg'}")
        csv = f"{tmp_path / 'a.csv'}\n" if "curves" in words else ""
        assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'a.svg'}\n{csv}"), done.stderr
        assert (tmp_path / "a.svg").read_bytes().startswith(b"<?xml")
    alone = command("tabulate", "curves", car, f"out={tmp_path / 'b.csv'}")
    assert alone.stdout == f"{tmp_path / 'b.csv'}\n" and not (tmp_path / "b.png").exists()
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    refused = command("tabulate", "curves", car, f"out={tmp_path / 'a.gif'}")
    assert refused.returncode == 2 and "expected .png, .svg, .pdf" in refused.stderr
    (tmp_path / "file").touch()
    refused = command("tabulate", "curves", car, f"out={tmp_path}/file/a.png")
    assert refused.returncode == 1 and refused.stderr.startswith(f"otr-tabulate: {tmp_path}/file"), refused.stderr
    for words, message in (
        (["4.1", car], "only figure=curves, figure=leaves, figure=regions take it"),
        (["4.1", "budget=quick"], "budget=quick: only figure=4.6, figure=4.7 take it"),
        (["curves", car, "tree=full"], "tree=full: only figure=regions takes it"),
    ):
        assert message in command("tabulate", *words).stderr
