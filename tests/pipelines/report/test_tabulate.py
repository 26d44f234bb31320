"""The reports of `otr-tabulate`: which there are, and what is written where little has been run."""

from pathlib import Path

import pandas as pd
import pytest

from pipelines.errors import ConfigError
from pipelines.report import load_runs
from pipelines.report.frames import FIT_COLUMNS, RUN_COLUMNS
from pipelines.report.tabulate import FIGURES, TABLES, reports_of, write_fits, write_runs
from tests.pipelines.conftest import otr_command, otr_succeeds
from tests.pipelines.report.conftest import write_run


def test_words_stand_for_reports_and_those_there_are_are_listed_for_others() -> None:
    assert reports_of("table=4.1") == reports_of("4.1") == ("4.1",) and reports_of("figure=4.6") == ("4.6",)
    assert set(reports_of("all")) == {*TABLES, *FIGURES} - {"runs", "fits"}
    tables = r"Known tables: 4\.1, 4\.2, certificates, comparisons, equal_steps, runs, fits$"
    for words, message in (
        ("table=4.11", rf"table=4\.11 is not known\. Did you mean table=4\.1\? {tables}"),
        ("table=x", rf"table=x is not known\. {tables}"),
        (
            "figure=4.5",
            r"figure=4\.5 is not known.*Known figures: 4\.6, 4\.7, profile, numbers, curves, leaves, regions$",
        ),
        ("certificats", r"certificats is not known\. Did you mean certificates\? Known reports: all"),
    ):
        with pytest.raises(ConfigError, match=message):
            reports_of(words)


@pytest.mark.parametrize(("write", "columns"), [(write_runs, RUN_COLUMNS), (write_fits, FIT_COLUMNS)])
def test_every_column_is_explained(write, columns, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "runs").mkdir()
    markdown, table = write(tmp_path)
    lines = markdown.read_text(encoding="utf-8").splitlines()
    assert tuple(line.split("`")[1] for line in lines if line.startswith("| `")) == (*columns,)
    assert tuple(pd.read_csv(table).columns) == (*columns,)


def test_all_runs_are_written_and_what_has_no_row_is_named(tmp_path: Path) -> None:
    run = "hopper/otr/depth-6/smoke/seed-0~0a1b2c3d"
    write_run(tmp_path, run, 3.5, seconds={"train": 2.25})
    (tmp_path / "runs/hopper/otr/depth-256/quick/seed-0").mkdir(parents=True)
    markdown, table = write_runs(tmp_path)
    (row,) = pd.read_csv(table).to_dict("records")
    assert (row["run"], row["settings"], row["form"]) == (run, "0a1b2c3d", "tree")
    assert (row["return_mean"], row["n_episodes"], row["seconds.train"]) == (3.5, 100, 2.25)
    assert "have no row: hopper/otr/depth-256/quick/seed-0." in markdown.read_text(encoding="utf-8")


def test_a_run_has_a_row_for_each_form_of_its_policy(tmp_path: Path) -> None:
    policies = {"network": {"return_mean": 9.5, "return_std": 1.0, "n_episodes": 50}}
    simplify = {"return_mean": 7.5, "return_std": 2.0, "n_episodes": 40, "n_leaves": 5}
    polish = {"return_mean": 8.75, "return_std": 1.5, "n_episodes": 100, "kept": True}
    run, more = "hopper/otr/depth-8-8/quick-fleet/seed-3", {"pruned_depth": None, "return_std": 0.5}
    write_run(tmp_path, run, 8.5, policies=policies, simplify=simplify, polish=polish, **more)
    runs = load_runs(str(tmp_path)).set_index("form")
    columns = ["return_mean", "return_std", "n_episodes"]
    assert {form: tuple(row) for form, row in runs[columns].iterrows()} == {
        "network": (9.5, 1.0, 50), "tree": (8.5, 0.5, 100), "simplified": (7.5, 2.0, 40),
        "polished": (8.75, 1.5, 100),
    }  # fmt: skip
    assert set(runs["run"]) == {run} and set(runs["depth"]) == {"8-8"} and set(runs["budget"]) == {"quick-fleet"}
    assert (runs["seed"] == 3).all() and runs["pruned_depth"].isna().all() and (runs["simplify.n_leaves"] == 5).all()


def test_all_leaves_out_a_figure_without_runs_and_says_so(tmp_path: Path) -> None:
    write_run(tmp_path / "results", "hopper/otr/depth-6/quick/seed-0", 3.5)
    done = otr_succeeds("otr-tabulate", "all", "budget=smoke", cwd=tmp_path)
    assert "4.7 is left out" in done.stderr and "otr-run +experiment=figure_4_6" in done.stderr
    assert "profile is left out" in done.stderr and "otr-run +experiment=table_4_1" in done.stderr
    assert len(list((tmp_path / "results/tables").iterdir())) == 12
    done = otr_command("otr-tabulate", "4.7", cwd=tmp_path)
    assert done.returncode == 1 and "otr-run +experiment=figure_4_6" in done.stderr
    done = otr_command("otr-tabulate", "rusn", cwd=tmp_path)
    assert done.returncode == 2 and "Did you mean runs?" in done.stderr
    done = otr_command("otr-tabulate", "table=4.1,4.2", cwd=tmp_path)
    assert done.returncode == 2 and "table=4.1,4.2 is not known" in done.stderr
