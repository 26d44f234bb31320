"""Polish on returns that are known functions of the policy."""

import zlib

import numpy as np
import pytest

import otr
from otr.control.search.polish import CONFIRMATION_SEEDS, SEARCH_SEEDS, SELECTION_SEEDS, PolishReport

STATES = np.random.default_rng(0).normal(size=(100, 2)) * [1.0, 5.0] + [0.0, 3.0]
TARGET = np.array([[1.0, -0.5]]), np.array([0.75])
QUICK = otr.SearchSettings(n_directions=8, n_top=4, step_size=0.3, noise=0.05, step_size_end=0.1, noise_end=0.2)


def linear_policy() -> otr.ReluNetwork:
    return otr.ReluNetwork([[[0.6, 0.1]]], [[-0.5]])


class Quadratic:
    """The return of a policy is minus its mean squared distance from a target, plus what the start is worth."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, np.ndarray]] = []

    def __call__(self, policies, seeds):
        self.calls.append((len(policies), seeds))
        wanted = STATES @ TARGET[0].T + TARGET[1]
        returns = [-np.mean((policy.forward(STATES) - wanted) ** 2) for policy in policies]
        return np.array(returns)[:, None] + np.sin(seeds)


@pytest.mark.parametrize("common_starts", ["pair", "all"])
def test_a_quadratic_return_is_climbed_on_common_starts(common_starts) -> None:
    evaluate, reports = Quadratic(), []
    arguments = {
        "states": STATES, "n_iterations": 60, "settings": QUICK, "n_episodes": 3, "common_starts": common_starts,
        "n_selection_episodes": 5, "n_candidates": 6, "seed": 3,
    }  # fmt: skip
    polished = otr.polish(linear_policy(), evaluate, report=reports.append, **arguments)
    np.testing.assert_allclose(polished.weights[0], TARGET[0], atol=0.02)
    np.testing.assert_allclose(polished.biases[0], TARGET[1], atol=0.1)
    last: PolishReport = reports[-1]
    assert last.kept and last.n_numbers == 3
    assert [iteration for iteration, _ in last.candidates] == [0, 10, 20, 30, 40, 50, 60]
    assert last.confirmation[1] - last.confirmation[0] > 5
    assert len(reports) == 8 and reports[0].candidates == last.candidates[:1]
    assert last.n_played == sum(seeds.size for _, seeds in evaluate.calls) == 60 * 16 * 3 + 7 * 5 + 2 * 5

    searched = [seeds for k, seeds in evaluate.calls if k == 16]
    assert len(searched) == 60
    for seeds in searched:
        assert seeds.shape == (16, 3)
        np.testing.assert_array_equal(seeds[0::2], seeds[1::2])
        assert len(np.unique(seeds)) == (3 if common_starts == "all" else 24)
    assert len(np.unique(searched)) > 0.99 * 60 * len(np.unique(searched[0]))  # fresh ones each time
    again = otr.polish(linear_policy(), Quadratic(), **arguments)
    np.testing.assert_array_equal(again.weights[0], polished.weights[0])


def test_the_three_kinds_of_episodes_are_disjoint_and_not_the_reported_ones() -> None:
    evaluate = Quadratic()
    otr.polish(linear_policy(), evaluate, states=STATES, n_iterations=2, settings=QUICK, n_selection_episodes=7)
    kinds = {16: SEARCH_SEEDS, 1: SELECTION_SEEDS, 2: CONFIRMATION_SEEDS}
    assert 2**20 == SEARCH_SEEDS[0] < SEARCH_SEEDS[1] == SELECTION_SEEDS[0] < SELECTION_SEEDS[1]
    assert SELECTION_SEEDS[1] == CONFIRMATION_SEEDS[0] < CONFIRMATION_SEEDS[1] == 2**31
    assert {k for k, _ in evaluate.calls} == set(kinds)
    for k, seeds in evaluate.calls:
        assert kinds[k][0] <= seeds.min() and seeds.max() < kinds[k][1]
    selections = [seeds for k, seeds in evaluate.calls if k == 1]
    assert all(np.array_equal(seeds, selections[0]) for seeds in selections) and len(np.unique(selections[0])) == 7


def test_the_original_comes_back_where_nothing_helps() -> None:
    policy = linear_policy()

    def noise(policies, seeds):
        draws = [np.random.default_rng(zlib.crc32(each.weights[0].tobytes())) for each in policies]
        return np.array([draw.normal(size=seeds.shape[1]) - 0.5 * (each is not policy)
                         for draw, each in zip(draws, policies, strict=True)])  # fmt: skip

    reports: list[PolishReport] = []
    arguments = {"states": STATES, "n_iterations": 20, "settings": QUICK, "n_selection_episodes": 100}
    for seed in range(5):
        assert otr.polish(policy, noise, **arguments, seed=seed, report=reports.append) is policy
    assert not any(report.kept for report in reports)
    flat = otr.polish(policy, lambda policies, seeds: np.sin(seeds), states=STATES, n_iterations=2, settings=QUICK)
    assert flat is policy


def test_a_candidate_that_is_better_on_the_selection_episodes_alone_is_not_kept() -> None:
    policy, reports = linear_policy(), []

    def deceiving(policies, seeds):
        changes = np.array([[np.abs(each.weights[0] - policy.weights[0]).max()] for each in policies])
        return np.where(seeds < SELECTION_SEEDS[1], changes, -changes)

    assert otr.polish(policy, deceiving, states=STATES, n_iterations=2, settings=QUICK, report=reports.append) is policy
    last = reports[-1]
    gain = max(mean for _, mean in last.candidates)
    assert gain > 0 and last.confirmation == pytest.approx((0.0, -gain)) and not last.kept


@pytest.mark.parametrize(("noise", "kept"), [(0.5, True), (20.0, False)])
def test_a_gain_within_the_error_of_the_confirmation_is_not_kept(noise: float, kept: bool) -> None:
    policy, reports = linear_policy(), []

    def evaluate(policies, seeds):
        """Return 1 more for every change, beside noise of its own that adds up to nothing."""
        changed = np.array([[float(each is not policy)] for each in policies])
        if seeds.max() < SELECTION_SEEDS[0]:  # the search
            return np.array([[each.weights[0].sum()] for each in policies]) + 0.0 * seeds
        return changed * (1.0 + noise * np.where(np.arange(seeds.shape[1]) % 2, 1.0, -1.0))

    polished = otr.polish(
        policy, evaluate, states=STATES, n_iterations=2, settings=QUICK, n_selection_episodes=100, report=reports.append
    )
    assert reports[-1].confirmation == pytest.approx((0.0, 1.0))
    assert reports[-1].kept == kept and (polished is not policy) == kept


def test_a_tree_keeps_its_structure_labels_and_zeros() -> None:
    """The label is right where x_0 > 0.5; the tree's test is at -0.3 and asks for nothing else."""
    tree = otr.ObliqueTree(
        [-1], [-2], [[1.0, 0.0]], [0.3], np.zeros((2, 2, 2)), np.eye(2), labels=[0, 1], head=otr.Argmax()
    )
    wanted = (STATES[:, 0] > 0.5).astype(int)

    def share_right(policies, seeds):
        return np.repeat([[(each.predict(STATES) == wanted).mean()] for each in policies], seeds.shape[1], axis=1)

    polished = otr.polish(tree, share_right, states=STATES, n_iterations=30, settings=QUICK, n_selection_episodes=1)
    assert (polished.predict(STATES) == wanted).mean() > 0.97 > (tree.predict(STATES) == wanted).mean() + 0.1
    assert polished.P[0, 1] == 0.0 and polished.labels.tolist() == [0, 1] and polished.head == tree.head
    np.testing.assert_array_equal(polished.c, tree.c)


@pytest.mark.parametrize(
    ("evaluate", "changes", "message"),
    [
        (Quadratic(), {"n_candidates": 0}, "n_candidates=0 is not at least 1"),
        (Quadratic(), {"common_starts": "none"}, "common_starts=none: use one of pair, all"),
        (Quadratic(), {"states": np.ones((3, 1))}, r"expected \(n, 2\)"),
        (lambda policies, seeds: np.zeros(len(policies)), {}, r"evaluate returned \(1,\), expected \(1, 100\) finite"),
        (lambda policies, seeds: np.full(seeds.shape, np.nan), {}, "evaluate returned numbers that are not finite"),
    ],
)
def test_wrong_arguments_and_returns_are_refused(evaluate, changes, message) -> None:
    with pytest.raises(ValueError, match=message):
        otr.polish(linear_policy(), evaluate, **{"states": STATES} | changes)
