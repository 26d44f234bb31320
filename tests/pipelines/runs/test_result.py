"""What a finished run shows in a terminal."""

import pytest

from pipelines.cli.runs import load_config
from pipelines.engine.store import read_json
from pipelines.runs.derived import opened_run
from pipelines.runs.result import _fewer_answers, show_result
from tests.committed import RESULTS

PROGRAM = """if 1 + x <= 0 then
    return left
else
    return right
"""


def test_a_program_shorter_than_its_tree_says_why():
    assert _fewer_answers(PROGRAM, 2) == []
    (told,) = _fewer_answers(PROGRAM, 3)
    assert told == "the program writes 3 leaves as 2: tests whose two sides answer the same are left out"
    assert _fewer_answers("", 3) == []


@pytest.mark.parametrize(("kept", "stage"), [(True, "polish"), (False, "prune")])
def test_the_program_shown_is_the_last_one(kept, stage, capsys):
    run = RESULTS / "runs/mountaincar/otr/depth-1/standard-ars/seed-4"
    summary = read_json(run / "summary.json")
    assert summary["polish"]["kept"]
    summary["polish"]["kept"] = kept
    with opened_run(load_config(run, 1), run) as whole:
        show_result(summary, run, whole, load_config(run, None).env)
        program = (whole / stage / "program.txt").read_text(encoding="utf-8")
    printed = capsys.readouterr().out
    assert printed.startswith(f"\n{program.rstrip()}\n") and printed.count("return ") >= 2
    assert ("the program is the polished tree's" in printed) == kept
