"""What is committed under results: the table is that of the runs, and the runs reach what the README says."""

import json
from pathlib import Path

import pytest

import otr
from pipelines.config.methods import METHODS
from pipelines.engine.stage import verified_manifest
from pipelines.engine.store import read_csv
from pipelines.play.actor_files import load_actor
from pipelines.report.tabulate import TABLES
from pipelines.stages.oracle import load_oracle
from tests.pipelines.conftest import otr_command

RESULTS = Path(__file__).parent.parent / "results"
SUMMARIES = sorted((RESULTS / "runs").glob("*/*/depth-*/**/summary.json"))
FITS = sorted((RESULTS / "runs").glob("*/*/seed-*/summary.json"))


@pytest.mark.parametrize("table", ["4.1", "4.2", "certificates"])
def test_committed_tables_are_those_of_the_committed_runs(table, tmp_path):
    (tmp_path / "runs").symlink_to(RESULTS / "runs")
    for path in TABLES[table](tmp_path)[:3]:  # figures differ with fonts
        assert path.read_bytes() == (RESULTS / "tables" / path.name).read_bytes(), f"run otr-tabulate: {path.name}"


@pytest.mark.parametrize(
    ("figure", "file"), [("4.6", "figure_4_6.csv"), pytest.param("4.7", "figure_4_7.txt", marks=pytest.mark.slow)]
)
def test_committed_figures_are_those_of_the_committed_runs(figure, file, tmp_path):
    (tmp_path / "runs").symlink_to(RESULTS / "runs")
    done = otr_command("otr-tabulate", f"figure={figure}", f"results_dir={tmp_path}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "figures" / file).read_text() == (RESULTS / "figures" / file).read_text()


@pytest.mark.parametrize("summary", SUMMARIES, ids=lambda path: "-".join(path.parts[-6:-1]))
def test_committed_artefacts_are_whole(summary):
    told = json.loads(summary.read_text())
    for stage in METHODS[told["method"]].stages:
        verified_manifest(summary.parent / stage)
    if METHODS[told["method"]].imitates:
        load_oracle(summary.parent / "oracle", RESULTS)
    assert told["n_episodes"] == (1000 if told["method"] == "pid" else 100)  # as the thesis


def test_committed_fits_are_whole_and_tell_what_they_were_made_with():
    for summary in FITS:
        for stage in ("tune", "score"):
            if stage == "score" or (summary.parent / stage).exists():
                assert "+" not in verified_manifest(summary.parent / stage)["git_revision"]
        scores = read_csv(summary.parent / "score" / "scores.csv")
        told = [float(row["test"]) for row in scores if row["test"]]
        assert json.loads(summary.read_text())["test"] == pytest.approx(sum(told) / len(told), abs=1e-7)


@pytest.mark.parametrize(
    ("run", "least"),
    [
        *((f"pendulum/otr/depth-6/quick/seed-{seed}", -165.0) for seed in range(3)),
        *((f"pendulum/otr/depth-32/quick/seed-{seed}", -165.0) for seed in range(3)),
        *((f"mountaincar/otr/depth-1/quick/seed-{seed}", 90.0) for seed in range(3)),
        ("pendulum/pid/depth-1/quick/seed-0", -162.6),  # the thesis's, Fig. 4.4
        ("lunarlander/otr/depth-2/thesis/seed-0", 200.0),
        ("swimmer/otr/depth-6/thesis/seed-0", 350.0),
    ],
)
def test_committed_runs_have_learnt(run, least):
    assert json.loads((RESULTS / "runs" / run / "summary.json").read_text())["return_mean"] >= least


def takes_seconds(certificate):
    """Whether a certificate has megabytes; of these seed 0's alone is checked every time."""
    return certificate.stat().st_size > 2**20 and certificate.parents[1].name != "seed-0"


CERTIFICATES = sorted(RESULTS.glob("runs/*/*/depth-*/*/seed-*/certify/certificate.json"))


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=pytest.mark.slow if takes_seconds(path) else ()) for path in CERTIFICATES],
    ids=lambda path: path.parents[1].relative_to(RESULTS / "runs").as_posix(),
)
def test_committed_certificates_prove_what_they_claim(path):
    certificate, network = otr.load_certificate(path), load_actor(path.parents[1] / "train")
    bound = otr.verify(certificate, otr.load(path.parent / "tree"), network)
    assert bound <= certificate.max_error < 1e-10
