"""Text fits a terminal, cut between words alone, and loses nothing where there is none."""

import io

import numpy as np
import pytest

import otr
from pipelines.cli.main import HELP
from pipelines.engine.wrapping import UNLIMITED, columns, fitted, fitted_help

PROGRAM = """if 1.527 + 0.598 position - 77.4 velocity <= 0 then
    if position - 0.25 velocity + 3.5 <= 0 then
        return clip(3.651 + 1.5 position - 2.25 velocity, -1, 1)
    else
        return clip(0.5 velocity, -1, 1)
else
    return clip(-2.932 - 2.577 position + 333.6 velocity, -1, 1)
"""


@pytest.mark.parametrize("width", [30, 45, 60])
def test_a_program_that_is_cut_is_the_same_program(width):
    text = fitted(PROGRAM, width)
    assert max(map(len, text.split("\n"))) <= width and text.split() == PROGRAM.split()
    whole, cut = (otr.parse_program(each, ["position", "velocity"]) for each in (PROGRAM, text))
    states = np.random.default_rng(0).normal(size=(50, 2)) * 5
    np.testing.assert_array_equal(cut.predict(states), whole.predict(states))
    assert fitted(PROGRAM, UNLIMITED) == PROGRAM


def test_numbers_stay_with_their_units_and_a_pipe_has_no_end(monkeypatch):
    assert fitted("it takes about some 19 min", 22) == "it takes about some\n    19 min"
    assert fitted(f"artefacts: {'runs/' * 20}", 30) == f"artefacts:\n    {'runs/' * 20}"  # longer than the width
    monkeypatch.setenv("COLUMNS", "60")
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    assert (columns(terminal), columns(io.StringIO())) == (60, UNLIMITED)


@pytest.mark.parametrize("name", sorted(path.name for path in HELP.glob("*.txt")))
def test_help_fits_and_keeps_its_words_in_order(name):
    text = (HELP / name).read_text()
    narrow = fitted_help(text, 60)
    assert narrow.split() == text.split()
    assert all(len(line) <= 60 or len(line.split()) <= 1 for line in narrow.split("\n"))
    assert fitted_help(text, 130) == text


def test_descriptions_are_filled_in_their_column():
    options = "overrides:\n  env=hopper      one two three\n                  four five six"
    text = f"{options}\n\nexamples:\n  otr-run env=hopper"
    assert fitted_help(text, 30).split("\n")[:3] == [
        "overrides:",
        "  env=hopper      one two",
        "      three four five six",
    ]
    assert fitted_help(text, 31) == text
    filled = options.replace("three\n", "three four\n").replace("  four five six", "  five six seven")
    assert fitted_help(f"{options} seven", 36) == filled
