"""A run of more leaves than int64 counts, as a network of [64, 64] has, in every report."""

import json
from pathlib import Path

import pytest

from pipelines.report import load_runs
from tests.committed import RESULTS
from tests.pipelines.conftest import otr_succeeds
from tests.pipelines.report.conftest import write_run

RUN = "mountaincar/otr/depth-1/quick/seed-0"
HUGE = 2**129
REASON = "more leaves than the limit"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A committed run of whose tree it is said that it has 2^129 leaves, one of 64, and one that says nothing."""
    folder = tmp_path / "results/runs" / RUN
    folder.mkdir(parents=True)
    for file in (RESULTS / "runs" / RUN).iterdir():
        (folder / file.name).symlink_to(file)
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").unlink()
    certify = {"certified": False, "domain": "a box", "reason": REASON, "n_leaves": HUGE}
    (folder / "summary.json").write_text(json.dumps(summary | {"n_leaves": HUGE, "certify": certify}))
    other = {"n_leaves": 64, "pruned_leaves": 9, "certify": certify}
    write_run(tmp_path / "results", "mountaincar/otr/depth-1/quick/seed-1", 90.0, **other)
    write_run(tmp_path / "results", "hopper/viper/depth-6/quick/seed-0", 3.0)
    return tmp_path / "results"


def test_every_report_reads_it(results: Path) -> None:
    place = f"results_dir={results}"
    for command, *words in (
        ("otr-tabulate", "all", "runs", "fits", place),
        ("otr-tabulate", "curves", "regions", f"run={RUN}", place),
        ("otr-report", place),
        ("otr-plan", "env=mountaincar", "depth=1", "budget=quick", place),
    ):
        otr_succeeds(command, *words, cwd=results.parent)
    assert f",{HUGE},".encode() in (results / "tables/runs.csv").read_bytes()
    assert f"| quick | 2 | 64 to 2^129 | | not proved: {REASON} |" in " ".join(
        (results / "tables/certificates.md").read_text().split()
    )
    assert "64 to 2^129" in (results / "page.html").read_text()
    runs = load_runs(results)
    counts = runs[runs["form"] == "tree"].set_index("run")["n_leaves"]
    assert counts[RUN] == HUGE and counts["mountaincar/otr/depth-1/quick/seed-1"] == 64
    assert runs["n_leaves"].max() == HUGE and runs["n_leaves"].isna().sum() == 1
    assert runs["pruned_leaves"].dtype == "Int64"
