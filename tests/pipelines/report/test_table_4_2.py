import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipelines.engine.archive import MANIFEST_FIELDS
from pipelines.errors import PipelineError
from pipelines.report.frames import load_fits
from pipelines.report.table_4_2 import write_table_4_2


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
    add_fit(results, "hiv", "otr", 0, 0.7, schema="other")
    with pytest.raises(PipelineError, match="runs/hiv/otr/seed-0"):
        write_table_4_2(results)


def rows_of(path):
    with path.open() as file:
        return {(row["task"], row["method"]): row for row in csv.DictReader(file)}


def test_cells_stand_beside_the_thesis_and_say_how_many_seeds(results, tmp_path):
    paths = write_table_4_2(tmp_path / "nothing")
    assert [path.suffix for path in paths] == [".md", ".csv", ".tex"]
    assert "Nothing has been run yet." in paths[0].read_text()
    add_fit(results, "bace", "otr", 3, 0.1).rename(results / "runs/bace/otr/seed-3~0123abcd")  # of other settings
    assert len(load_fits(results)) == 8
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
