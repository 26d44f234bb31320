import numpy as np
import pytest

import otr
from otr.core.heads import HEADS, head_from_dict


def test_worked_answers_which_do_not_change_their_argument() -> None:
    Y = np.array([[0.0, 0.0], [50.0, -50.0], [np.arctanh(0.5), np.arctanh(-0.5)]])
    before = Y.copy()
    box = otr.TanhBox([-2.0, 0.0], [2.0, 1.0])
    np.testing.assert_allclose(box(Y), [[0.0, 0.5], [2.0, 0.0], [1.0, 0.25]], atol=1e-15)
    assert otr.ClipBox([-1.0, -2.0], [1.0, 2.0])(np.array([-3.0, 1.5])).tolist() == [-1.0, 1.5]
    assert otr.ClipBox(-1, 1)(Y).max() == 1.0 and otr.Argmax()(Y).tolist() == [0, 0, 0]
    assert otr.Sign()(np.array([[-1.0], [0.0], [1e-300]])).tolist() == [0, 0, 1]
    assert otr.Sign()(Y[:, :1]).tolist() == [0, 1, 1] and (before == Y).all()


def test_argmax_tournament_equals_numpy_on_ties() -> None:
    head = otr.Argmax()
    Y = np.random.default_rng(0).integers(0, 3, (500, 4)).astype(float)
    outcomes = head.tests(Y)
    assert head.n_tests(4) == 3
    np.testing.assert_array_equal(head.labels(outcomes), Y.argmax(axis=1))
    champions = head.champions(outcomes)
    rows = np.arange(len(Y))
    for test in range(3):
        np.testing.assert_array_equal(outcomes[:, test], Y[:, test + 1] - Y[rows, champions[:, test]] > 0)


def test_boxes_that_are_none_and_heads_that_do_not_fit_are_refused() -> None:
    no_boxes = ((1.0, 1.0), (0.0, np.inf), (np.nan, 1.0), ([0.0], [1.0, 2.0]), ([[0.0]], [[1.0]]))
    for box in (otr.TanhBox, otr.ClipBox):
        for low, high in no_boxes:
            with pytest.raises(otr.InvalidNetworkError, match="low"):
                box(low, high)
    for box in (otr.TanhBox, otr.PidBox):
        with pytest.raises(otr.InvalidNetworkError, match="high - low is larger than a float64 can hold"):
            box([0.0, -1e308], [1.0, 1e308])
    assert otr.ClipBox(-1e308, 1e308)(np.array([2.0])) == 2.0  # which works with the limits alone
    for head, words in ((otr.Sign(), "Sign needs 1 output"), (otr.ClipBox([-1.0] * 3, [1.0] * 3), "for 3 outputs")):
        with pytest.raises(otr.InvalidNetworkError, match=rf"{words}.* network has 2"):
            otr.ReluNetwork([np.ones((2, 3))], [np.ones(2)], head=head)
    for name, words in (("softmax", "unknown head 'softmax'"), ("tanh_box", "cannot be made")):
        with pytest.raises(otr.ArtefactError, match=words):
            head_from_dict({"name": name})


KNOWN: dict[str, tuple[otr.Head, int]] = {  # a head of each kind and its number of outputs
    "identity": (otr.Identity(), 2),
    "exp": (otr.Exp(), 2),
    "tanh_box": (otr.TanhBox([-1.0, 0.0], [1.0, 4.0]), 2),
    "clip_box": (otr.ClipBox(-1.0, 0.5), 2),
    "pid_box": (otr.PidBox([-1.0, 0.0], [1.0, 4.0]), 9),
    "sign": (otr.Sign(), 1),
    "argmax": (otr.Argmax(), 3),
}


def test_equal_heads_hash_alike_and_come_back_from_their_descriptions() -> None:
    heads = [head for head, _ in KNOWN.values()]
    again = [head_from_dict(head.to_dict()) for head in heads]
    assert again == heads and [hash(head) for head in again] == [hash(head) for head in heads]
    assert len({*heads, otr.TanhBox(-1, 1), otr.TanhBox(-1, 2), otr.ClipBox(-1, 1)}) == len(heads) + 3
    for head, other in (  # which differ in the sign of a zero
        (otr.ClipBox(-0.0, 1.0), otr.ClipBox(0.0, 1.0)),
        (otr.TanhBox([-1.0, -2.0], [-0.0, 0.0]), otr.TanhBox([-1.0, -2.0], [0.0, -0.0])),
    ):
        assert head == other and hash(head) == hash(other) and repr(head) == repr(other)


@pytest.mark.parametrize("name", sorted(HEADS))
def test_what_a_head_says_of_itself_is_so(name: str) -> None:
    head, o = KNOWN[name]
    head.check(o)
    Y = np.random.default_rng(0).normal(size=(200, o)) * 3
    answers, far = head(Y), head(Y + 0.25)
    assert (answers.ndim == 1) == head.gives_labels == (head.n_tests(o) > 0)
    if head.gives_labels:
        labels = np.arange(head.n_labels(o))
        assert set(answers) == set(labels)
        vectors = [head.weights_of_label(label, o).tolist() for label in labels]
        assert vectors == ([[0.0], [1.0]] if name == "sign" else np.eye(o).tolist())
        return
    assert answers.shape == (len(Y), head.n_answers(o)) == head.controls(Y).shape
    assert head.acts_by_output == (not head.output_names(o, ["a", "b"]))
    if head.acts_by_output:
        assert np.array_equal(head(answers), answers) == head.is_projection
        slopes = head.slopes(o)
        assert (slopes is None) == (name == "exp") and (far >= answers).all()
        assert slopes is None or (far - answers <= 0.25 * slopes + 1e-12).all()
    limits, clip = head.limits(o), head.clip()
    assert (limits is None) == (clip is None)
    if limits is not None and clip is not None:
        assert (limits[0] <= answers).all() and (answers <= limits[1]).all()
        assert np.array_equal(clip(answers), answers)
        for at, side in zip(limits, (0, 1), strict=True):
            np.testing.assert_allclose(clip(np.full(len(at), (-1e9, 1e9)[side])), at)


def test_the_tangent_of_squashed_answers() -> None:
    for head, o in KNOWN.values():
        tangent = head.tangent(o)
        assert (tangent is None) == (head.name != "tanh_box")
        if tangent is not None:
            slopes, values = tangent
            np.testing.assert_allclose(values, head(np.zeros(o)))
            np.testing.assert_allclose(slopes, (head(np.full(o, 1e-6)) - head(np.full(o, -1e-6))) / 2e-6, rtol=1e-9)


def test_a_head_clipped_to_a_box() -> None:
    Y, low, high = np.random.default_rng(0).normal(size=(100, 2)) * 3, np.array([-0.5, -1.0]), np.array([2.0, 3.0])
    for head in (otr.Identity(), otr.ClipBox(-1.0, 0.5), otr.TanhBox(low, high), otr.TanhBox([0.0, 0.0], [2.0, 3.0])):
        np.testing.assert_allclose(head.clipped_to(low, high)(Y), np.clip(head(Y), low, high))
    with pytest.raises(ValueError, match=r"go through tanh to \[-1.0, 0.0\] .. \[1.0, 4.0\], .* scale the tanh"):
        KNOWN["tanh_box"][0].clipped_to(low, high)
    with pytest.raises(ValueError, match=r"a clip to 5.0 .. 6.0 leaves none of the actions \[-0.5, -1.0\] .. \[2.0"):
        otr.ClipBox(5.0, 6.0).clipped_to(low, high)
    for size in (np.array([1e-9]), np.array([1.0]), np.array([1e9])):  # in any units
        tanh = otr.TanhBox(-size, size)
        assert tanh.clipped_to(-size, size * (1 - 1e-12)) == tanh
        with pytest.raises(ValueError, match="scale the tanh to these"):
            tanh.clipped_to(-0.1 * size, 0.1 * size)
