"""Table 4.1 from made-up runs with known returns: which runs count, what is computed of them, how it is written."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.report.cells import CSV_COLUMNS
from pipelines.report.published import Published, published
from pipelines.report.table_4_1 import write_table_4_1
from tests.pipelines.report.conftest import write_run

QUICK = {0: 100.0, 1: 130.0, 2: 160.0}  # mean 130, standard deviation 30 with n - 1


def write_runs(results_dir: Path, where: str, returns: dict[int, float], **changes: Any) -> None:
    for seed, return_mean in returns.items():
        write_run(results_dir, f"{where}/seed-{seed}", return_mean, **changes)


def csv_cells(results_dir: Path) -> dict[tuple[str, str, str, str], dict[str, str]]:
    """Return the CSV's rows under (table, task, method, depth)."""
    path = write_table_4_1(results_dir)[1]
    return {(row["table"], row["task"], row["method"], row["depth"]): row for row in read_csv(path)}


def hopper(results_dir: Path) -> dict[str, str]:
    return csv_cells(results_dir)["4.1", "hopper", "otr", "6"]


def markdown_lines(results_dir: Path, start: str) -> list[list[str]]:
    """Return the cells of the Markdown lines whose first cell is `start`."""
    lines = write_table_4_1(results_dir)[0].read_text(encoding="utf-8").splitlines()
    rows = [[text.strip() for text in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in rows if row[0] == start]


# --- numbers ------------------------------------------------------------------------------------------------------


def test_cell_has_mean_std_interval_and_published_number(tmp_path: Path) -> None:
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    assert hopper(tmp_path) == {
        "table": "4.1", "task": "hopper", "method": "otr", "depth": "6",
        "mean": "130.0", "std": "30.0", "ci_low": "", "ci_high": "", "n_runs": "3", "n_episodes": "100",
        "budget": "quick", "trainer": "sb3", "published_mean": "3641.5", "published_std": "126.9", "note": "",
    }  # fmt: skip


def test_five_runs_have_an_interval(tmp_path: Path) -> None:
    write_runs(tmp_path, "hopper/otr/depth-6/quick", {seed: 100.0 + 10 * seed for seed in range(5)})
    # Mean 120, standard error sqrt(250 / 5); the 97.5 % quantile of Student's t with 4 degrees of freedom is 2.7764.
    assert (hopper(tmp_path)["ci_low"], hopper(tmp_path)["ci_high"]) == ("100.367568", "139.632432")


def test_one_run_has_no_std_and_two_have_no_interval(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-6/quick/seed-0", 100.0)
    write_runs(tmp_path, "hopper/viper/depth-6/quick", {0: 100.0, 1: 102.0})
    cells = csv_cells(tmp_path)
    one, two = cells["4.1", "hopper", "otr", "6"], cells["4.1", "hopper", "viper", "6"]
    assert [one[name] for name in ("mean", "std", "ci_low", "ci_high", "n_runs")] == ["100.0", "", "", "", "1"]
    assert [two[name] for name in ("mean", "std", "ci_low", "ci_high", "n_runs")] == ["101.0", "1.414214", "", "", "2"]


def test_csv_has_the_thesis_rows_and_columns_in_order(tmp_path: Path) -> None:
    rows = read_csv(write_table_4_1(tmp_path)[1])
    assert tuple(rows[0]) == CSV_COLUMNS
    assert list(dict.fromkeys(row["task"] for row in rows if row["table"] == "4.1")) == [
        "reacher", "walker2d", "hopper", "halfcheetah", "ant", "swimmer", "bipedalwalker", "pendulum",
    ]  # fmt: skip
    assert [(row["method"], row["depth"]) for row in rows[:8]] == [
        ("linear", "0"), ("oracle", ""), ("viper", "6"), ("lm-viper", "6"), ("ndps", "6"), ("pi-prl", "6"),
        ("otr", "6"), ("otr", "32"),
    ]  # fmt: skip
    assert len(rows) == 8 * 8 + 7
    assert all((row["n_runs"], row["mean"], row["budget"], row["note"][:7]) == ("0", "", "", "not run") for row in rows)
    assert all((row["published_mean"] == "") == (row["method"] in ("linear", "oracle")) for row in rows)


def test_fewest_episodes_are_given_and_a_difference_is_noted(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-6/quick/seed-0", 1.0)
    write_run(tmp_path, "hopper/otr/depth-6/quick/seed-1", 1.0, n_episodes=40)
    assert hopper(tmp_path)["n_episodes"] == "40"
    assert hopper(tmp_path)["note"] == "episodes differ between runs: 40 to 100"


def test_pruned_depth_is_averaged_over_runs_and_set_beside_the_published(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-32/quick/seed-0", 100.0, pruned_depth=8.0)
    write_run(tmp_path, "hopper/otr/depth-32/quick/seed-1", 104.0, pruned_depth=9.0)
    assert csv_cells(tmp_path)["4.1", "hopper", "otr", "32"]["note"] == "pruned depth 8.5 (published 9.6)"
    assert markdown_lines(tmp_path, "Hopper")[0][-1] == "102.0 ± 2.8 [8.5] (2 runs, quick)"
    write_run(tmp_path, "hopper/otr/depth-32/quick/seed-2", 102.0, pruned_depth=None)
    assert markdown_lines(tmp_path, "Hopper")[0][-1] == "102.0 ± 2.0 (3 runs, quick)"


# --- oracles ------------------------------------------------------------------------------------------------------


def test_the_oracle_s_own_return_stands_beside_those_that_imitate_it(tmp_path: Path) -> None:
    for method, share in (("viper", 0.5), ("ndps", 0.9)):
        for seed, mean in QUICK.items():
            own = {"oracle": {"return_mean": 2 * mean, "n_episodes": 100}}
            run = f"hopper/{method}/depth-6/quick/seed-{seed}"
            write_run(tmp_path, run, share * mean, policies=own, oracle={"hidden_widths": [256, 256]})
    cell = csv_cells(tmp_path)["4.1", "hopper", "oracle", ""]
    assert (cell["mean"], cell["std"], cell["n_runs"]) == ("260.0", "60.0", "3")  # each oracle once
    assert cell["note"] == "hidden layers [256,256]"
    ours = markdown_lines(tmp_path, "Hopper")[0]
    assert ours[3] == "260.0 ± 60.0 of [256, 256] (3 runs, quick)"
    assert ours[6] == "117.0 ± 27.0 (3 runs, quick)"


# --- forms --------------------------------------------------------------------------------------------------------


def test_a_polished_policy_has_a_row_beyond_the_table_and_the_tree_keeps_its_cell(tmp_path: Path) -> None:
    for seed, mean in QUICK.items():
        polish = {"return_mean": mean + 60.0, "return_std": 1.0, "n_episodes": 100, "kept": True}
        write_run(tmp_path, f"hopper/otr/depth-6/quick/seed-{seed}", mean, polish=polish)
    assert hopper(tmp_path)["mean"] == "130.0"
    row = csv_cells(tmp_path)["text", "hopper", "otr-polished", "6"]
    assert (row["mean"], row["std"], row["n_runs"], row["budget"]) == ("190.0", "30.0", "3", "quick")
    lines = [line for line in markdown_lines(tmp_path, "Hopper") if line[1] == "OTR, polished"]
    assert [line[2:4] for line in lines] == [["6", "190.0 ± 30.0 (3 runs, quick)"]]


# --- which runs count ---------------------------------------------------------------------------------------------


def test_the_thesis_budget_comes_first_and_is_never_mixed(tmp_path: Path) -> None:
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    write_runs(tmp_path, "hopper/otr/depth-6/thesis", {0: 3500.0, 1: 3510.0})
    cell = hopper(tmp_path)
    assert (cell["mean"], cell["n_runs"], cell["budget"]) == ("3505.0", "2", "thesis")
    assert cell["note"] == "also run: 3 runs, quick"
    other = csv_cells(tmp_path)["other", "hopper", "otr", "6"]
    assert (other["n_runs"], other["budget"]) == ("3", "quick")
    assert other["mean"] == "130.0"
    shown, beyond = markdown_lines(tmp_path, "Hopper")[0], markdown_lines(tmp_path, "Hopper")[-1]
    assert "3505.0 ± 7.1 (2 runs, thesis)" in shown and "(3 runs, quick)" in " ".join(beyond)


def test_one_run_of_the_thesis_budget_yields_to_several_of_another(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-6/thesis/seed-0", 3500.0)
    assert hopper(tmp_path)["budget"] == "thesis"
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    cell = hopper(tmp_path)
    assert (cell["n_runs"], cell["budget"], cell["note"]) == ("3", "quick", "also run: 1 run, thesis")


def test_order_of_budgets(tmp_path: Path) -> None:
    for budget in ("zeta", "alpha", "quick-fleet", "quick", "thesis-fleet", "thesis"):  # the last one written is chosen
        write_run(tmp_path, f"hopper/otr/depth-6/{budget}/seed-0", 1.0)
        if budget != "zeta":
            assert hopper(tmp_path)["budget"] == budget
    assert hopper(tmp_path)["note"].split("; ") == [
        f"also run: 1 run, {budget}" for budget in ("thesis-fleet", "quick", "quick-fleet", "alpha", "zeta")
    ]


def test_trainers_are_never_mixed_and_sb3_comes_first(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/otr/depth-6/thesis/seed-0", 10.0, trainer="fleet")
    assert markdown_lines(tmp_path, "Hopper")[0][8] == "10.0 (1 run, thesis, fleet)"
    write_run(tmp_path, "hopper/otr/depth-6/thesis/seed-1", 20.0)
    cell = hopper(tmp_path)
    assert (cell["mean"], cell["trainer"], cell["note"]) == ("20.0", "sb3", "also run: 1 run, thesis, fleet")


def test_other_settings_versions_and_smoke_runs_are_left_out(tmp_path: Path) -> None:
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    before = [path.read_bytes() for path in write_table_4_1(tmp_path)]
    write_run(tmp_path, "hopper/otr/depth-6/quick/seed-3~0a1b2c3d", 9999.0)
    write_run(tmp_path, "hopper_v5/otr/depth-6/thesis/seed-0", 9999.0)
    write_run(tmp_path, "hopper/otr/depth-6/smoke/seed-0", 9999.0)
    write_run(tmp_path, "hopper/otr/depth-6/smoke-fleet/seed-0", 9999.0)
    write_run(tmp_path, "lunarlander/otr/depth-2/smoke/seed-0", 9999.0)
    assert [path.read_bytes() for path in write_table_4_1(tmp_path)] == before


def test_otr_of_depth_0_is_the_linear_policy_and_a_seed_counts_once(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/linear/depth-0/quick/seed-0", 10.0)
    write_runs(tmp_path, "hopper/otr/depth-0/quick", {0: 50.0, 1: 20.0})
    cell = csv_cells(tmp_path)["4.1", "hopper", "linear", "0"]
    assert (cell["mean"], cell["n_runs"]) == ("15.0", "2")


def test_folder_names_with_underscores_are_the_thesis_methods(tmp_path: Path) -> None:
    write_run(tmp_path, "hopper/lm_viper/depth-6/quick/seed-0", 11.0)
    write_run(tmp_path, "hopper/pi_prl/depth-6/quick/seed-0", 12.0)
    cells = csv_cells(tmp_path)
    assert cells["4.1", "hopper", "lm-viper", "6"]["mean"] == "11.0"
    assert cells["4.1", "hopper", "pi-prl", "6"]["mean"] == "12.0"
    assert "adaptation" in (tmp_path / "tables/table_4_1.md").read_text(encoding="utf-8")


def test_runs_beyond_the_table_are_listed_against_the_text(tmp_path: Path) -> None:
    write_run(tmp_path, "lunarlander/otr/depth-2/quick/seed-0", 240.0)
    write_run(tmp_path, "lunarlander/otr/depth-5/quick/seed-0", 250.0)  # its tree has depth 8: nothing published
    write_run(tmp_path, "mountaincar/otr/depth-1/quick/seed-0", 93.0)
    write_run(tmp_path, "hopper/otr/depth-8-8/quick/seed-0", 70.0)
    write_run(tmp_path, "hopper/otr/depth-12/quick/seed-0", 80.0)
    rows = [row for row in read_csv(write_table_4_1(tmp_path)[1]) if row["table"] == "text"]
    columns = ("task", "method", "depth", "mean", "published_mean", "published_std")
    assert [tuple(row[name] for name in columns) for row in rows] == [
        ("hopper", "otr", "8-8", "70.0", "", ""),
        ("hopper", "otr", "12", "80.0", "", ""),
        ("pendulum", "pid", "1", "", "-162.6", ""),
        ("mountaincar", "otr", "1", "93.0", "92.8", ""),
        ("lunarlander", "augtree", "2", "", "249.1", ""),
        ("lunarlander", "cdt", "3-3", "", "100", ""),
        ("lunarlander", "otr", "2", "240.0", "269.0", "16.6"),
        ("lunarlander", "otr", "5", "250.0", "", ""),
        ("lunarlander", "sdt-discrete", "5", "", "-88.0", "20.4"),
        ("lunarlander", "sdt-soft", "5", "", "97.8", "10.5"),
    ]
    assert rows[6]["note"].startswith("published as a tree of depth 5")
    assert markdown_lines(tmp_path, "MountainCar")[-1][:5] == ["MountainCar", "OTR", "1", "93.0 (1 run, quick)", "92.8"]


def test_soft_and_discretised_values_stand_beside_the_tree(tmp_path: Path) -> None:
    policies = {
        "soft": {"return_mean": 90.0, "n_episodes": 100},
        "discretised": {"return_mean": -80.0, "n_episodes": 50},
    }
    write_run(tmp_path, "lunarlander/sdt/depth-5/quick/seed-0", 30.0, policies=policies)
    write_run(tmp_path, "lunarlander/cdt/depth-2-2/quick/seed-0", 40.0, policies={"soft": policies["soft"]})
    write_run(tmp_path, "lunarlander/augtree/depth-2/quick/seed-0", 210.0)
    cells = csv_cells(tmp_path)
    columns = ("mean", "published_mean", "n_episodes")
    assert {key[2:]: tuple(row[name] for name in columns) for key, row in cells.items() if key[1] == "lunarlander"} == {
        ("augtree", "2"): ("210.0", "249.1", "100"),
        ("cdt", "2-2"): ("40.0", "100", "100"),
        ("cdt", "3-3"): ("", "100", ""),
        ("cdt-soft", "2-2"): ("90.0", "", "100"),
        ("otr", "2"): ("", "269.0", ""),
        ("sdt", "5"): ("30.0", "", "100"),
        ("sdt-discrete", "5"): ("-80.0", "-88.0", "50"),
        ("sdt-soft", "5"): ("90.0", "97.8", "100"),
    }
    assert "Figure 4.7" in cells["text", "lunarlander", "augtree", "2"]["note"]
    assert ["LunarLander", "SDT, soft", "5"] in [line[:3] for line in markdown_lines(tmp_path, "LunarLander")]


def test_best_pid_policy_stands_beside_the_one_published(tmp_path: Path) -> None:
    for seed, mean in enumerate((-170.0, -155.0, -165.0)):
        policies = {"constant_gains": {"return_mean": 2 * mean, "n_episodes": 1000}}
        write_run(tmp_path, f"pendulum/pid/depth-1/quick/seed-{seed}", mean, policies=policies)
    cells = csv_cells(tmp_path)
    pid, constant = cells["text", "pendulum", "pid", "1"], cells["text", "pendulum", "pid-constant", "1"]
    assert (float(pid["mean"]), pid["published_mean"]) == (pytest.approx(-490 / 3, abs=1e-5), "-162.6")
    assert "published: the one policy of Figure 4.4; the best run: -155.0" in pid["note"]
    assert (float(constant["mean"]), constant["published_mean"]) == (pytest.approx(-980 / 3, abs=1e-5), "")


# --- text ---------------------------------------------------------------------------------------------------------


def test_markdown_sets_ours_over_the_thesis(tmp_path: Path) -> None:
    write_runs(tmp_path, "pendulum/otr/depth-6/quick", {0: -150.0, 1: -160.0, 2: -161.6})
    write_runs(tmp_path, "reacher/otr/depth-6/quick", {0: -5.0, 1: -5.1})
    ours = markdown_lines(tmp_path, "Pendulum")[0]
    assert ours[1:9] == ["ours", *["not run"] * 6, "-157.2 ± 6.3 (3 runs, quick)"]
    assert markdown_lines(tmp_path, "Reacher")[0][8] == "-5.05 ± 0.07 (2 runs, quick)"
    published_line = markdown_lines(tmp_path, "")[-1]
    assert published_line[1:5] == ["thesis", "-", "-", "-196.3 ± 21.8"]
    assert published_line[8:] == ["-138.3 ± 1.0", "-135.0 ± 1.2 [8.4]"]


def test_trees_that_return_otherwise_once_pruned_are_listed(tmp_path: Path) -> None:
    def policies(mean: float) -> dict[str, dict[str, float]]:
        return {
            name: {"return_mean": each, "n_episodes": 100} for name, each in (("tree", 100.0), ("pruned_tree", mean))
        }

    for seed, pruned in ((0, 100.0), (1, 96.0)):
        changes = {"policies": policies(pruned), "fidelity": 0.9 + 0.1 * seed, "pruned_leaves": 7}
        write_run(tmp_path, f"hopper/otr/depth-32/quick/seed-{seed}", 100.0, **changes)
        write_run(tmp_path, f"hopper/otr/depth-6/quick/seed-{seed}", 100.0, policies=policies(99.5))
        # Changes that cancel each other are listed, too, and so are those of polished networks.
        moments = {"return_mean": 50.0, "return_mean_pruned": 60.0, "n_leaves": 9, "n_episodes": 100}
        changes = {"policies": policies(98.0 + 4 * seed), "polish": moments, "pruned_leaves": 8}
        write_run(tmp_path, f"hopper/otr/depth-8/quick/seed-{seed}", 100.0, **changes)
    page = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    listed = [line for line in page.partition("## Once pruned")[2].splitlines() if line.startswith("| Hopper")]
    assert [[cell.strip() for cell in line.split("|")[1:-1]] for line in listed] == [
        ["Hopper", "OTR", "8", "100.0 (2 runs, quick)", "100.0", "-2.0, +2.0 %", "", "8"],
        ["Hopper", "OTR", "32", "100.0 (2 runs, quick)", "98.0", "+0.0, -4.0 %", "95.0 %", "7"],
        ["Hopper", "OTR, polished", "8", "50.0 (2 runs, quick)", "60.0", "+20.0, +20.0 %", "", "9"],
    ]  # fmt: skip


def test_provenance_tells_what_was_run(tmp_path: Path) -> None:
    write_runs(tmp_path, "hopper/otr/depth-6/quick", QUICK)
    write_run(tmp_path, "hopper/otr/depth-32/thesis/seed-0", 1.0, steps=4_000_000, n_episodes=50)
    lines = [line for line in markdown_lines(tmp_path, "Hopper") if line[1] in ("quick", "thesis")]
    assert lines == [
        ["Hopper", "thesis", "sb3", "4,000,000", "SAC", "50", "hopper-id", "1.4.0", "1"],
        ["Hopper", "quick", "sb3", "100,000", "SAC", "100", "hopper-id", "1.4.0", "3"],
    ]


def test_same_runs_give_the_same_bytes(tmp_path: Path) -> None:
    for name, seeds in (("a", range(12)), ("b", reversed(range(12)))):  # written in another order
        write_runs(tmp_path / name, "hopper/otr/depth-6/quick", {seed: 1.1**seed for seed in seeds})
    first, second = ([path.read_bytes() for path in write_table_4_1(tmp_path / name)] for name in "ab")
    assert first == second
    assert first == [path.read_bytes() for path in write_table_4_1(tmp_path / "a")]
    assert sorted(path.name for path in (tmp_path / "a/tables").iterdir()) == [
        "table_4_1.csv", "table_4_1.md", "table_4_1.tex",
    ]  # fmt: skip


def test_latex_is_escaped_and_every_line_has_ten_columns(tmp_path: Path) -> None:
    write_runs(tmp_path, "pendulum/otr/depth-6/my_budget", {0: -150.0, 1: -160.0})
    text = write_table_4_1(tmp_path)[2].read_text(encoding="utf-8")
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(body) == 1 + 8 * 2 + 1
    assert all(line.count("&") == 9 for line in body)
    assert r"$-$155.0 $\pm$ 7.1" in text
    assert r"2 runs, my\_budget" in text
    assert not re.search("[±π–]", "".join(body))


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path: Path) -> None:
    write_runs(tmp_path, "pendulum/otr/depth-32/my_budget", {0: -150.0, 1: -160.0})
    write_table_4_1(tmp_path)
    document = r"\documentclass{article}\usepackage{booktabs}\begin{document}\input{table_4_1}\end{document}"
    (tmp_path / "tables/paper.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path / "tables", capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout[-2000:]


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": "otr/summary/9"}, "schema 'otr/summary/9' where 'otr/summary/1' was expected"),
        ({"return_mean": float("nan")}, "return_mean is nan where a number was expected"),
        ({"return_mean": None}, "return_mean is None where a number was expected"),
        ({"versions": {}}, "it has no 'versions.gymnasium'"),
        ({"seed": 1}, "describes the run hopper/otr/depth-6/quick/seed-1, not the one whose folder it is in"),
        ({"method": "viper"}, "describes the run hopper/viper/depth-6/quick/seed-0"),
        ({"depth": 7}, "describes the run hopper/otr/depth-7/quick/seed-0"),
    ],
)
def test_wrong_summary_is_an_error_that_names_it(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write_run(tmp_path, "hopper/otr/depth-6/quick/seed-0", 1.0, **changes)
    with pytest.raises(PipelineError, match=f"(?s){re.escape(str(path))}.*{re.escape(message)}"):
        write_table_4_1(tmp_path)


@pytest.mark.parametrize("text", ["", '{"schema": "otr/summ', "[]", "3"])
def test_broken_summary_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    path = write_run(tmp_path, "hopper/otr/depth-6/quick/seed-0", 1.0)
    path.write_text(text)
    with pytest.raises(PipelineError, match=re.escape(str(path))):
        write_table_4_1(tmp_path)
    assert not (tmp_path / "tables").exists()


# --- published numbers and imports --------------------------------------------------------------------------------


def test_published_numbers() -> None:
    numbers = published()
    assert len(numbers) == 85 + 11  # one of them is of 12 depths
    assert numbers["4.1", "hopper", "otr", "6"] == Published("3641.5", "126.9", "10", "")
    assert numbers["4.1", "halfcheetah", "otr", "32"] == Published("10307.9", "1320.6", "10", "11.2")
    assert numbers["4.1", "reacher", "viper", "6"] == Published("-6.31", "0.3", "10", "")
    assert numbers["4.1", "ant", "pi-prl", "6"] == Published("5679.7", "844.3", "3", "")
    note = "published as a tree of depth 5: 2 hidden neurons and the tests of the actions"
    assert numbers["text", "lunarlander", "otr", "2"] == Published("269.0", "16.6", "5", "", note)
    assert sum(float(number.mean) for key, number in numbers.items() if key[0] == "4.1") == pytest.approx(103130.31)


def test_runs_with_other_settings_stand_beside_those_without(tmp_path: Path) -> None:
    write_runs(tmp_path, "lunarlander/ndps/depth-2/quick", QUICK)
    changed = {seed: {0: 90.0, 1: 110.0}[seed] for seed in (0, 1)}
    for seed, return_mean in changed.items():
        run = f"lunarlander/ndps/depth-2/quick/seed-{seed}~0123abcd"
        write_run(tmp_path, run, return_mean, changes="method.leaves=constant")
    text = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    assert [line for line in text.partition("## With other settings")[2].splitlines() if "NDPS" in line] == [
        "| LunarLander | NDPS   | 2     |        | `method.leaves=constant` | 100.0 ± 14.1 (2 runs, quick) | "
        "130.0 ± 30.0 (3 runs, quick) |"
    ]
    assert "0123abcd" not in text


def test_each_side_has_its_own_pruned_depth(tmp_path: Path) -> None:
    write_run(tmp_path, "ant/otr/depth-32/standard/seed-0", 5.0, pruned_depth=8.0)
    write_run(tmp_path, "ant/otr/depth-32/standard/seed-0~0123abcd", 4.0, pruned_depth=9.0, changes="actor.dense=none")
    text = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    (line,) = [line for line in text.splitlines() if "actor.dense" in line]
    assert "4.0 [9.0] (1 run" in line and "5.0 [8.0] (1 run" in line


def test_a_changed_setting_stands_beside_runs_of_its_own_oracle(tmp_path: Path) -> None:
    for digest, changes, width, mean in (
        ("", "", 256, 1.0),
        ("~0123abcd", "oracle=[64]", 64, 2.0),
        ("~9876abcd", "method.features=deep, oracle=[64]", 64, 3.0),
    ):
        policies = {name: {"return_mean": mean, "n_episodes": 100} for name in ("tree", "oracle")}
        own = {"policies": policies, "oracle": {"hidden_widths": [width]}, "changes": changes}
        write_run(tmp_path, f"lunarlander/augtree/depth-4/quick/seed-0{digest}", mean, **own)
    text = write_table_4_1(tmp_path)[0].read_text(encoding="utf-8")
    (line,) = [row for row in text.splitlines() if "features=deep" in row]
    assert [cell.strip() for cell in line.strip("|").split("|")] == [
        "LunarLander", "AugTree", "4", "[64]", "`method.features=deep`", "3.0 (1 run, quick)", "2.0 (1 run, quick)",
    ]  # fmt: skip
    assert "oracle=[64]" not in text  # which is no setting of the method


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
