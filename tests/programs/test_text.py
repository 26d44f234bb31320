import numpy as np
import pytest

import otr
from otr.programs.text import text_of_every_leaf
from otr.programs.walk import affine_expression
from tests.core.strategies import make_network
from tests.core.test_tree import small_tree

# Orfanos 2023, Fig. 4.2: mountain car, position x and velocity v.
MOUNTAIN_CAR = """\
if -2.2 - 3.8 x + 114.3 v <= 0 then
    return -6.1
else
    return -102.3 - 169.8 x + 5116.5 v
"""


def mountain_car(head: otr.Head | None = None) -> otr.ObliqueTree:
    return otr.ObliqueTree(
        [~0], [~1], [[-3.8, 114.3]], [-2.2], [[[0.0, 0.0]], [[-169.8, 5116.5]]], [[-6.1], [-102.3]], head=head
    )


def test_the_program_of_the_thesis() -> None:
    assert otr.to_text(mountain_car(), feature_names=["x", "v"], precision=5) == MOUNTAIN_CAR


def test_heads_are_shown() -> None:
    def last_line(head: otr.Head) -> str:
        return otr.to_text(mountain_car(head), feature_names=["x", "v"], precision=5).splitlines()[1].strip()

    assert last_line(otr.ClipBox(-1, 1)) == "return clip(-6.1, -1, 1)"
    assert last_line(otr.TanhBox(-1, 1)) == "return tanh(-6.1)"
    assert last_line(otr.TanhBox(-2, 2)) == "return 2 tanh(-6.1)"
    assert last_line(otr.TanhBox(0, 1)) == "return 0.5 + 0.5 tanh(-6.1)"
    assert last_line(otr.Sign()) == "return 1 if -6.1 > 0 else 0"


def test_labels() -> None:
    tree = otr.map_network(make_network(np.random.default_rng(0), (), n_outputs=2, head="argmax"))
    assert otr.to_text(tree).splitlines()[1::2] == ["    return 0", "    return 1"]
    assert otr.to_text(tree, output_names=["coast", "fire"]).splitlines()[3] == "    return fire"
    sign = otr.map_network(make_network(np.random.default_rng(0), (), head="sign"))
    assert otr.to_text(sign, output_names=["no", "yes"]).splitlines()[3] == "    return yes"


def test_argmax_without_labels() -> None:
    tree = otr.ObliqueTree([], [], np.zeros((0, 1)), [], [[[1.0], [-2.0]]], [[0.0, 3.0]], head=otr.Argmax())
    assert otr.to_text(tree) == "y0 = x0\ny1 = 3 - 2 x0\nreturn argmax(y0, y1)\n"


@pytest.mark.parametrize(
    ("coefficients", "offset", "text"),
    [
        ([0.0, 0.0], 0.0, "0"),
        ([0.0, 0.0], -1.0, "-1"),
        ([1.0, -1.0], 0.0, "a - b"),
        ([-1.0, 0.0], 0.0, "-a"),
        ([0.00001234567, 1.00001], 2.0, "2 + 1.235e-05 a + b"),
    ],
)
def test_affine_expression(coefficients: list[float], offset: float, text: str) -> None:
    written = affine_expression(
        np.array(coefficients), offset, ["a", "b"], lambda size: f"{size:.4g}", times=" ", tie=" ", leaves_out_ones=True
    )
    assert written == text


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="feature_names has 1 names, expected 2"):
        otr.to_text(mountain_car(), feature_names=["x"])
    with pytest.raises(ValueError, match="precision is 0"):
        otr.to_text(mountain_car(), precision=0)


def test_a_pattern_tree_is_refused_with_the_way_out() -> None:
    network = otr.ReluNetwork([[[1.0]], [[1.0]]], [[0.0], [0.0]])
    with pytest.raises(TypeError, match=r"PatternTree has to_tree\(\)"):
        otr.to_text(otr.PatternTree(network))  # type: ignore[arg-type]


def test_tests_that_decide_nothing_are_not_printed() -> None:
    tree = small_tree(labels=[1, 0, 0])
    assert otr.to_text(tree) == "if x0 <= 0 then\n    return 1\nelse\n    return 0\n"
    assert text_of_every_leaf(tree).count("if ") == 2
    for write in (otr.to_python, otr.to_c, otr.to_structured_text, otr.to_latex, otr.to_dot):
        assert write(tree) == write(otr.ObliqueTree([~0], [~1], [[1.0, 0.0]], [0.0], np.zeros((2, 1, 2)),
                                                    [[10.0], [20.0]], labels=[1, 0]))  # fmt: skip
