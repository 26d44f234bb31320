import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipelines.engine.archive import MANIFEST_FIELDS
from pipelines.errors import PipelineError
from pipelines.report.frames import load_fits
from pipelines.report.table_4_2 import make_cells, write_table_4_2


def add_fit(results: Path, data: str, method: str, seed: int, test: float, **changes: object) -> Path:
    split = f"split-{changes['split']}" if "split" in changes else ""
    folder = results / "runs" / data / method / split / f"seed-{seed}"
    folder.mkdir(parents=True)
    summary = {
        "schema": "otr/fit-summary/1", "data": data, "method": method, "learner": method, "seed": seed,
        "metric": "auc", "n_labels": 27 if data == "sider" else 1,
        "labels_left_out": {"train": 0, "valid": 0, "test": 2 if data == "sider" else 0},
        "train": 0.95, "valid": 0.75, "test": test, "whole_test": test + 0.01, "leaves": 100.0,
        "depth": 17.0, "small_weights": None,
        "fit_cpu_seconds": 1.5, "seconds": {"fit": 1.0}, "versions": {},
    } | changes  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "score").mkdir()
    labels = np.tile([0.0, 1.0, np.nan], 20)[:, None]
    noise = np.random.default_rng(seed).normal(size=(60, 1)) * (method != "linear_tuned")
    np.savez(folder / "score" / "predictions.npz", test=np.nan_to_num(labels) + noise, labels=labels)
    manifest = dict.fromkeys(MANIFEST_FIELDS) | {"outputs": {"predictions.npz": ""}}
    (folder / "score" / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.fixture
def results(tmp_path):
    for seed, test in enumerate((0.80, 0.82, 0.84)):
        add_fit(tmp_path, "bace", "otr", seed, test)
        add_fit(tmp_path, "bace", "linear_tuned", seed, 0.81)
    add_fit(tmp_path, "sider", "otr", 0, 0.66)
    return tmp_path


@pytest.mark.parametrize("gone", ["predictions.npz", "manifest.json"])
def test_predictions_that_are_gone_are_an_error(results, gone):
    (results / "runs/bace/otr/seed-1/score" / gone).unlink()  # two of three would be another interval
    with pytest.raises(PipelineError, match=f"otr/seed-1/score/{gone} is not there"):
        write_table_4_2(results)


def rows_of(path):
    with path.open() as file:
        return {(row["task"], row["method"]): row for row in csv.DictReader(file)}


def test_cells_stand_beside_the_thesis_and_say_how_many_seeds(results):
    markdown, table, latex, figure = write_table_4_2(results)
    text = markdown.read_text()
    assert "0.820 ± 0.020" in text and "0.815 ± 0.017" in text  # ours and the thesis's
    assert re.search(r"Linear \(depth 0\) \| ours +\| 0.810 +\|", text)  # every seed gives the same
    assert "not run: file not at hand" in text and "for classes only" in text
    assert "2 of 27 of SIDER" in text
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert r"0.820 $\pm$ 0.020" in latex.read_text()
    rows = rows_of(table)
    bace = rows["bace", "otr"]
    assert (float(bace["mean"]), float(bace["std"]), bace["n_runs"]) == (0.82, 0.02, "3")
    assert (bace["published_mean"], bace["train_mean"], bace["leaves"], bace["tree_depth"]) == (
        "0.815", "0.95", "100.0", "17.0",
    )  # fmt: skip
    assert (bace["ci_low"], bace["ci_high"]) == ("", "")  # of three seeds there is none
    assert rows["hiv", "otr"]["note"] == "not run" and rows["hiv", "otr"]["mean"] == ""
    assert rows["sider", "otr"]["labels_left_out"] == "2" and rows["sider", "otr"]["std"] == ""


def test_the_network_stands_in_its_own_column_and_differences_are_paired(results):
    lines = write_table_4_2(results)[0].read_text().splitlines()
    details = [line for line in lines if line.startswith("| Bace") and "0.820" in line and "0.830" in line]
    assert len(details) == 1  # the tree's score, then the network's
    beside = [line.split("|")[3].strip() for line in lines if line.startswith("| Bace")][-1]
    difference, low, high = map(float, re.findall(r"[-+]\d\.\d+", beside))
    assert -1 < low <= difference <= high < 0  # linear is always right here, OTR is not


def test_the_same_fits_give_the_same_bytes(results):
    before = [path.read_bytes() for path in write_table_4_2(results)]
    assert [path.read_bytes() for path in write_table_4_2(results)] == before


def test_fits_with_other_settings_are_left_out(results):
    add_fit(results, "bace", "otr", 3, 0.1).rename(results / "runs/bace/otr/seed-3~0123abcd")
    path = results / "runs/bace/otr/seed-3~0123abcd/summary.json"
    assert path.is_file() and len(load_fits(results)) == 8
    cells = make_cells(load_fits(results)).set_index(["task", "method"])
    assert cells.loc[("bace", "otr"), "n_runs"] == 3


def test_parts_drawn_anew_stand_apart_with_differences_on_the_same_split(results):
    before = write_table_4_2(results)[1].read_bytes()
    for split, (linear, otr) in enumerate([(0.70, 0.74), (0.80, 0.82), (0.60, 0.66), (0.75, 0.77), (0.65, 0.71)]):
        add_fit(results, "bace", "linear_tuned", 0, linear, split=split)
        add_fit(results, "bace", "otr", 0, otr, split=split, leaves=10.0)
    markdown, table, *_ = write_table_4_2(results)
    lines = [line for line in markdown.read_text().splitlines() if "0, 1, 2, 3, 4" in line]
    assert [[cell.strip() for cell in line.split("|")[2:6]] for line in lines] == [
        ["Linear (depth 0)", "0.700 ± 0.079", "", "100.0"],
        ["OTR", "0.740 ± 0.060", "+0.040 (+0.008 to +0.072)", "10.0"],
    ]
    assert table.read_bytes() == before  # the cells are of the published parts alone


def test_what_was_tuned_is_told(results):
    folder = add_fit(results, "tox21", "cart", 0, 0.65, seconds={"tune": 2.0})
    (folder / "tune").mkdir()
    method = {
        "grid": [{"max_depth": [2, 3, 4]}, {"drop": [0.0, 0.25, 0.5], "wide": [True]}],
        "tuned_for": "label",
        "tuning_seeds": [1000],
    }
    (folder / "tune" / "manifest.json").write_text(json.dumps({"settings": {"method": method}}))
    chosen = [
        {"label": name, "settings": {"max_depth": depth}, "valid": depth / 8}
        for name, depth in zip("abc", (2, 4, 2), strict=True)
    ]
    (folder / "tune" / "chosen.json").write_text(json.dumps(chosen))
    text = write_table_4_2(results)[0].read_text()
    assert "one of\n    * max_depth 2 to 4\n    * drop 0.0 / 0.25 / 0.5, wide true\n" in text
    assert "| 0.333 | max_depth 2 (2); max_depth 4 (1)" in text  # the mean over labels of what each scored


def test_foreign_summaries_are_refused(results):
    add_fit(results, "hiv", "otr", 0, 0.7, schema="other")
    with pytest.raises(PipelineError, match="runs/hiv/otr/seed-0"):
        write_table_4_2(results)


def test_without_fits_every_cell_says_not_run(tmp_path):
    paths = write_table_4_2(tmp_path)
    assert [path.suffix for path in paths] == [".md", ".csv", ".tex"]
    assert "Nothing has been run yet." in paths[0].read_text()
