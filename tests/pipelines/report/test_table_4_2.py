import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.engine.archive import MANIFEST_FIELDS
from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.report.table_4_2 import _draw_sparse_tree, write_table_4_2
from tests.committed import RESULTS


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


def test_what_was_not_run_is_said_and_there_is_a_picture(results, tmp_path):
    paths = write_table_4_2(tmp_path / "nothing")
    assert [path.suffix for path in paths] == [".md", ".csv", ".tex"]
    assert "Nothing has been run yet." in paths[0].read_text()
    add_fit(results, "bace", "otr", 3, 0.1).rename(results / "runs/bace/otr/seed-3~0123abcd")  # of other settings
    markdown, table, _, figure = write_table_4_2(results)
    assert "0.820 ± 0.020" in markdown.read_text() and "2 of 27 of SIDER" in markdown.read_text()
    assert figure.read_bytes().startswith(b"\x89PNG")
    rows = {(row["task"], row["method"]): row for row in read_csv(table)}
    bace, hiv = rows["bace", "otr"], rows["hiv", "otr"]
    assert (bace["n_runs"], bace["ci_low"]) == ("3", "")  # of three seeds there is no interval
    assert (hiv["note"], hiv["mean"], rows["sider", "otr"]["std"]) == ("not run", "", "")


def test_the_tree_that_is_printed_is_drawn(tmp_path):
    assert _draw_sparse_tree(tmp_path) == []
    (tmp_path / "runs").symlink_to(RESULTS / "runs")
    (path,) = _draw_sparse_tree(tmp_path)
    width, height = Image.open(path).size
    assert width > 1.5 * height  # from left to right
