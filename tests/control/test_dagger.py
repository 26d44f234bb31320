import json

import numpy as np
import pytest

import otr
from otr.control import AugTreeFit, CartFit, DaggerSettings, LinearModelTreeFit, run_dagger
from otr.errors import ArtefactError, InvalidNetworkError
from tests.control.worlds import PointMass, centering_oracle, continuous_oracle, episode_seeds

SETTINGS = DaggerSettings(n_rounds=5, n_episodes=4, n_initial_episodes=3, n_choice_episodes=11)
SEED = np.random.SeedSequence(7, spawn_key=(3,))


def run(folder, *, play=None, fit=None, oracle=None, settings=SETTINGS, seed=SEED, **options):
    play = play or PointMass()
    fit = fit or CartFit(max_depth=3, max_samples=60)
    return run_dagger(oracle or centering_oracle(), fit, play, episode_seeds, settings, seed, folder, **options)


def contents(folder):
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    state = json.loads(files.pop("dagger.json"))
    for tree in state["trees"]:
        del tree["seconds"]
    return files, state


def assert_same_result(result, expected):
    for name in ("round", "n_steps", "oracle_mean"):
        assert getattr(result, name) == getattr(expected, name)
    for name in ("children_left", "P", "v", "M", "c", "labels"):
        np.testing.assert_array_equal(getattr(result.tree, name), getattr(expected.tree, name))
    drop = {"seconds": 0.0}
    assert [vars(i) | drop for i in result.iterates] == [vars(i) | drop for i in expected.iterates]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder, play = tmp_path_factory.mktemp("whole"), PointMass()
    return run(folder, play=play), folder, play


def test_rounds_rows_and_steps(whole):
    result, folder, play = whole
    assert [i.n_rows for i in result.iterates] == [12 * (3 + 4 * r) for r in range(6)]
    assert result.n_steps == 12 * (3 + 6 * 4 + sum(i.n_selection_episodes - 4 for i in result.iterates))
    np.testing.assert_array_equal(result.tree.P, otr.load(folder / f"iterate-{result.round:03d}").P)
    assert result.tree.labels is not None and result.tree.depth <= 3
    by_stream = {"oracle": set(), "dagger": set(), "selection": set()}  # seeds that were given alone, and apart
    for seeds, keep_states in play.calls:
        name = list(by_stream)[min(seeds) // 10**7]
        by_stream[name] |= set(seeds)
        assert keep_states == (name != "selection" and min(seeds) < 10**7 + 5 * 10**4)
    assert by_stream == {
        "oracle": {0, 1, 2}, "dagger": {10**7 + 10**4 * r + e for r in range(6) for e in range(4)},
        "selection": {20000000, 20000001, *range(20010000, 20010005)},
    }  # fmt: skip


def test_states_are_labelled_by_the_oracle_and_weighted_by_its_spread(tmp_path):
    seen, drawn = [], []

    def fit(X, answers, weights, generator):
        seen.append((np.array(X), np.array(answers), np.array(weights)))
        drawn.append(generator.integers(2**62))
        return CartFit(2)(X, answers, weights, generator)

    run(tmp_path, fit=fit)
    X, answers, weights = seen[-1]
    expected = np.maximum(np.column_stack((-X[:, 0], X[:, 0], -X[:, 1], X[:, 1])), 0)
    np.testing.assert_allclose(answers, expected, atol=1e-12)
    np.testing.assert_allclose(weights, np.abs(X).max(axis=1), atol=1e-12)  # the smallest output is 0
    np.testing.assert_array_equal(seen[2][0], X[: len(seen[2][0])])
    visited = PointMass()(centering_oracle().predict, episode_seeds("oracle", 0, 3), True).states
    np.testing.assert_array_equal(X[: len(visited)], visited)
    visited = PointMass()(otr.load(tmp_path / "iterate-001").predict, episode_seeds("dagger", 1, 4), True).states
    np.testing.assert_array_equal(seen[2][0][-len(visited) :], visited)
    child = np.random.SeedSequence(7, spawn_key=(3, 2))  # every fit draws from a stream of its own
    assert drawn[2] == np.random.default_rng(child).integers(2**62) and len(set(drawn)) == 6


def test_the_best_candidate_on_selection_episodes_is_chosen(tmp_path):
    earned = [0.0, 1.0, 2.0, 9.0, 4.0, 5.0]  # by the iterates, whatever the seeds
    order = iter(range(100))

    def fit(*_):
        shares = [[next(order), 0.0, 0.0, 0.0]]
        return otr.ObliqueTree([], [], np.zeros((0, 2)), [], np.zeros((1, 4, 2)), shares, labels=[0], head=otr.Argmax())

    class Paid(PointMass):
        def __call__(self, policy, seeds, keep_states):
            played = super().__call__(policy, seeds, keep_states)
            tree = policy.__self__
            if isinstance(tree, otr.ObliqueTree):
                played.returns[:] = earned[int(tree.c[0, 0])]
            return played

    play = Paid()
    result = run(tmp_path, play=play, fit=fit)
    assert result.round == 3
    assert [i.selection_mean for i in result.iterates] == earned
    assert [i.n_selection_episodes for i in result.iterates] == [4, 4, 4, 11, 6, 11]
    shared = [seeds for seeds, _ in play.calls if min(seeds) >= 2 * 10**7]
    assert shared == [(20000000, 20000001)] * 3 + [tuple(range(20010000, 20010005))] * 2


@pytest.mark.parametrize("fail_at", range(0, 12, 2))
def test_killed_while_playing_it_ends_the_same(tmp_path, whole, fail_at):
    expected, folder, play = whole
    assert len(play.calls) == 12
    with pytest.raises(InterruptedError):
        run(tmp_path, play=PointMass(fail_at=fail_at))
    again = PointMass()
    assert_same_result(run(tmp_path, play=again), expected)
    assert len(again.calls) == 12 - fail_at  # nothing that was committed is played again
    assert contents(tmp_path) == contents(folder)


@pytest.mark.parametrize("fail_at", [0, 1, 4])
def test_killed_while_fitting_it_ends_the_same(tmp_path, whole, fail_at):
    fits = iter([CartFit(max_depth=3, max_samples=60)] * fail_at)

    def fit(*data):
        for each in fits:
            return each(*data)
        raise InterruptedError("killed")

    with pytest.raises(InterruptedError):
        run(tmp_path, fit=fit)
    (tmp_path / "states.f64").open("ab").write(b"half a row")  # the round's rows are there by then: overwritten
    assert_same_result(run(tmp_path), whole[0])
    assert contents(tmp_path) == contents(whole[1])


def test_progress_is_reported_once_a_round_and_another_seed_gives_another_result(tmp_path, whole):
    reported, seed = [], np.random.SeedSequence(8)
    with pytest.raises(InterruptedError):
        run(tmp_path, play=PointMass(fail_at=3), on_round=reported.append, seed=seed)
    other = run(tmp_path, on_round=reported.append, seed=seed)
    assert [p.round for p in reported] == list(range(6))
    assert [p.n_steps for p in reported] == [p.n_rows for p in reported]
    assert any(a.rollout_mean != b.rollout_mean for a, b in zip(other.iterates, whole[0].iterates, strict=True))


def test_a_folder_of_another_run_and_senseless_settings_are_refused(tmp_path, whole):
    for other, words in (
        ({"settings": DaggerSettings(n_rounds=6)}, "its settings is"),
        ({"seed": np.random.SeedSequence(8)}, "its seed is"),
        ({"oracle": continuous_oracle()}, "its oracle is"),
    ):
        with pytest.raises(ArtefactError, match=words):
            run(whole[1], **other)
    with pytest.raises(InterruptedError):
        run(tmp_path, play=PointMass(fail_at=2))
    (tmp_path / "states.f64").write_bytes(b"")
    with pytest.raises(ArtefactError, match=r"states.f64 holds 0 rows, 84 were committed"):
        run(tmp_path)
    with pytest.raises(InvalidNetworkError, match="Sign"):
        run(tmp_path, oracle=otr.ReluNetwork([np.ones((1, 2))], [np.zeros(1)], head=otr.Sign()))
    with pytest.raises(ValueError, match="n_episodes=0"):
        run(tmp_path, settings=DaggerSettings(n_episodes=0))


@pytest.mark.parametrize(
    "fit",
    [
        CartFit(5),
        LinearModelTreeFit(continuous_oracle().head, 2),
        AugTreeFit(continuous_oracle(), 5),
        AugTreeFit(continuous_oracle(), 2, leaves="linear"),
    ],
    ids=lambda fit: type(fit).__name__,
)
def test_continuous_oracles_are_imitated(tmp_path, fit):
    """-x, clipped, is linear on [-1, 1]: a model tree comes closer than constants."""
    oracle, play = continuous_oracle(), PointMass(continuous=True)
    weighted = []

    def watched(X, answers, weights, generator):
        weighted.append(weights)
        assert np.abs(answers).max() <= 1.0
        return fit(X, answers, weights, generator)

    settings = DaggerSettings(n_rounds=3, n_episodes=20, n_initial_episodes=20, n_choice_episodes=30)
    result = run(tmp_path, play=play, fit=watched, oracle=oracle, settings=settings)
    assert weighted == [None] * 4 and result.tree.labels is None
    X = np.random.default_rng(0).normal(size=(500, 2))
    error = np.abs(result.tree.predict(X) - oracle.predict(X)).mean()
    assert error < (0.12 if isinstance(result.tree.head, otr.ClipBox) else 0.3)
    assert np.abs(result.tree.predict(X)).max() <= 1.0
