"""Environments of a user's own, which `module:Id` imports: a cart on a line, and some that no policy here can play."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np


class Cart(gym.Env):
    """A mass is pushed to the origin; it is there at rest for a reward of 0, elsewhere it is less."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "feature_names": ["position", "velocity"],
                                          "action_names": ["force"]}  # fmt: skip

    def __init__(self, mass: float = 1.0) -> None:
        self.mass = mass
        self.observation_space = gym.spaces.Box(-10, 10, (2,), np.float64)
        self.action_space: gym.Space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 2)
        return self.state.copy(), {}

    def step(self, action: Any) -> Any:
        x, v = self.state
        v += 0.1 * self.force(action) / self.mass
        self.state = np.clip([x + 0.1 * v, v], -10, 10)
        return self.state.copy(), -float(x * x), False, False, {}

    def force(self, action: Any) -> float:
        return float(action[0])


class PushOrPull(Cart):
    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Discrete(2)

    def force(self, action: Any) -> float:
        return 2.0 * int(action) - 1.0


class Insistent(Cart):
    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        return super().step(action)


class Keyed(PushOrPull):
    """The cart seen as a dictionary, whose labels begin at 1."""

    def __init__(self) -> None:
        super().__init__()
        parts = {"speed": gym.spaces.Box(-10, 10, (), np.float64), "on right": gym.spaces.Discrete(2)}
        self.observation_space = gym.spaces.Dict(parts)
        self.action_space = gym.spaces.Discrete(2, start=1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        (x, v), info = super().reset(seed=seed)
        return {"speed": np.float64(v), "on right": int(x > 0)}, info

    def step(self, action: Any) -> Any:
        (x, v), *others = super().step(action)
        return {"speed": np.float64(v), "on right": int(x > 0)}, *others

    def force(self, action: Any) -> float:
        assert action in (1, 2)
        return 2.0 * int(action) - 3.0


class Unsuitable(Cart):
    def __init__(self, observations: gym.Space | None = None, actions: gym.Space | None = None) -> None:
        super().__init__()
        self.observation_space = observations or self.observation_space
        self.action_space = actions or self.action_space


class OfOldGym(Cart):
    def reset(self) -> Any:
        return super().reset()[0]


class ReturnsFour(Cart):
    def step(self, action: Any) -> Any:
        state, reward, ended, _, info = super().step(action)
        return state, reward, ended, info


class LongerThanItsSpace(Cart):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.append(super().reset(seed=seed)[0], 0), {}


class NotFinite(Cart):
    def step(self, action: Any) -> Any:
        return np.array([np.nan, 0.0]), 0.0, False, False, {}


class NotFiniteLater(Cart):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.n_steps = 0
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        self.n_steps += 1
        state, *others = super().step(action)
        return state if self.n_steps < 10 else np.full(2, np.nan), *others


class FailsLater(Cart):
    def step(self, action: Any) -> Any:
        state, *others = super().step(action)
        if abs(state[0]) < 0.1:
            raise KeyError("goal")
        return state, *others


class NoReward(Cart):
    def step(self, action: Any) -> Any:
        state, reward, *others = super().step(action)
        return state, reward if abs(state[0]) > 0.3 else np.nan, *others


class Unseeded(Cart):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.state = np.random.default_rng().uniform(-1, 1, 2)
        return self.state.copy(), {}


class Noisy(Cart):
    def force(self, action: Any) -> float:
        return float(np.random.default_rng().normal())


class Worn(Cart):
    n_played = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.n_played += 1
        return super().reset(seed=seed)

    def force(self, action: Any) -> float:
        return float(action[0]) / self.n_played


class NeedsAFile(Cart):
    def __init__(self) -> None:
        raise FileNotFoundError("track.csv")


SPACES: dict[str, dict[str, gym.Space]] = {
    "Images": {"observations": gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)},
    "Words": {"observations": gym.spaces.Text(4)},
    "Keys": {"actions": gym.spaces.MultiDiscrete([2, 2])},
    "Fixed": {"observations": gym.spaces.Box(np.array([-5.0, 0.5]), np.array([5.0, 0.5]), dtype=np.float64)},
    "Boundless": {"actions": gym.spaces.Box(-np.inf, np.inf, (1,))},
}

gym.register("Cart-v0", entry_point=Cart, max_episode_steps=50)

gym.register("Endless-v0", entry_point=Cart)
gym.register("SaidToBeNoisy-v0", entry_point=Noisy, max_episode_steps=50, nondeterministic=True)
for kind in (*Cart.__subclasses__(), Keyed):
    gym.register(f"{kind.__name__}-v0", entry_point=kind, max_episode_steps=50)
for name, spaces in SPACES.items():
    gym.register(f"{name}-v0", entry_point=Unsuitable, kwargs=spaces, max_episode_steps=50)
