"""otr-fit as it is typed."""

import pandas as pd
import pytest

import otr
from pipelines.cli.fits import FIT
from pipelines.datasets import Columns
from pipelines.report import load_fits
from tests.pipelines.conftest import otr_command, otr_succeeds
from tests.pipelines.datasets.conftest import real_data as real_data  # a fixture
from tests.pipelines.datasets.test_table import frame


def test_fit_sweep_runs_and_is_found_done(tmp_path):
    words = ("-m", "data=breast_cancer", "method=linear,otr_16", "seed=range(0,2)")
    done = otr_succeeds("otr-fit", *words, cwd=tmp_path)
    assert "1 more seeds as one batched model" in done.stdout and "4 jobs: 4 done, 0 failed" in done.stdout
    rows = [line.split() for line in done.stdout.splitlines() if line.startswith("  breast_cancer/")]
    assert [row[0] for row in rows] == [f"breast_cancer/{m}/seed-{s}" for m in ("linear", "otr_16") for s in (0, 1)]
    assert all(0.8 < float(row[3]) <= 1 for row in rows)  # on the test part
    again = otr_command("otr-fit", *words, cwd=tmp_path)
    assert again.stdout.count("done before") == 4
    table = otr_command("otr-tabulate", "table=4.2", cwd=tmp_path)
    assert table.returncode == 0 and "Sparse training on Bace" in table.stdout


def test_a_table_of_ones_own(tmp_path):
    """Its tree prints with the table's names, answers new rows, and another content is another fit."""
    frame().to_csv(tmp_path / "my data.csv", index=False)
    words = ("data=my data.csv", "drop=[price]", "method=cart", "method.grid=[]", "method.max_depth=2")
    done = otr_succeeds("otr-fit", *words, "target=grade", cwd=tmp_path)
    assert "return good" in done.stdout and "if" in done.stdout and "size <= 0 then" in done.stdout
    (fit,) = tmp_path.glob("results/runs/my data.csv/cart/seed-0~*/fit")
    tree, columns = otr.load(fit / "label-00"), Columns.read(fit / "columns.json")
    assert tree.feature_names == columns.feature_names and tree.output_names == columns.classes == ("bad", "good")
    rows = pd.DataFrame({"size": [150.0, 50.0], "colour": ["red", None], "town": ["A", "B"], "age": [None, 3]})
    assert [columns.classes[label] for label in tree.predict(columns.encode(rows))] == ["good", "bad"]
    swept = otr_succeeds(
        "otr-fit", "-m", *words[:1], "target=age,size", "drop=[price,grade]", "method=linear", cwd=tmp_path
    )
    assert "2 jobs: 2 done" in swept.stdout
    linear = otr_succeeds("otr-fit", *words[:2], "target=grade", "method=linear", cwd=tmp_path)
    assert "# grade: 0 is bad, 1 is good" in linear.stdout
    frame(220).to_csv(tmp_path / "my data.csv", index=False)
    otr_succeeds("otr-fit", *words, "target=grade", cwd=tmp_path)
    assert len(list(tmp_path.glob("results/runs/my data.csv/cart/*"))) == 2


@pytest.mark.parametrize(
    "words, message",
    [
        ((), "which data set? Add data=NAME with one of: bace"),
        (("method=otr", "keep_trees=false", "data.split=0"), "which data set? Add data=NAME with one of: bace"),
        (("data=bacee",), "Did you mean bace?"),
        (("data=bace", "method=otrr"), "Did you mean otr"),
        (("data=bace", "method.hiden=[3]"), "Did you mean method.hidden"),
        (("data=bace", "method=cart", "method.max_depth=1"), "method=cart tunes max_depth, and what is given would be"),
        (("data=bace", "method=linear_tuned", "method.C=0.003"), "method=linear_tuned tunes C"),
        (("data=bace", "method=otr", "method.tuned_for=data"), "method.tuned_for=data: nothing is tuned"),
        (
            ("data=breast_cancer", "method=linear", "method.alpha=9"),
            "LinearTreeClassifier, which breast_cancer takes, has",
        ),
        (("data=no.csv", "target=price"), "no.csv: there is no such file"),
        (("data=bace", "target=price"), "target=price: bace has its labels; a target is for data=FILE.csv"),
        (("data=table",), "data=table: of which file? Give data=FILE.csv target=COLUMN"),
        (("data=bace,hiv",), "several values make a sweep; add -m"),
        (("data=bace", "+experiment=table_4_3"), "Did you mean table_4_2?"),
    ],
)
def test_wrong_words_are_explained(tmp_path, words, message):
    done = otr_command("otr-fit", *words, cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr and "Traceback" not in done.stderr


def test_trees_that_were_not_kept_are_told_and_fitted_again(tmp_path):
    words = ("data=breast_cancer", "method=linear")
    assert otr_command("otr-fit", *words, "keep_trees=false", cwd=tmp_path).returncode == 0
    again = otr_command("otr-fit", *words, cwd=tmp_path)
    assert "done before\nits trees were not kept; stages=[fit] fits them again\n" in again.stdout
    assert otr_command("otr-fit", *words, "stages=[fit]", cwd=tmp_path).returncode == 0
    assert (tmp_path / "results/runs/breast_cancer/linear/seed-0/fit/label-00.json").is_file()
    assert "not kept" not in otr_command("otr-fit", *words, cwd=tmp_path).stdout


def test_missing_data_is_told_once_for_all_seeds(tmp_path):
    words = ("data=bace", "method=otr")
    alone = otr_command("otr-fit", *words, "seed=0", cwd=tmp_path, OTR_DATA_DIR=str(tmp_path))
    done = otr_command("otr-fit", "-m", *words, "seed=range(0,3)", cwd=tmp_path, OTR_DATA_DIR=str(tmp_path))
    assert (alone.returncode, done.returncode) == (1, 1)
    assert done.stderr.count("train.fgp2048.csv") == alone.stderr.count("train.fgp2048.csv") > 0
    assert done.stderr.count("failed: so, too") == 2
    assert "3 failed" in done.stdout


def test_parts_drawn_anew(tmp_path, real_data):
    words = ("-m", "data=bace", "method=cart", "method.grid=[]", "method.max_depth=2", "data.split=range(0,2)")
    done = otr_succeeds("otr-fit", *words, cwd=tmp_path, OTR_DATA_DIR=str(real_data))
    assert "bace, cart, split 1, seed 0: AUC" in done.stdout
    (run_dir,) = tmp_path.glob("results/runs/bace/cart/split-1/seed-0~*")
    first, second = load_fits(tmp_path / "results").itertuples()
    assert (first.split, second.split, second.run) == (0, 1, f"bace/cart/split-1/{run_dir.name}")
    assert first.test != second.test


def test_published_settings_are_used_where_there_are_any(tmp_path):
    bace = otr_command("otr-fit", "--cfg", "data=bace", "method=lcn", cwd=tmp_path).stdout
    assert "grid: []" in bace and "depth: 12" in bace and "drop_connect: 0.75" in bace
    mine = otr_command("otr-fit", "--cfg", "data=bace", "method=lcn", "method.depth=3", cwd=tmp_path).stdout
    assert "depth: 3" in mine
    assert "grid: []" not in otr_command("otr-fit", "--cfg", "data=sider", "method=lcn", cwd=tmp_path).stdout


def test_parts_drawn_anew_have_no_settings_that_were_tuned_on_the_published_ones():
    published, anew = FIT.jobs([["data=bace", "method=lcn"], ["data=bace", "method=lcn", "data.split=3"]])
    assert published.config.method.grid == [] and anew.config.method.grid
    assert anew.folder == "runs/bace/lcn/split-3/seed-0"
    (changed,) = FIT.jobs([["data=bace", "method=lcn", "data.split=3", "method.epochs=3"]])
    assert changed.folder.startswith("runs/bace/lcn/split-3/seed-0~")
