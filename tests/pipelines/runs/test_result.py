"""What a finished run shows in a terminal."""

from pipelines.runs.result import _fewer_answers

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
