"""Every format, and every proof, has an entry for every head."""

import importlib
import pkgutil
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import otr
import otr.programs
import otr.proof
from otr.core.heads import HEADS
from otr.programs.names import shown_names
from tests.core.test_head import KNOWN

FORMATS: dict[str, Callable[[otr.ObliqueTree], object]] = {
    name: getattr(otr, name) for name in otr.__all__ if name.startswith("to_") and name != "to_fixed_point"
}
IN_INTEGERS = {otr.Identity, otr.ClipBox, otr.TanhBox, otr.Sign, otr.Argmax}


def dispatches(package: Any) -> dict[str, Any]:
    """Return the functions of a package's modules that `functools.singledispatch` chooses by the head."""
    names = [info.name for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")]
    functions = {
        f"{name}.{key}": value
        for name in names
        for key, value in vars(importlib.import_module(name)).items()
        if hasattr(value, "registry") and getattr(value, "__module__", "") == name
    }
    return {name: function for name, function in functions.items() if otr.Identity in function.registry}


def leaf_of(head: otr.Head, n_outputs: int) -> otr.ObliqueTree:
    rng = np.random.default_rng(0)
    none: list[int] = []
    M, c = rng.normal(size=(1, n_outputs, 2)), rng.normal(size=(1, n_outputs))
    return otr.ObliqueTree(none, none, np.zeros((0, 2)), none, M, c, head=head)


def test_there_is_a_head_of_every_kind_to_try() -> None:
    assert {name: type(head) for name, (head, _) in KNOWN.items()} == HEADS


def test_every_format_has_an_entry_for_every_head() -> None:
    found = dispatches(otr.programs)
    of_integers = {name: found.pop(name) for name in list(found) if "fixed_point" in name}
    assert len(of_integers) == 2
    for name, function in of_integers.items():
        assert set(function.registry) == {*IN_INTEGERS, object}, name
    bounded = found.pop("otr.programs.c.float_error._after_head")  # which refuses PidBox before
    assert set(bounded.registry) == {*HEADS.values(), object} - {otr.PidBox}
    assert {name.split(".")[2] for name in found} == {"c", "notation", "onnx", "picture", "python", "structured_text"}
    for name, function in found.items():
        assert set(function.registry) == {*HEADS.values(), object}, name


def test_proofs_have_an_entry_for_every_head_that_acts_by_output() -> None:
    (function,) = dispatches(otr.proof).values()
    assert set(function.registry) == {object, *(head for head in HEADS.values() if head.acts_by_output)}


@pytest.mark.parametrize("name", sorted(HEADS))
def test_every_format_writes_a_tree_of_every_head(name: str) -> None:
    tree = leaf_of(*KNOWN[name])
    for write in FORMATS.values():
        assert write(tree)
    scope: dict[str, Any] = {}
    exec(otr.to_python(tree), scope)
    for state in np.random.default_rng(1).normal(size=(20, 2)):
        np.testing.assert_allclose(scope["policy"](state.tolist()), tree.predict(state), rtol=1e-12, atol=1e-12)
    _, answers = shown_names(tree, None, None)
    assert len(answers) == tree.head.n_answers(tree.n_outputs)


class Doubled(otr.Head):
    """A head that no format knows."""

    name = "doubled"

    def __call__(self, Y: np.ndarray) -> np.ndarray:
        return 2 * Y


@pytest.mark.parametrize("name", sorted(set(FORMATS) - {"to_json"}))  # which writes the head's own description
def test_a_head_without_an_entry_is_refused(name: str) -> None:
    with pytest.raises(TypeError, match=" has no entry for the head Doubled; register one next to the other heads'"):
        FORMATS[name](leaf_of(Doubled(), 1))
    with pytest.raises(TypeError, match="a proof has no entry for the head Doubled"):
        condition = otr.Condition(np.zeros(2), np.ones(1), 1.0)
        otr.find_violation(leaf_of(Doubled(), 1), condition, (-np.ones(2), np.ones(2)))
