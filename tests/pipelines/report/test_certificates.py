"""The table of certificates: a line for the runs that differ in their seed, no bound rounded down."""

from pipelines.engine.store import read_csv
from pipelines.report.certificates import write_certificates
from tests.pipelines.report.conftest import write_run

SECONDS = {"minimal_tree": 0.1, "certify": 0.2, "verify": 0.3}
BOX = "the environment's box of states"
PROVED = {
    "certified": True, "max_error": 7.01e-13, "n_leaves": 20, "n_linear_programs": 5, "domain": BOX,
    "seconds": SECONDS,
}  # fmt: skip


def add(results, run, **certify):
    write_run(results, run, 1.0, n_leaves=64, **({"certify": certify} if certify else {}))


def lines_of(results):
    text = (results / "tables/certificates.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_runs_of_other_seeds_share_a_line_and_no_bound_is_rounded_down(tmp_path):
    add(tmp_path, "pendulum/otr/depth-6/quick/seed-2")
    write_certificates(tmp_path)
    text = (tmp_path / "tables/certificates.md").read_text(encoding="utf-8")
    assert "No run under a budget's own settings has a certificate yet." in text
    add(tmp_path, "pendulum/otr/depth-6/quick/seed-0", **PROVED)
    add(tmp_path, "pendulum/otr/depth-6/quick/seed-1", **PROVED | {"n_leaves": 1024, "max_error": 1e-14})
    add(tmp_path, "hopper/otr/depth-6/quick/seed-0", certified=False, domain="a box", reason="the limit was met")
    add(tmp_path, "pendulum/otr/depth-6/smoke/seed-0", **PROVED)
    add(tmp_path, "pendulum/otr/depth-6/quick/seed-0~12345678", **PROVED)
    for depth, bound in enumerate((0.0, 0.5, 9.3e-13, 0.26)):
        add(tmp_path, f"mountaincar/otr/depth-{depth}/quick/seed-0", **PROVED | {"max_error": bound})
    write_certificates(tmp_path)
    hopper, pendulum, *others = lines_of(tmp_path)
    assert hopper == ["Hopper", "OTR", "6", "quick", "1", "64", "", "not proved: the limit was met", *[""] * 4]
    assert pendulum == ["Pendulum", "OTR", "6", "quick", "2", "64", "20 to 1,024", BOX, "8e-13", "0.10", "0.20", "0.30"]
    assert [line[8] for line in others] == ["0", "0.5", "1e-12", "0.3"]
    rows = [(row["env"], row["seed"], row["certified"]) for row in read_csv(tmp_path / "tables/certificates.csv")]
    assert rows[:3] == [("hopper", "0", "False"), ("pendulum", "0", "True"), ("pendulum", "1", "True")]
