"""The search itself: its step by the paper's formula, its resumption, and that it climbs."""

import numpy as np
import pytest

from otr.control.search.direct_search import DirectSearch
from otr.control.settings import SearchSettings


def test_step_is_the_papers():
    settings = SearchSettings(n_directions=3, n_top=2, step_size=0.5, noise=0.1)
    search = DirectSearch(np.array([1.0, -2.0]), settings, seed=7)
    tried = search.ask()
    deltas = (tried[0::2] - tried[1::2]) / 0.2
    np.testing.assert_allclose((tried[0::2] + tried[1::2]) / 2, np.tile([1.0, -2.0], (3, 1)))
    returns = np.array([1.0, 2.0, 10.0, 4.0, 3.0, 7.0])  # the best of the pairs: 2, 10, 7; so the last two count
    search.tell(returns)
    sigma = np.std([10.0, 4.0, 3.0, 7.0])
    step = 0.5 / (2 * sigma) * ((10 - 4) * deltas[1] + (3 - 7) * deltas[2])
    np.testing.assert_allclose(search.centre, np.array([1.0, -2.0]) + step)
    before = search.centre.copy()
    search.tell(np.zeros(len(search.ask())))  # equal returns move nothing
    assert np.array_equal(search.centre, before) and search.n_iterations == 2


def test_step_and_noise_fall_linearly():
    settings = SearchSettings(noise=0.1, noise_end=0.2, step_size=0.4, step_size_end=0.5)
    lengths = []
    for done in (0.0, 0.5, 1.0):
        search = DirectSearch(np.zeros(400), settings, seed=0)
        tried = search.ask(done)
        search.tell(tried[:, 0])
        lengths.append((np.linalg.norm(tried[0]), np.linalg.norm(search.centre)))
    np.testing.assert_allclose([noise / lengths[0][0] for noise, _ in lengths], [1.0, 0.6, 0.2])
    np.testing.assert_allclose([step / lengths[0][1] for _, step in lengths], [1.0, 0.75, 0.5])


@pytest.mark.parametrize("momentum", [0.0, 0.9])
def test_climbs_a_quadratic(momentum):
    top = np.linspace(-1.0, 1.0, 20)
    search = DirectSearch(np.zeros(20), SearchSettings(16, 8, 0.1, 0.05, 0.05, 1.0, momentum), seed=3)
    for i in range(200):
        search.tell(-np.square(search.ask(i / 200) - top).sum(axis=1))
    assert np.square(search.centre - top).sum() < 0.01 * np.square(top).sum()


def test_goes_on_bit_for_bit_from_its_state():
    def play(search: DirectSearch, n: int) -> None:
        for _ in range(n):
            search.tell(np.cos(search.ask(0.3)).sum(axis=1))

    settings = SearchSettings(momentum=0.5)
    whole, first = DirectSearch(np.ones(5), settings, 1), DirectSearch(np.ones(5), settings, 1)
    play(whole, 7)
    play(first, 3)
    second = DirectSearch(np.zeros(5), settings, 1)
    second.restore(first.state())
    play(second, 4)
    assert np.array_equal(whole.centre, second.centre) and np.array_equal(whole.velocity, second.velocity)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"n_top": 9}, "n_top=9 is more than n_directions=8"),
        ({"n_top": 2.5}, "n_top=2.5 is not a whole number"),
        ({"noise": 0.0}, "noise=0.0"),
        ({"momentum": 1.0}, "momentum=1.0"),
    ],
)
def test_settings_that_make_no_search_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        DirectSearch(np.zeros(3), SearchSettings(**wrong), 0)
