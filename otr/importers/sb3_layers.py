"""The actor's affine layers among the tensors of a policy of Stable-Baselines3 or sb3-contrib.

What is between them folds in: batch normalisation into the layer after it, the quantiles of an action value into
their mean, and the limits of gSDE's mean into a layer of ReLU units.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from otr.core.arrays import FloatArray
from otr.errors import InvalidNetworkError
from otr.importers.torch_modules import real_values

Tensors = dict[str, Any]
Layers = tuple[list[FloatArray], list[FloatArray]]  # weights (n_out, n_in) and biases (n_out,)

# Before version 1.8, Stable-Baselines3 let actor and critic share their first layers.
_SHARED, _POLICY = "mlp_extractor.shared_net.", "mlp_extractor.policy_net."
_QUANTILES = "quantile_net.quantile_net."
_NORM_EPSILON = 1e-3  # of sb3-contrib's BatchRenorm
_NORM_PARTS = ("scale", "bias", "ra_mean", "ra_var", "steps")


def is_searched(tensors: Tensors) -> bool:
    """Return whether the tensors are those of an ARS policy, which has an actor alone."""
    return bool(tensors) and all(name.startswith("action_net.") for name in tensors)


def is_on_policy(tensors: Tensors) -> bool:
    """Return whether the tensors are those of PPO and its kin."""
    return not is_searched(tensors) and any(name.startswith("action_net.") for name in tensors)


def has_limited_mean(tensors: Tensors) -> bool:
    """Return whether the mean is clipped before tanh, as SAC's and TQC's is under gSDE."""
    return "actor.mu.0.weight" in tensors and any(name.startswith("actor.latent_pi.") for name in tensors)


def actor_layers(tensors: Tensors, n_actions: int, mean_limit: float) -> Layers:
    """Return the actor's layers, in order; hidden ones are followed by the policy's units.

    Args:
        tensors: the policy's, by name.
        n_actions: outputs of the actor, of which action values may have several quantiles.
        mean_limit: where gSDE clips the mean before tanh.

    Raises:
        InvalidNetworkError: there is no actor, or it has other layers.
    """
    parts, last = _places(tensors)
    names = [name for part in parts for name in _sequential(tensors, part)] + last
    linear = [name for name in names if f"{name}.weight" in tensors]
    if not names:
        raise InvalidNetworkError(f"no actor among the tensors {sorted(tensors)[:5]} ...; is this a PPO or SAC model?")
    missing = [name for name in names if f"{name}.weight" not in tensors and not _is_norm(tensors, name)]
    if not is_searched(tensors):  # whose layers may be without offsets
        missing += [f"{name}.bias" for name in linear if f"{name}.bias" not in tensors]
    if missing:
        raise InvalidNetworkError(f"the actor's tensor {missing[0]!r} is missing; is this a PPO, SAC or TD3 model?")
    used = {f"{name}.{kind}" for name in linear for kind in ("weight", "bias")}
    used |= {f"{name}.{kind}" for name in set(names) - set(linear) for kind in _NORM_PARTS}
    unused = sorted(name for name in tensors if name.startswith((*parts, *last)) and name not in used)
    if unused:
        raise InvalidNetworkError(f"the actor has the tensor {unused[0]!r}, which no Linear layer has; use 'MlpPolicy'")
    weights, biases = _folded(tensors, names)
    if parts == (_QUANTILES,):
        if len(weights[-1]) % n_actions:
            raise InvalidNetworkError(f"{len(weights[-1])} quantiles are not the same number for {n_actions} actions")
        weights[-1] = weights[-1].reshape(-1, n_actions, weights[-1].shape[1]).mean(axis=0)
        biases[-1] = biases[-1].reshape(-1, n_actions).mean(axis=0)
    if has_limited_mean(tensors) and mean_limit > 0:
        _clip_outputs(weights, biases, mean_limit)
    return weights, biases


def linear_layers(tensors: Tensors, part: str) -> list[str]:
    """Return the names of a Sequential's layers with weights, in order; there are no others in it.

    Raises:
        InvalidNetworkError: it has layers of other kinds.
    """
    return [name for name in _sequential(tensors, part) if f"{name}.weight" in tensors]


def _places(tensors: Tensors) -> tuple[tuple[str, ...], list[str]]:
    """Return the Sequentials that have the actor's layers, and its last layer where that is outside of them."""
    if is_searched(tensors):
        return (("action_net.",), []) if "action_net.weight" not in tensors else ((), ["action_net"])
    if is_on_policy(tensors):
        return (_SHARED, _POLICY), ["action_net"]
    if "actor.mu.weight" in tensors:
        return ("actor.latent_pi.",), ["actor.mu"]
    if has_limited_mean(tensors):
        return ("actor.latent_pi.",), ["actor.mu.0"]
    for part in ("q_net.q_net.", _QUANTILES, "actor.mu."):
        if any(name.startswith(part) for name in tensors):
            return (part,), []
    return (), []


def _sequential(tensors: Tensors, part: str) -> list[str]:
    """Return the names of a Sequential's linear layers and normalisations, in order.

    `create_mlp` alternates linear layers and units, with a normalisation before each linear layer or with none;
    anything else shows in the numbers.
    """
    found = (re.fullmatch(re.escape(part) + r"(\d+)\.\w+", name) for name in tensors)
    positions = sorted({int(match[1]) for match in found if match})
    norms = [i for i in positions if _is_norm(tensors, f"{part}{i}")]
    linear = [i for i in positions if i not in norms]
    usual = list(range(0, 2 * len(linear), 2))
    if norms:  # the last of them may normalise what the next part reads
        usual = list(range(1, 3 * len(linear), 3))
        if norms != list(range(0, 3 * len(norms), 3)) or not 0 <= len(norms) - len(linear) <= 1:
            raise InvalidNetworkError(f"the layers {part}* that normalise are {norms}, expected 0, 3, 6, ...")
    if linear != usual:
        raise InvalidNetworkError(f"the layers {part}* with weights are {linear}, expected {usual}")
    return [f"{part}{i}" for i in positions]


def _is_norm(tensors: Tensors, name: str) -> bool:
    return f"{name}.ra_mean" in tensors


def _folded(tensors: Tensors, names: list[str]) -> Layers:
    """Return the linear layers among some, each reading through the normalisation before it."""
    weights, biases = list[FloatArray](), list[FloatArray]()
    before: tuple[FloatArray, FloatArray] | None = None  # factors and offsets of what the next layer reads

    def values(name: str) -> FloatArray:
        return real_values(tensors[name], name)

    for name in names:
        if _is_norm(tensors, name):
            factor = values(f"{name}.scale") / np.sqrt(values(f"{name}.ra_var") + _NORM_EPSILON)
            before = factor, values(f"{name}.bias") - values(f"{name}.ra_mean") * factor
            continue
        weight = values(f"{name}.weight")
        bias = values(f"{name}.bias") if f"{name}.bias" in tensors else np.zeros(len(weight))
        if before is not None:
            weight, bias, before = weight * before[0], bias + weight @ before[1], None
        weights.append(weight)
        biases.append(bias)
    return weights, biases


def _clip_outputs(weights: list[FloatArray], biases: list[FloatArray], limit: float) -> None:
    """Limit the outputs to [-limit, limit] in place: clip(z) = relu(z + limit) - relu(z - limit) - limit."""
    n = len(biases[-1])
    weights[-1], biases[-1] = np.tile(weights[-1], (2, 1)), np.concatenate((biases[-1] + limit, biases[-1] - limit))
    weights.append(np.concatenate((np.eye(n), -np.eye(n)), axis=1))
    biases.append(np.full(n, -limit))
