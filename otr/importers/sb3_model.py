"""The actor of a live Stable-Baselines3 model: saved to memory, read as a file's, compared with what it predicts."""

from __future__ import annotations

import copy
import io
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.core.heads import TanhBox
from otr.core.network import ReluNetwork
from otr.errors import InvalidNetworkError
from otr.importers.assembly import probe_states, reach
from otr.importers.sb3_archive import network_of_file
from otr.importers.torch_modules import refuse_changes

_ROUNDING = 1e-5  # of the size of a sum's terms, in float32
_TIE = 2.0**-20  # between logits whose probabilities, which a categorical policy compares, may be equal in float32


def network_of_model(
    model: Any, action_low: ArrayLike | None, action_high: ArrayLike | None, negative_slope: float | None
) -> ReluNetwork:
    """Return the deterministic actor of a live model; `otr.from_sb3` documents arguments and errors."""
    from stable_baselines3.common.base_class import BaseAlgorithm
    from torch.nn import LeakyReLU

    if not isinstance(model, BaseAlgorithm):
        raise InvalidNetworkError(
            f"expected a PPO, A2C, TRPO, ARS, DQN, SAC, TD3 or DDPG model or a path, got {type(model).__name__}"
        )
    refuse_changes(model.policy, "policy")
    slopes = {part.negative_slope for part in model.policy.modules() if isinstance(part, LeakyReLU)}
    saved = io.BytesIO()
    try:
        model.save(saved)
    except Exception as error:  # what was put into a model may fail to be pickled in any way
        raise InvalidNetworkError(f"model.save fails, and what it writes is read: {error}") from error
    if negative_slope is None and len(slopes) == 1:
        (negative_slope,) = slopes
    network = network_of_file(saved, action_low, action_high, negative_slope)
    _require_same_answers(model, network)
    return network


def _samples(space: Any, n: int) -> list[Any]:
    """Return observations of a space, the same each time."""
    chosen = copy.deepcopy(space)
    chosen.seed(0)
    return [chosen.sample() for _ in range(n)]


def _require_same_answers(model: Any, network: ReluNetwork) -> None:
    """Raise InvalidNetworkError where the model predicts something else than the network, beyond float32's rounding."""
    from gymnasium import spaces

    seen, samples = model.observation_space, list[Any]()
    if isinstance(seen, spaces.Box):
        states = probe_states(network.n_inputs).astype(np.float32)
    else:  # what is flattened can be of its space alone
        samples = _samples(seen, 64)
        flat: list[Any] = [spaces.flatten(seen, each) for each in samples]
        states = np.stack(flat).astype(np.float32)
    outputs = network.forward(states)
    modes = [(part, part.training) for part in model.policy.modules()]  # predict switches to evaluation
    try:
        if samples:
            found = np.stack([model.policy.predict(each, deterministic=True)[0] for each in samples])
        else:
            found = model.policy.predict(states.reshape(-1, *seen.shape), deterministic=True)[0]
        found = found.reshape(len(states), -1)
    except Exception as error:  # foreign code can fail in any way
        raise InvalidNetworkError(
            f"the model cannot predict {len(states)} states of {network.n_inputs} inputs, so its layers cannot be "
            f"compared with it: {error}; take hooks and other changes out of its policy"
        ) from error
    finally:
        for part, mode in modes:
            part.training = mode
    rounding = _ROUNDING * reach(network, states.astype(np.float64))
    if network.head.gives_labels:
        # How far the label's output is below the largest.
        differences = outputs.max(axis=1, keepdims=True) - np.take_along_axis(outputs, found, axis=1)
        rounding = 2 * rounding.max(axis=1, keepdims=True) + _TIE
    else:
        low, high = model.action_space.low.ravel(), model.action_space.high.ravel()
        if isinstance(network.head, TanhBox):
            differences = np.abs(TanhBox(low, high)(outputs) - found)
            rounding = rounding * (high - low) + _ROUNDING * np.maximum(np.abs(low), np.abs(high))
        else:
            differences = np.abs(np.clip(outputs, low, high) - found)
    if not (differences <= rounding).all():
        i = int(np.argmax(np.nan_to_num(differences - rounding, nan=np.inf).max(axis=1)))
        raise InvalidNetworkError(
            f"the model predicts differently from its layers: in state {states[i].tolist()} it does "
            f"{found[i].tolist()}, its layers give {outputs[i].tolist()} (the largest difference is "
            f"{differences.max():g}); take hooks, replaced functions and other changes out of its policy"
        )
