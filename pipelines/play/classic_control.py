"""Pendulum-v1 and MountainCarContinuous-v0 in numpy: thousands of environments in one array operation.

The equations are gymnasium's (1.4.0, `gymnasium/envs/classic_control`), operation by operation and type by type, with
float32 actions. States and ends are the same to the last bit, and so are the car's rewards, where numpy's sine of an
array is its sine of a number, as on the processors that were tried. The pendulum's rewards are equal to 5e-10:
gymnasium squares the torque by powf, which rounds one of a thousand squares to the neighbouring float32.
`tests/pipelines/play/test_classic_control.py` plays both.
"""

from collections.abc import Sequence

import numpy as np
from gymnasium.utils.seeding import np_random

from otr.control.environments import Stepped
from pipelines.config.env import EnvConfig
from pipelines.play.environments import episode_limit

N_STARTS_AHEAD = 8  # first states drawn at a time from a random stream


class _Pendulum:
    """Pendulum-v1: angle from upright in rad, angular velocity in rad/s; torque in N m."""

    low: tuple[float, ...] = (-np.pi, -1.0)  # first states are uniform in this box; numbers left out are zero
    high: tuple[float, ...] = (np.pi, 1.0)

    def step(
        self, state: np.ndarray, action: np.ndarray, first: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the next states (2, k), rewards (k,) and whether they are terminal (k,).

        Args:
            state: (2, k) float64, a position and a velocity.
            action: (k,) float32.
            first: (k,) bool, whether this is the first step of an episode.
        """
        angle, velocity = state
        torque = np.clip(action, -2.0, 2.0)
        from_upright = (angle + np.pi) % (2 * np.pi) - np.pi
        costs = from_upright**2 + 0.1 * velocity**2 + 0.001 * torque**2
        velocity = np.clip(velocity + (15.0 * np.sin(angle) + 3.0 * torque) * 0.05, -8, 8)
        return np.stack((angle + velocity * 0.05, velocity)), -costs, np.zeros(len(costs), dtype=bool)

    def observe(self, state: np.ndarray) -> np.ndarray:
        """Return observations (k, d) float32 of states (2, k)."""
        angle, velocity = state
        states = np.empty((len(angle), 3), dtype=np.float32)
        states[:, 0], states[:, 1], states[:, 2] = np.cos(angle), np.sin(angle), velocity
        return states


class _MountainCar:
    """MountainCarContinuous-v0. gymnasium holds the state in float64 up to the first step, in float32 from then on."""

    low: tuple[float, ...] = (-0.6,)
    high: tuple[float, ...] = (-0.4,)

    def step(
        self, state: np.ndarray, action: np.ndarray, first: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        following = np.empty_like(state)
        for rows, dtype in ((first, np.float64), (~first, np.float32)):
            if rows.any():
                position, velocity = state[:, rows].astype(dtype)
                following[:, rows] = self._move(position, velocity, action[rows])
        position, velocity = following
        terminated = (position >= 0.45) & (velocity >= 0)
        rewards = np.where(terminated, 100.0, 0.0) - action.astype(np.float64) ** 2 * 0.1
        return following.astype(np.float32).astype(np.float64), rewards, terminated

    def _move(self, position: np.ndarray, velocity: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = 0.0025 * np.cos((3 * position).astype(np.float64))
        # A force at its limit is Python's float, which leaves the sum in float64; one within is a float32.
        push = action * 0.0015 - slope.astype(np.float32)
        limited = np.abs(action) > 1
        acceleration = np.where(limited, np.sign(action) * np.float64(0.0015) - slope, push)
        velocity = np.clip(velocity + acceleration.astype(velocity.dtype), -0.07, 0.07)
        position = np.clip(position + velocity, -1.2, 0.6)
        velocity[(position == position.dtype.type(-1.2)) & (velocity < 0)] = 0
        return position, velocity

    def observe(self, state: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(state.T, dtype=np.float32)


_Plant = _MountainCar | _Pendulum
_PLANTS: dict[str, type[_Plant]] = {
    "MountainCarContinuous-v0": _MountainCar,
    "Pendulum-v1": _Pendulum,
}
EQUAL_IDS = tuple(_PLANTS)


class ClassicControlVectorEnv:
    """Environments of EQUAL_IDS as arrays (`VectorEnv`), which are started all at once; actions are float32."""

    def __init__(self, env: EnvConfig) -> None:
        """Prepare an environment that `check_environments` allows."""
        self._max_episode_steps = episode_limit(env)
        self._plant = _PLANTS[env.id]()
        self._starts: _Starts | None = None

    def reset(self, seeds: Sequence[int] | None, envs: np.ndarray | None = None) -> np.ndarray:
        if seeds is not None:
            assert envs is None, "environments are started one by one in the random streams that they have"
            self._starts = _Starts(seeds, np.array(self._plant.low), np.array(self._plant.high))
            self._state = np.empty((2, len(seeds)))
            self._n_steps = np.zeros(len(seeds), dtype=np.int64)  # of the episodes under way
        assert self._starts is not None
        index = np.arange(len(self._n_steps)) if envs is None else envs
        self._n_steps[index] = 0
        self._state[:, index] = 0.0
        starts = self._starts.take(index).T
        self._state[: len(starts), index] = starts
        return self._plant.observe(self._state[:, index]).astype(np.float64)

    def step(self, actions: np.ndarray, envs: np.ndarray | None = None) -> Stepped:
        index = slice(None) if envs is None else envs
        given = np.asarray(actions, dtype=np.float32)
        state, rewards, terminated = self._plant.step(self._state[:, index], given[:, 0], self._n_steps[index] == 0)
        self._state[:, index] = state
        self._n_steps[index] += 1
        states = self._plant.observe(state).astype(np.float64)
        return Stepped(states, rewards, terminated, self._n_steps[index] >= self._max_episode_steps, given)

    def close(self) -> None:
        pass


class _Starts:
    """First states of the episodes: those of gymnasium's own random streams, one for each distinct seed.

    Environments of equal seeds share a stream, and each takes its k-th state for its k-th episode.
    """

    def __init__(self, seeds: Sequence[int], low: np.ndarray, high: np.ndarray) -> None:
        distinct, self._stream = np.unique(np.asarray(seeds, dtype=np.int64), return_inverse=True)
        self._generators = [np_random(int(seed))[0] for seed in distinct]
        self._low, self._high = low, high
        self._n_taken = np.zeros(len(seeds), dtype=np.int64)  # by each environment
        self._first = 0  # `_drawn` holds those from this number on, not yet taken
        self._drawn = np.empty((len(distinct), 0, len(low)))

    def take(self, envs: np.ndarray) -> np.ndarray:
        """Return the next first states of some environments, (k, 1 or 2)."""
        k = self._n_taken[envs]
        if k.max(initial=0) >= self._first + self._drawn.shape[1]:
            self._draw()
        self._n_taken[envs] += 1
        starts: np.ndarray = self._drawn[self._stream[envs], k - self._first]
        return starts

    def _draw(self) -> None:
        n_used = int(self._n_taken.min()) - self._first
        size = (N_STARTS_AHEAD, len(self._low))
        drawn = np.array([generator.uniform(self._low, self._high, size) for generator in self._generators])
        self._drawn = np.concatenate((self._drawn[:, n_used:], drawn), axis=1)
        self._first += n_used
