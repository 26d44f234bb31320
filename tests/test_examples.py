"""The examples in the docstrings of otr's functions do what they show; each public function has some."""

import doctest
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import otr

FUNCTIONS = [name for name in otr.__all__ if not inspect.isclass(getattr(otr, name))]

torch.set_num_threads(1)


def what_is_wrong(function: Callable[..., Any]) -> str:
    """Return what is wrong with a function's examples, which begin where otr and np are imported; else nothing."""
    documented = inspect.getdoc(function) or ""
    examples = doctest.DocTestParser().get_examples(documented.partition("Examples:")[2])
    lines = sum(example.source.count("\n") for example in examples)
    if not any(doctest.SKIP not in example.options for example in examples):
        return "it has no section Examples with lines that run"
    if not 1 <= lines <= 6 or re.search(r"Examples?:", documented.partition("Examples:")[0]):
        return f"it has {lines} lines of examples, expected 1 to 6 in one section Examples at the end"
    test = doctest.DocTest(examples, {"otr": otr, "np": np}, function.__name__, None, None, documented)
    shown = list[str]()
    doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=shown.append)
    return "".join(shown)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_has_examples_that_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert what_is_wrong(getattr(otr, name)) == ""


def test_the_example_of_the_package_runs() -> None:
    assert doctest.testmod(otr).failed == 0
