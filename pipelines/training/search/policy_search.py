"""One search for a small actor: candidates, their episodes, the step; its state resumes it bit for bit."""

from collections.abc import Mapping

import numpy as np

import otr
from otr.control.search.direct_search import DirectSearch
from otr.control.search.small_networks import NetworkShape
from otr.control.search.state_moments import StateMoments
from pipelines.config.algo import ArsConfig
from pipelines.engine.seeding import FIRST_STREAM_SEED, LAST_STREAM_SEED, stream, stream_seed
from pipelines.play.environments import episode_limit
from pipelines.play.episodes import Played, Player
from pipelines.play.spaces import spaces
from pipelines.training.settings import TrainSettings


def network_shape(config: TrainSettings) -> NetworkShape:
    """Return the shape of a run's actor."""
    space = spaces(config.env)
    return NetworkShape(
        space.n_inputs,
        config.hidden_widths,
        space.n_actions,
        space.box,
        config.actor.links,
        config.actor.negative_slope,
    )


class PolicySearch:
    """A search from a network of its own.

    Attributes:
        n_steps: environment steps that it played.
    """

    def __init__(self, config: TrainSettings, start: int) -> None:
        """Begin the run's search number `start`, at a network whose outputs are zero."""
        assert isinstance(config.algo, ArsConfig)
        algo = config.algo
        self._seed, self._start, self._algo = config.seed, start, algo
        self._shape = network_shape(config)
        first = self._shape.initial(np.random.default_rng(stream(config.seed, "train", start)))
        self._search = DirectSearch(first, algo, stream_seed(config.seed, "train", start, 0))
        self._longest = episode_limit(config.env)
        self._moments = StateMoments(self._shape.n_inputs)
        self.n_steps = 0

    @property
    def network(self) -> otr.ReluNetwork:
        """The current actor, of the environment's own states."""
        return self._network(self._search.centre)

    def iterate(self, player: Player, done: float) -> Played:
        """Try the neighbours of the actor and make a step; return the results of their episodes.

        Args:
            player: plays them.
            done: share of the search that is done, by which step and noise fall.
        """
        networks = [self._network(vector) for vector in self._search.ask(done)]
        played = player.play(
            networks,
            self._episode_seeds(),
            horizon=self._horizon(done),
            alive_bonus=self._algo.alive_bonus,
            keep_states=self._algo.normalise,
        )
        self._search.tell(played.returns.mean(axis=1))
        if self._algo.normalise:
            self._moments.add(played.states)
        self.n_steps += int(played.lengths.sum())
        return played

    def state(self) -> dict[str, np.ndarray]:
        """Return all that resumes the search, as arrays by name."""
        moments = {f"moments_{name}": array for name, array in self._moments.state().items()}
        return {**self._search.state(), **moments, "n_steps": np.array(float(self.n_steps))}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Resume from what `state` returned."""
        self._search.restore(state)
        self._moments.restore({name: state[f"moments_{name}"] for name in self._moments.state()})
        self.n_steps = int(state["n_steps"])

    def _network(self, vector: np.ndarray) -> otr.ReluNetwork:
        return self._shape.network(vector, self._moments.mean, self._moments.scale)

    def _horizon(self, done: float) -> int | None:
        """Return the most steps of an episode, which grow linearly from the first ones to the whole episode."""
        first, until = self._algo.first_horizon, self._algo.horizon_until
        if not first or done >= until:
            return None
        return round(first + (self._longest - first) * done / until)

    def _episode_seeds(self) -> np.ndarray:
        """Return the seeds (2N, n_episodes) of an iteration; the two of a direction, or all, have the same."""
        algo = self._algo
        rows = algo.n_directions if algo.common_starts == "pair" else 1
        generator = np.random.default_rng(stream(self._seed, "train", self._start, 1, self._search.n_iterations))
        seeds = generator.integers(FIRST_STREAM_SEED, LAST_STREAM_SEED, size=(rows, algo.n_episodes))
        return np.repeat(seeds, 2 * algo.n_directions // rows, axis=0)
