import numpy as np
import pytest

import otr
from otr.core.head import head_from_dict


def test_tanh_box_spans_the_box() -> None:
    head = otr.TanhBox([-2.0, 0.0], [2.0, 1.0])
    answers = head(np.array([[0.0, 0.0], [50.0, -50.0], [np.arctanh(0.5), np.arctanh(-0.5)]]))
    np.testing.assert_allclose(answers, [[0.0, 0.5], [2.0, 0.0], [1.0, 0.25]], atol=1e-15)


def test_clip_box() -> None:
    head = otr.ClipBox([-1.0, -2.0], [1.0, 2.0])
    assert head(np.array([-3.0, 1.5])).tolist() == [-1.0, 1.5]


def test_heads_do_not_change_their_argument() -> None:
    Y = np.array([[0.5], [-3.0]])
    for head in (otr.TanhBox(-1, 1), otr.ClipBox(-1, 1), otr.Sign(), otr.Argmax()):
        head(Y)
    assert Y.tolist() == [[0.5], [-3.0]]


def test_sign_sends_zero_to_label_zero() -> None:
    assert otr.Sign()(np.array([[-1.0], [0.0], [1e-300]])).tolist() == [0, 0, 1]


def test_argmax_tournament_equals_numpy_on_ties() -> None:
    head = otr.Argmax()
    Y = np.random.default_rng(0).integers(0, 3, (500, 4)).astype(float)
    outcomes = head.tests(Y)
    np.testing.assert_array_equal(head.labels(outcomes), Y.argmax(axis=1))
    champions = head.champions(outcomes)
    rows = np.arange(len(Y))
    for test in range(3):
        np.testing.assert_array_equal(outcomes[:, test], Y[:, test + 1] - Y[rows, champions[:, test]] > 0)


def test_number_of_tests() -> None:
    assert [head.n_tests(4) for head in (otr.Identity(), otr.TanhBox(0, 1), otr.ClipBox(0, 1), otr.Argmax())] == [
        0,
        0,
        0,
        3,
    ]
    assert otr.Sign().n_tests(1) == 1


@pytest.mark.parametrize(
    "head", [otr.Identity(), otr.TanhBox(-1, 2), otr.ClipBox([-1.0, -0.1], [2.0, 0.3]), otr.Sign(), otr.Argmax()]
)
def test_description_round_trip(head: otr.Head) -> None:
    assert head_from_dict(head.to_dict()) == head
    assert hash(head_from_dict(head.to_dict())) == hash(head)


def test_unlike_heads_differ() -> None:
    assert otr.TanhBox(-1, 1) != otr.ClipBox(-1, 1)
    assert otr.TanhBox(-1, 1) != otr.TanhBox(-1, 2)


@pytest.mark.parametrize(
    ("low", "high"), [(1.0, 1.0), (0.0, np.inf), (np.nan, 1.0), ([0.0], [1.0, 2.0]), ([[0.0]], [[1.0]])]
)
def test_boxes_that_are_none_are_refused(low: object, high: object) -> None:
    for box in (otr.TanhBox, otr.ClipBox):
        with pytest.raises(otr.InvalidNetworkError, match="low"):
            box(low, high)


def test_heads_that_do_not_fit_are_refused() -> None:
    with pytest.raises(otr.InvalidNetworkError, match="Sign needs 1 output, the network has 2"):
        otr.ReluNetwork([np.ones((2, 3))], [np.ones(2)], head=otr.Sign())
    with pytest.raises(otr.InvalidNetworkError, match="limits for 3 outputs, the network has 2"):
        otr.ReluNetwork([np.ones((2, 3))], [np.ones(2)], head=otr.ClipBox(-np.ones(3), np.ones(3)))


def test_unknown_heads_are_refused() -> None:
    with pytest.raises(otr.ArtefactError, match="unknown head 'softmax'"):
        head_from_dict({"name": "softmax"})
    with pytest.raises(otr.ArtefactError, match="cannot be made"):
        head_from_dict({"name": "tanh_box"})
