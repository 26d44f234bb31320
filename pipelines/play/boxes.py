"""Boxes of states as text, `angle in -0.2..0.2`: written, and read into limits."""

import re
from collections.abc import Sequence

import numpy as np

import otr
from pipelines.config.env import EnvConfig
from pipelines.config.stages import SIDE
from pipelines.errors import ConfigError, did_you_mean
from pipelines.play.spaces import feature_names, state_sides

SHOWN = 12  # sides; a box of more is cut


def given_box(env: EnvConfig, sides: Sequence[str]) -> otr.Domain:
    """Return the box of the sides that are given; what is not named is within the environment's own limits.

    Raises:
        ConfigError: a side cannot be read, names no state or one twice, or a state without limits has no side.
    """
    low, high = (limits.copy() for limits in state_sides(env))
    names = feature_names(env, len(low))
    given = dict[str, str]()
    for side in sides:
        match = re.fullmatch(SIDE, side)
        name = match[1] if match else side
        if match is None or name not in names or name in given:
            why = "which has a side already" if name in given else f"there is no such state.{did_you_mean(name, names)}"
            raise ConfigError(f"box: {side}: {why if match else 'give a side as NAME in LOW..HIGH'}")
        given[name], i = side, names.index(name)
        low[i], high[i] = float(match[2]), float(match[3])
        if not low[i] <= high[i]:
            raise ConfigError(f"box: {side}: {low[i]:g} is above {high[i]:g}, lower first")
    is_open = ~(np.isfinite(low) & np.isfinite(high))
    missing = [
        f"{name} in LOW..HIGH" for name, is_so in zip(names, is_open, strict=True) if is_so and name not in given
    ]
    if missing:
        raise ConfigError(f"box: {env.id} has no limits for some states: add {', '.join(missing)}")
    try:
        return otr.Domain(low, high)
    except ValueError as error:
        raise ConfigError(f"box: {error}") from error


def box_around(states: np.ndarray, margin: float) -> otr.Domain:
    """Return the box around states (n, d) and a share of its width more on either side."""
    low, high = states.min(axis=0), states.max(axis=0)
    beyond = margin * (high - low) + np.finfo(np.float32).eps * np.maximum(1.0, np.abs(high))
    return otr.Domain(low - beyond, high + beyond)


def box_in_words(domain: otr.Domain, names: Sequence[str]) -> str:
    """Return a box as text, its sides as `box=` takes them; of many sides the first ones."""
    sides = zip(names, (domain.low + 0.0).tolist(), (domain.high + 0.0).tolist(), strict=True)  # 0, not -0
    words = [f"{name} in {low:.4g}..{high:.4g}" for name, low, high in sides]
    more = [f"{len(words) - SHOWN} more"] if len(words) > SHOWN else []
    return ", ".join([*words[:SHOWN], *more])
