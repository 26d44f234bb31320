"""Table 4.1 from made-up runs with known returns: which runs count, what is computed of them, how it is written."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.report.table_4_1 import write_table_4_1
from tests.pipelines.report.conftest import write_run

QUICK = {0: 100.0, 1: 130.0, 2: 160.0}  # mean 130, standard deviation 30 with n - 1


def write_runs(results_dir: Path, where: str, returns: dict[int, float], **changes: Any) -> None:
    for seed, return_mean in returns.items():
        write_run(results_dir, f"{where}/seed-{seed}", return_mean, **changes)


def csv_cells(results_dir: Path) -> dict[tuple[str, str, str, str], dict[str, str]]:
    path = write_table_4_1(results_dir)[1]
    return {(row["table"], row["task"], row["method"], row["depth"]): row for row in read_csv(path)}


def hopper(results_dir: Path) -> dict[str, str]:
    return csv_cells(results_dir)["4.1", "hopper", "otr", "6"]


def markdown_lines(results_dir: Path, start: str) -> list[list[str]]:
    lines = write_table_4_1(results_dir)[0].read_text(encoding="utf-8").splitlines()
    rows = [[text.strip() for text in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in rows if row[0] == start]


def test_cell_has_mean_std_interval_and_published_number(tmp_path: Path) -> None:
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    assert hopper(tmp_path) == {
        "table": "4.1", "task": "hopper", "method": "otr", "depth": "6",
        "mean": "130.0", "std": "30.0", "ci_low": "", "ci_high": "", "n_runs": "3", "n_episodes": "100",
        "budget": "quick", "trainer": "sb3", "published_mean": "3641.5", "published_std": "126.9", "note": "",
    }  # fmt: skip
    write_run(tmp_path, "hopper/otr/depth-6/quick/seed-3", 1.0, n_episodes=40)
    assert hopper(tmp_path)["note"] == "episodes differ between runs: 40 to 100"
    write_run(tmp_path, "hopper/viper/depth-6/quick/seed-0", 100.0)
    write_run(tmp_path, "hopper/linear/depth-0/quick/seed-0", 10.0)
    write_runs(tmp_path, "hopper/otr/depth-0/quick", {0: 50.0, 1: 20.0})  # the linear policy; a seed counts once
    cells = csv_cells(tmp_path)
    one, linear = cells["4.1", "hopper", "viper", "6"], cells["4.1", "hopper", "linear", "0"]
    assert [one[name] for name in ("mean", "std", "ci_low", "ci_high", "n_runs")] == ["100.0", "", "", "", "1"]
    assert (linear["mean"], linear["n_runs"]) == ("15.0", "2")


def test_the_thesis_budget_comes_first_and_is_never_mixed(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-6/thesis/seed-0", 3500.0)
    assert hopper(tmp_path)["budget"] == "thesis"
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)  # several come before one
    cell = hopper(tmp_path)
    assert (cell["n_runs"], cell["budget"], cell["note"]) == ("3", "quick", "also run: 1 run, thesis")
    write_run(tmp_path, "hopper/otr/depth-6/thesis/seed-1", 3510.0)
    cell = hopper(tmp_path)
    assert (cell["mean"], cell["n_runs"], cell["budget"]) == ("3505.0", "2", "thesis")
    assert cell["note"] == "also run: 3 runs, quick"
    for run in ("hopper/otr/depth-6/thesis/seed-3~0a1b2c3d", "hopper_v5/otr/depth-6/thesis/seed-0",
                "hopper/otr/depth-6/smoke-fleet/seed-0"):  # fmt: skip
        write_run(tmp_path, run, 9999.0)  # of other settings, another version, and too short
    other = csv_cells(tmp_path)["other", "hopper", "otr", "6"]
    assert (other["n_runs"], other["budget"], other["mean"]) == ("3", "quick", "130.0")
    shown, beyond = markdown_lines(tmp_path, "Hopper")[0], markdown_lines(tmp_path, "Hopper")[-1]
    assert "3505.0 ± 7.1 (2 runs, thesis)" in shown and "(3 runs, quick)" in " ".join(beyond)
    write_run(tmp_path, "hopper/viper/depth-6/thesis/seed-0", 10.0, trainer="fleet")  # nor are trainers
    write_run(tmp_path, "hopper/viper/depth-6/thesis/seed-1", 20.0)
    cell = csv_cells(tmp_path)["4.1", "hopper", "viper", "6"]
    assert (cell["mean"], cell["trainer"], cell["note"]) == ("20.0", "sb3", "also run: 1 run, thesis, fleet")


def test_order_of_budgets(tmp_path: Path) -> None:
    for budget in ("zeta", "alpha", "quick-fleet", "quick", "thesis-fleet", "thesis"):  # the last one written is chosen
        write_run(tmp_path, f"hopper/otr/depth-6/{budget}/seed-0", 1.0)
        if budget != "zeta":
            assert hopper(tmp_path)["budget"] == budget
    assert hopper(tmp_path)["note"].split("; ") == [
        f"also run: 1 run, {budget}" for budget in ("thesis-fleet", "quick", "quick-fleet", "alpha", "zeta")
    ]


def test_same_runs_give_the_same_bytes(tmp_path: Path) -> None:
    for name, seeds in (("a", range(12)), ("b", reversed(range(12)))):  # written in another order
        write_runs(tmp_path / name, "hopper/otr/depth-6/quick", {seed: 1.1**seed for seed in seeds})
    first, second = ({path.name: path.read_bytes() for path in write_table_4_1(tmp_path / name)} for name in "ab")
    assert first == second and sorted(first) == ["table_4_1.csv", "table_4_1.md", "table_4_1.tex"]


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path: Path) -> None:
    write_runs(tmp_path, "pendulum/otr/depth-32/my_budget", {0: -150.0, 1: -160.0})
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
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    before = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    assert "Other environments" not in before
    for seed, mean in QUICK.items():
        policies = {"pruned_tree": {"return_mean": mean, "return_std": 1.0, "n_episodes": 100}}
        changes = {"task": "discrete", "policies": policies, "pruned_leaves": 4}
        write_run(tmp_path, f"CartPole-v1/otr/depth-2/smoke/seed-{seed}", 0.0, **changes)
    row = ["CartPole-v1", "OTR", "2", "smoke", "", "130.0 ± 30.0", "3", "4"]
    assert markdown_lines(tmp_path, "CartPole-v1") == [row]
    assert write_table_4_1(tmp_path)[0].read_text(encoding="utf-8").startswith(before.rstrip("\n"))
