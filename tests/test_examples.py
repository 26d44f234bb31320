"""The examples in the docstrings of otr do what they show; each public function has some, and so have main classes."""

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

PUBLIC = [getattr(otr, name) for name in otr.__all__]
FUNCTIONS = [each for each in PUBLIC if not inspect.isclass(each)]
CLASSES = [each for each in (*PUBLIC, *(getattr(otr.learners, name) for name in otr.learners.__all__))
           if inspect.isclass(each) and "Examples:" in (inspect.getdoc(each) or "")]  # fmt: skip
MAIN_CLASSES = {otr.ReluNetwork, otr.ObliqueTree, otr.PatternTree, otr.Certificate, otr.Condition, otr.HalfSpace,
                otr.SearchSettings, otr.Rollout, otr.learners.OTRClassifier, otr.learners.CARTClassifier}  # fmt: skip

torch.set_num_threads(1)


def what_is_wrong(public: Callable[..., Any]) -> str:
    """Return what is wrong with the examples, which begin where otr and np are imported, or nothing."""
    documented = inspect.getdoc(public) or ""
    examples = doctest.DocTestParser().get_examples(documented.partition("Examples:")[2])
    lines = sum(example.source.count("\n") for example in examples)
    if not any(doctest.SKIP not in example.options for example in examples):
        return "it has no section Examples with lines that run"
    if not 1 <= lines <= 6 or re.search(r"Examples?:", documented.partition("Examples:")[0]):
        return f"it has {lines} lines of examples, expected 1 to 6 in one section Examples at the end"
    test = doctest.DocTest(examples, {"otr": otr, "np": np}, public.__name__, None, None, documented)
    shown = list[str]()
    doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=shown.append)
    return "".join(shown)


@pytest.mark.parametrize("documented", [*FUNCTIONS, *CLASSES], ids=lambda each: each.__name__)
def test_the_examples_run(
    documented: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert what_is_wrong(documented) == ""


def test_the_main_classes_have_examples() -> None:
    assert set(CLASSES) >= MAIN_CLASSES


def test_the_example_of_the_package_runs() -> None:
    assert doctest.testmod(otr).failed == 0
