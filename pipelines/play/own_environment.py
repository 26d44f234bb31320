"""Custom environments, and arguments that a user gives: tried, and checked before anything runs."""

import dataclasses
import functools
import json
import re
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import yaml  # type: ignore[import-untyped]

from otr.control.environments import INTERFACE
from otr.control.spaces import keyed_names
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.environments import error_line, make_env
from pipelines.play.spaces import action_names, feature_names, spaces

SAME_STATE = 1e-6  # by how much the state after a reset may differ, absolute and relative, where the seed is the same


def own_environment(env_id: str, kwargs: Mapping[str, Any]) -> EnvConfig:
    """Return the settings of an environment that conf/env has no file for.

    Its name is the id as a folder can have it. Names of the observation's and the action's components are those that
    the environment's class gives as ``metadata["feature_names"]`` and ``metadata["action_names"]``, or conf/names.yaml
    for it, or the keys of its observations, if any.

    Raises:
        ConfigError: there is no such environment, its observations or actions are of a kind that no policy here has, or
            a first reset and step do not give what gymnasium's interface says.
    """
    env = EnvConfig(re.sub(r"[^\w.-]+", "_", env_id), "", env_id, dict(kwargs))
    task = "discrete" if spaces(env).box is None else "continuous"
    made = make_env(env)
    _try_out(made, env_id)
    names = {key: list(made.metadata.get(key, [])) for key in ("feature_names", "action_names")}
    names = names if any(names.values()) else _names_of_class(str(made.spec and made.spec.entry_point))
    if not names.get("feature_names"):
        names["feature_names"] = keyed_names(made)
    made.close()
    return dataclasses.replace(env, task=task, kwargs={}, **names)


def _names_of_class(entry_point: str) -> dict[str, list[str]]:
    """Return the names that conf/names.yaml has for an environment's class, `module:Class`; none if it has not."""
    return dict(yaml.safe_load((CONF_DIR / "names.yaml").read_text(encoding="utf-8")).get(entry_point, {}))


def _try_out(env: gym.Env, env_id: str) -> None:
    """Reset and step twice; raise ConfigError where that fails, or gives what spaces or interface do not allow.

    The second time the result must be the same, unless the environment is registered as nondeterministic: every
    method plays the same episodes.
    """
    env.action_space.seed(0)
    action, seen = env.action_space.sample(), []
    call = "reset(seed=0)"
    try:
        for call in ("reset(seed=0)", "a second reset(seed=0)"):
            state, _ = env.reset(seed=0)
            _check_state(state, env)
            seen.append(np.asarray(state, dtype=np.float64))
            call = "step(action)"
            state, reward, *_ = env.step(action)
            _check_state(state, env)
            seen.append(np.append(state, float(reward)))
    except Exception as error:  # foreign code can fail in any way
        raise ConfigError(
            f"environment {env_id}: {call} fails: {error_line(error)}. {INTERFACE}, and debug=true shows where it fails"
        ) from error
    if env.spec is not None and env.spec.nondeterministic:
        return
    for call, first, second in (("reset(seed=0)", seen[0], seen[2]), ("the first step after it", seen[1], seen[3])):
        if not np.allclose(first, second, rtol=SAME_STATE, atol=SAME_STATE, equal_nan=True):
            raise ConfigError(
                f"environment {env_id}: {call} gives {first} and, again, {second}. Methods are compared on the same "
                "episodes, which a seed decides: let reset call super().reset(seed=seed) and draw from self.np_random, "
                "or register the environment with nondeterministic=True, and no two policies play the same episodes"
            )


@functools.cache
def _try_out_with(env_id: str, kwargs: str) -> None:
    made = make_env(EnvConfig(env_id, env_id, env_id, json.loads(kwargs)))
    _try_out(made, env_id)
    made.close()


def _check_state(state: Any, env: gym.Env) -> None:
    values, wanted = np.asarray(state), env.observation_space.shape
    if values.shape != wanted:
        raise ValueError(f"the observation has shape {values.shape}, the observation space {wanted}")
    if not np.isfinite(values.astype(np.float64)).all():
        raise ValueError(f"the observation is not finite: {values}")


def check_environment(env: EnvConfig) -> None:
    """Raise ConfigError unless an environment's arguments can be recorded, it runs with them, and its names fit.

    Arguments are recorded as JSON, which has no infinite numbers; names are as many as the inputs and actions, no two
    the same, not even of an input and an action.
    """
    for name, value in env.kwargs.items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError as error:
            raise ConfigError(f"env.kwargs.{name}={value}: expected finite numbers, or text in quotes") from error
    if env.kwargs:
        _try_out_with(env.id, json.dumps(env.kwargs, sort_keys=True))
    space, plain = spaces(env), dataclasses.replace(env, pid=None)
    shared = set(feature_names(plain, space.n_inputs)) & set(action_names(plain, space.n_actions))
    if shared:
        raise ConfigError(
            f"a feature and an action are both named {min(shared)!r}: name the {space.n_actions} actions otherwise, "
            "with env.action_names=[...]"
        )
