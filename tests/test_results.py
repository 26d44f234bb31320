"""What is committed under results: the table is that of the runs, and the runs reach what the README says."""

import json
import re
import shlex

import pytest

import otr
from pipelines.cli.fits import FIT
from pipelines.cli.runs import RUN, load_config
from pipelines.config.methods import METHODS
from pipelines.engine.archive import MANIFEST, opened, verified_manifest
from pipelines.engine.job import is_done
from pipelines.engine.store import ARCHIVE, exists, read_csv, read_summary
from pipelines.play.actor_files import load_actor
from pipelines.report.tabulate import TABLES
from pipelines.runs.derived import opened_run
from pipelines.runs.verify_run import certified_stage
from pipelines.stages.oracle import load_oracle
from tests.committed import RESULTS
from tests.pipelines.conftest import otr_succeeds

SUMMARIES = sorted((RESULTS / "runs").glob("*/*/depth-*/**/summary.json"))
FITS = sorted(
    path.parent for where in ("seed-*", "split-*/seed-*") for path in RESULTS.glob(f"runs/*/*/{where}/{ARCHIVE}")
)


def id_of(run_dir):
    return run_dir.relative_to(RESULTS / "runs").as_posix()


def commands_of_the_page():
    """Yield the words of the commands by which docs/results.md says that the committed runs and fits were made."""
    page = (RESULTS.parent / "docs/results.md").read_text()
    block = re.search(r"## Commands.*?```\n(.*?)```", page, re.DOTALL)[1]
    for line in block.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words and words[0] != "otr-tabulate":
            yield words


@pytest.mark.parametrize("table", ["4.1", "4.2", "certificates", "comparisons"])
def test_committed_tables_are_those_of_the_committed_runs(table, tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.report.table_4_2._write_figure", lambda *_: [])
    for name in ("runs", "benchmarks"):
        (tmp_path / name).symlink_to(RESULTS / name)
    for path in TABLES[table](tmp_path)[:3]:  # figures differ with fonts
        assert path.read_bytes() == (RESULTS / "tables" / path.name).read_bytes(), f"run otr-tabulate: {path.name}"


@pytest.mark.parametrize(
    ("figure", "file"),
    [
        ("4.6", "figure_4_6.csv"),
        ("profile", "performance_profile.csv"),
        ("profile", "interquartile_means.csv"),
        ("numbers", "numbers.csv"),
        pytest.param("4.7", "figure_4_7.txt", marks=pytest.mark.slow),
    ],
)
def test_committed_figures_are_those_of_the_committed_runs(figure, file, tmp_path):
    (tmp_path / "runs").symlink_to(RESULTS / "runs")
    otr_succeeds("otr-tabulate", f"figure={figure}", f"results_dir={tmp_path}", cwd=tmp_path)
    assert (tmp_path / "figures" / file).read_text() == (RESULTS / "figures" / file).read_text()


@pytest.mark.parametrize("summary", SUMMARIES, ids=lambda path: id_of(path.parent))
def test_committed_artefacts_are_whole_and_of_clean_revisions(summary):
    told = json.loads(summary.read_text())
    for stage in METHODS[told["method"]].stages:
        assert "+" not in verified_manifest(summary.parent / stage)["git_revision"]
    if METHODS[told["method"]].imitates:
        load_oracle(summary.parent / "oracle", RESULTS)
    cheap = {"pendulum": 5000, "mountaincar": 1000, "reacher": 1000}
    assert told["n_episodes"] == (1000 if told["method"] == "pid" else cheap.get(told["task"], 100))


def of_every_kind():
    """Return the runs; one of each task and one of each method are made again every time, the others where slow."""
    seen = set()
    for summary in SUMMARIES:
        kinds = set(summary.relative_to(RESULTS / "runs").parts[:2])
        yield pytest.param(summary.parent, marks=pytest.mark.slow if kinds <= seen else (), id=id_of(summary.parent))
        seen |= kinds


@pytest.mark.parametrize("run_dir", list(of_every_kind()))
def test_what_archives_leave_out_is_made_again_byte_for_byte(run_dir):
    config = load_config(run_dir, None)
    with opened_run(config, run_dir) as whole:
        for stage in config.method.stages:
            verified_manifest(whole / stage)


def test_committed_fits_are_whole_and_name_their_revision():
    for fit in FITS:
        for stage in ("tune", "score"):
            if stage == "score" or exists(fit / stage / MANIFEST):
                assert "+" not in verified_manifest(fit / stage)["git_revision"]
        scores = [float(row["test"]) for row in read_csv(fit / "score" / "scores.csv") if row["test"]]
        assert read_summary(fit)["test"] == pytest.approx(sum(scores) / len(scores), abs=1e-7)


def test_committed_runs_have_learnt():
    least = {
        "pendulum/otr/depth-6/quick": -165.0, "pendulum/otr/depth-32/quick": -165.0,
        "mountaincar/otr/depth-1/quick": 90.0, "lunarlander/otr/depth-2/thesis": 200.0,
        "swimmer/otr/depth-6/thesis": 350.0, "pendulum/pid/depth-1/quick": -162.6,  # the thesis's, Fig. 4.4
    }  # fmt: skip
    for runs, bound in least.items():
        for seed in range(3 if "otr/" in runs and runs.endswith("quick") else 1):
            summary = json.loads((RESULTS / "runs" / runs / f"seed-{seed}/summary.json").read_text())
            assert summary["return_mean"] >= bound, runs


def certified():
    """Return the runs with a certificate; those that take a second to check are slow."""
    for summary in SUMMARIES:
        report = json.loads(summary.read_text()).get("certify", {"certified": False})
        if report["certified"]:
            is_slow = report["seconds"]["verify"] > 1
            yield pytest.param(summary.parent, marks=pytest.mark.slow if is_slow else (), id=id_of(summary.parent))


@pytest.mark.parametrize("run_dir", list(certified()))
def test_committed_certificates_prove_what_they_claim(run_dir):
    with opened(run_dir, ["certify"]) as whole:
        certificate = otr.load_certificate(whole / "certify/certificate.json")
        network = load_actor(run_dir / certified_stage(load_config(run_dir, None), run_dir))
        bound = otr.verify(certificate, otr.load(whole / "certify/tree"), network)
    assert bound <= certificate.max_error < 1e-10


@pytest.mark.slow
def test_what_is_committed_was_made_by_the_commands_of_the_page_and_its_runs_are_all_there(monkeypatch):
    monkeypatch.chdir(RESULTS.parent)
    made, left = set(), []
    for command, *overrides in commands_of_the_page():
        workflow = {"otr-run": RUN, "otr-fit": FIT}[command]
        words = [each for each in overrides if each != "-m"]
        jobs = workflow.jobs(workflow.expand(words, "-m" in overrides))
        made |= {job.folder for job in jobs}
        if workflow is RUN:  # what is left of the fits the tables call not run
            left += [job.folder for job in jobs if not is_done(job)]
    finished = {path.parent for path in SUMMARIES} | {*FITS}
    assert {folder.relative_to(RESULTS).as_posix() for folder in finished} - made == set()
    assert left == []
