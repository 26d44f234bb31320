"""What is still to be run: counted from the runs that there are, until there are five of each policy."""

import re
import shlex
from pathlib import Path

import pandas as pd
import pytest

from pipelines.cli.runs import RUN
from pipelines.report import to_run
from pipelines.report.cells import SHRUNK
from pipelines.report.to_run import WANTED


def rows(method: str, depth: str, n: int, changes: str | None = None) -> pd.DataFrame:
    own = {"task": "hopper", "method": method, "depth": depth, "budget": "standard-ars", "changes": changes}
    return pd.DataFrame([own | {"seed": seed} for seed in range(n)])


def test_policies_are_counted_until_five_runs_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = to_run.Wanted("searches", ("hopper",), ("otr",), ("6", "32"), "standard-ars", "otr-run env={tasks}")
    monkeypatch.setattr(to_run, "WANTED", (wanted,))
    some = pd.concat([rows("otr", "6", 3), rows("otr", "32", 4, "algo.noise=0.1"), rows("linear", "32", 5)])
    assert to_run.to_run(some)[1:] == [["searches", "1 with 3 of 5, 1 with none", "`otr-run env=hopper`"]]
    assert to_run.to_run(pd.concat([rows("otr", "6", 5), rows("otr", "32", 6)]))[1:] == []


def test_networks_that_the_recipe_shrinks_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = to_run.Wanted("shrunk", ("hopper",), (SHRUNK,), ("6",), "standard-shrink", "otr-run env={tasks}")
    monkeypatch.setattr(to_run, "WANTED", (wanted,))
    some = rows("otr", "6", 3).assign(budget="standard-shrink")
    assert to_run.to_run(some)[1:] == [["shrunk", "1 with 3 of 5", "`otr-run env=hopper`"]]


@pytest.mark.parametrize("wanted", WANTED, ids=lambda wanted: wanted.what)
def test_the_commands_make_the_policies_that_are_counted(wanted: to_run.Wanted) -> None:
    words = shlex.split(wanted.command.format(tasks=wanted.tasks[-1]))[2:]
    for own in RUN.expand(words, True)[:1]:
        (job,) = RUN.jobs([own])
        RUN.check(job.config)
        assert job.run_dir.parent.name == wanted.budget and job.config.changes == wanted.changes
        assert job.config.method.name.replace("_", "-") in wanted.methods[0]
        assert job.run_dir.parent.parent.name.removeprefix("depth-") in wanted.depths


def test_the_commands_for_the_table_s_cells_name_its_tasks_once_each() -> None:
    page = (Path(to_run.__file__).parent / "pages/table_4_1.md").read_text(encoding="utf-8")
    commands = re.findall(r"^\* `otr-run (.*)`", page, flags=re.MULTILINE)
    folders = [job for each in commands for job in RUN.expand(shlex.split(each.removeprefix("-m ")), True)]
    tasks = [next(word for word in own if word.startswith("env=")) for own in folders]
    counts = {task: tasks.count(f"env={task}") for task in to_run.EIGHT}
    assert counts == dict.fromkeys(to_run.EIGHT, 7 * 5)  # columns, seeds
