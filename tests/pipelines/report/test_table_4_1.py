"""Table 4.1: which runs count and what is refused; what is computed, the committed table shows (test_results.py)."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from scipy import stats

from pipelines.engine.store import read_csv, write_json
from pipelines.errors import PipelineError
from pipelines.report.table_4_1 import write_table_4_1
from tests.pipelines.report.conftest import write_run


def hopper(results_dir: Path) -> dict[str, str]:
    """Return the cell of OTR (6) on Hopper."""
    cell = ("4.1", "hopper", "otr", "6")
    rows = read_csv(write_table_4_1(results_dir)[1])
    return next(row for row in rows if tuple(row[key] for key in ("table", "task", "method", "depth")) == cell)


def test_budgets_have_an_order_and_are_never_mixed(tmp_path: Path) -> None:
    for budget in ("zeta", "alpha", "quick-fleet", "quick", "thesis-fleet", "thesis"):  # the last one written is chosen
        write_run(tmp_path, f"hopper/otr/depth-6/{budget}/seed-0", 1.0)
        if budget != "zeta":
            assert hopper(tmp_path)["budget"] == budget
    assert hopper(tmp_path)["note"].split("; ") == [
        f"also 1.0 (1 run, {budget})" for budget in ("thesis-fleet", "quick", "quick-fleet", "alpha", "zeta")
    ]
    for run in ("hopper/otr/depth-6/quick/seed-1", "hopper/otr/depth-6/quick/seed-2~0a1b2c3d"):
        write_run(tmp_path, run, 3.0)  # several come before one; those of other settings do not count
    assert [hopper(tmp_path)[name] for name in ("budget", "mean", "n_runs")] == ["quick", "2.0", "2"]


def test_a_cell_is_marked_by_its_test_against_the_thesis(tmp_path: Path) -> None:
    for seed, mean in enumerate((3900.0, 3950.0, 4000.0)):
        write_run(tmp_path, f"hopper/otr/depth-6/standard/seed-{seed}", mean)
        policies = {"oracle": {"return_mean": 1.0, "n_episodes": 1}}
        imitated = {"oracle": {"hidden_widths": [32]}, "policies": policies}  # OTR (32)'s own
        write_run(tmp_path, f"hopper/ndps/depth-6/standard/seed-{seed}", 1600.0 + 10 * seed, **imitated)
    cell = hopper(tmp_path)
    p_value = stats.ttest_ind_from_stats(3950.0, 50.0, 3, 3641.5, 126.9, 10, equal_var=False).pvalue
    assert (float(cell["p_value"]), float(cell["p_holm"])) == pytest.approx((p_value, 2 * p_value), abs=1e-6)
    assert (cell["against_thesis"], cell["published_steps"], cell["imitates"]) == ("higher", "4000000.0", "")
    text = (tmp_path / "tables/table_4_1.md").read_text(encoding="utf-8")
    assert "3950.0 ± 50.0 ↑ |" in text and "1610.0 ± 10.0 ○† |" in text
    assert "of 2 cells 1 are higher, 0 are lower, 1 are open" in text
    assert r"$\uparrow$" in (tmp_path / "tables/table_4_1.tex").read_text(encoding="utf-8")


def test_the_pendulums_note_says_how_far_the_best_policy_is_from_the_optimum(tmp_path: Path) -> None:
    write_run(tmp_path, "pendulum/otr/depth-6/standard/seed-0", -140.0)
    assert "value iteration" not in write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    (tmp_path / "benchmarks").mkdir()
    details = {"n_starts": 5000.0, "std_of_means_of_100": 7.5}
    write_json(tmp_path / "benchmarks/pendulum_optimum.json", [{"value": -136.5, "details": details}])
    text = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    assert "the optimum is a mean return of -136.5 over our 5,000 starts" in text
    assert "OTR (6), returns -140.0, which is 3.5 less" in text and "is 0.2 of it from the optimum" in text


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path: Path) -> None:
    write_run(tmp_path, "pendulum/otr/depth-32/my_budget/seed-0", -150.0)
    write_table_4_1(tmp_path)
    document = r"\documentclass{article}\usepackage{booktabs}\begin{document}\input{table_4_1}\end{document}"
    (tmp_path / "tables/paper.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path / "tables", capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout[-2000:]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": "otr/summary/9"}, "schema 'otr/summary/9' where 'otr/summary/1' was expected"),
        ({"return_mean": float("nan")}, "return_mean is nan where a number was expected"),
        ({"versions": {}}, "it has no 'versions.gymnasium'"),
        ({"seed": 1}, "describes the run hopper/otr/depth-6/quick/seed-1, not the one whose folder it is in"),
        ({"depth": 7}, "describes the run hopper/otr/depth-7/quick/seed-0"),
    ],
)
def test_wrong_summary_is_an_error_that_names_it(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write_run(tmp_path, "hopper/otr/depth-6/quick/seed-0", 1.0, **changes)
    with pytest.raises(PipelineError, match=f"(?s){re.escape(str(path))}.*{re.escape(message)}"):
        write_table_4_1(tmp_path)
    for text in ("", '{"schema": "otr/summ', "[]", "3"):
        path.write_text(text)
        with pytest.raises(PipelineError, match=re.escape(str(path))):
            write_table_4_1(tmp_path)
    assert not (tmp_path / "tables").exists()


def test_runs_in_other_environments_are_shown(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-6/quick/seed-0", 100.0)
    before = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    assert "Other environments" not in before
    for seed, mean in enumerate((100.0, 130.0, 160.0)):
        policies = {"pruned_tree": {"return_mean": mean, "return_std": 1.0, "n_episodes": 100}}
        changes = {"task": "discrete", "policies": policies, "pruned_leaves": 4}
        write_run(tmp_path, f"CartPole-v1/otr/depth-2/smoke/seed-{seed}", 0.0, **changes)
    text = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    assert text.startswith(before.rstrip("\n"))
    (line,) = [line for line in text.splitlines() if line.startswith("| CartPole-v1")]
    assert line.replace(" ", "") == "|CartPole-v1|OTR|2|smoke||130.0±30.0|3|4|"
