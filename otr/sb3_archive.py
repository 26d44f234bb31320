"""The actor in a Stable-Baselines3 zip file, read without running anything that the file contains.

Such a file holds `policy.pth`, tensors that torch can load with ``weights_only=True``, and `data`, JSON in which Python
objects appear as a pickle (":serialized:", never touched here) beside a readable account of themselves.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.arrays import FloatArray
from otr.errors import ArtefactError, InvalidNetworkError
from otr.head import Argmax, ClipBox, Head, TanhBox

__all__ = ["ArchivedActor", "read_actor"]

_RELU = "<class 'torch.nn.modules.activation.ReLU'>"
_LEAKY_RELU = "<class 'torch.nn.modules.activation.LeakyReLU'>"
_LEAKY_RELU_SLOPE = 0.01  # torch's default

_ON_POLICY_PARTS = ("mlp_extractor.", "action_net.", "value_net.", "log_std")
_OFF_POLICY_PARTS = ("actor.latent_pi.", "actor.mu.", "actor.log_std.", "actor_target.", "critic.", "critic_target.",
                     "q_net.q_net.", "q_net_target.")  # fmt: skip


@dataclass(frozen=True)
class ArchivedActor:
    """An actor's layers, as `ReluNetwork` takes them."""

    weights: list[FloatArray]
    biases: list[FloatArray]
    negative_slope: float
    head: Head


def read_actor(
    path: str | os.PathLike[str],
    *,
    action_low: ArrayLike | None,
    action_high: ArrayLike | None,
    negative_slope: float | None,
) -> ArchivedActor:
    """Return the actor in the zip file at `path`; `otr.from_sb3` documents arguments and errors."""
    tensors, data = _read_members(Path(path))
    on_policy = any(name.startswith("action_net.") for name in tensors)
    _refuse_other_policies(tensors, data, _ON_POLICY_PARTS if on_policy else _OFF_POLICY_PARTS)
    weights, biases = _actor_layers(tensors, on_policy)
    slope = _slope(data, on_policy, negative_slope) if len(weights) > 1 else 0.0
    return ArchivedActor(weights, biases, slope, _head(data, on_policy, len(biases[-1]), action_low, action_high))


def _read_members(path: Path) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Return the tensors of `policy.pth` by name, and the JSON of `data`."""
    import torch

    if not path.exists() and path.suffix != ".zip":
        path = path.with_name(path.name + ".zip")
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
            tensors = torch.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise ArtefactError(f"{path} does not exist; give the path of a saved Stable-Baselines3 model") from error
    except KeyError as error:
        raise ArtefactError(f"{path} is no saved Stable-Baselines3 model: {error}") from error
    except pickle.UnpicklingError as error:
        raise ArtefactError(f"policy.pth in {path} holds more than tensors, and was not loaded: {error}") from error
    except (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise ArtefactError(f"{path} cannot be read ({error}); save the model again") from error
    if not isinstance(data, dict) or not isinstance(tensors, dict):
        raise ArtefactError(f"{path} is no saved Stable-Baselines3 model: data or policy.pth is no dictionary")
    return {name: tensor.double().numpy() for name, tensor in tensors.items() if torch.is_tensor(tensor)}, data


def _refuse_other_policies(tensors: dict[str, FloatArray], data: dict[str, Any], parts: tuple[str, ...]) -> None:
    """Raise InvalidNetworkError unless the policy is an MlpPolicy on a vector, as far as the file tells."""
    if data.get("use_sde"):
        raise InvalidNetworkError("the model uses gSDE; train with use_sde=False")
    others = sorted(name for name in tensors if not name.startswith(parts))
    if others:
        raise InvalidNetworkError(
            f"the policy has the tensor {others[0]!r}; only PPO, A2C, TRPO, DQN, SAC, TD3 and DDPG with "
            "'MlpPolicy' and ARS with 'LinearPolicy', and no feature extractor with weights, can be mapped"
        )
    module = _readable(data, "policy_class").get("__module__", "")
    is_linear = tensors.keys() <= {"action_net.0.weight", "action_net.0.bias"}
    expected = r"sb3_contrib\.ars\.policies" if is_linear else r"stable_baselines3\.(common|dqn|sac|td3)\.policies"
    if is_linear and _readable(data, "policy_kwargs").get("squash_output"):
        raise InvalidNetworkError("the policy squashes its outputs; train with squash_output=False")
    if not re.fullmatch(expected, str(module)):
        raise InvalidNetworkError(
            f"the policy's class is from {module!r}; train with 'MlpPolicy', or ARS with 'LinearPolicy'"
        )
    extractor = str(_readable(data, "policy_kwargs").get("features_extractor_class", "FlattenExtractor"))
    if "stable_baselines3.common.torch_layers.FlattenExtractor" not in extractor and extractor != "FlattenExtractor":
        raise InvalidNetworkError(f"the policy has the feature extractor {extractor}; leave it at FlattenExtractor")
    space = _readable(data, "observation_space")
    if "spaces.box.Box" not in str(space.get(":type:")) or len(space.get("_shape") or ()) > 2:
        raise InvalidNetworkError(f"the observations are {space.get(':type:')}; only vectors of inputs can be mapped")


def _actor_layers(tensors: dict[str, FloatArray], on_policy: bool) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the actor's weights and biases, in order of the layers."""
    if "action_net.0.weight" in tensors:  # ARS's LinearPolicy, whose offsets are optional
        W = tensors["action_net.0.weight"]
        return [W], [tensors.get("action_net.0.bias", np.zeros(len(W)))]
    hidden, last = ("mlp_extractor.policy_net.", "action_net") if on_policy else ("actor.latent_pi.", "actor.mu")
    if not on_policy and "actor.mu.weight" not in tensors:
        # TD3, DDPG and DQN hold all layers in one Sequential.
        hidden, last = "q_net.q_net." if "q_net.q_net.0.weight" in tensors else "actor.mu.", ""
    positions = sorted(
        int(match[1]) for name in tensors if (match := re.fullmatch(re.escape(hidden) + r"(\d+)\.weight", name))
    )
    # create_mlp alternates Linear and activation; anything else, such as a normalisation layer, shows in the numbers.
    if positions != list(range(0, 2 * len(positions), 2)):
        raise InvalidNetworkError(f"the layers {hidden}* with weights are {positions}, expected 0, 2, 4, ...")
    names = [f"{hidden}{position}" for position in positions] + ([last] if last else [])
    try:
        layers = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
    except KeyError as error:
        raise InvalidNetworkError(f"the actor's tensor {error} is missing; is this a PPO, SAC or TD3 model?") from error
    if not layers:
        raise InvalidNetworkError(f"no actor among the tensors {sorted(tensors)[:5]} ...; is this a PPO or SAC model?")
    return [W for W, _ in layers], [b for _, b in layers]


def _slope(data: dict[str, Any], on_policy: bool, given: float | None) -> float:
    """Return the activation's negative slope, from the readable account of `policy_kwargs`."""
    default = "<class 'torch.nn.modules.activation.Tanh'>" if on_policy else _RELU
    activation = str(_readable(data, "policy_kwargs").get("activation_fn", default))
    known = {_RELU: 0.0, _LEAKY_RELU: _LEAKY_RELU_SLOPE}.get(activation)
    if known is None and not (given is not None and "LeakyReLU" in activation):
        raise InvalidNetworkError(
            f"the activation is {activation}; a tree needs activation_fn=nn.ReLU or nn.LeakyReLU"
            + (" (for this LeakyReLU, give negative_slope=)" if "LeakyReLU" in activation else "")
        )
    if known is not None and given is not None and known != given:
        raise InvalidNetworkError(f"negative_slope is {given}, the file says {activation}, whose slope is {known}")
    return float(known if known is not None else given)  # type: ignore[arg-type]


def _head(data: dict[str, Any], on_policy: bool, n_outputs: int, low: ArrayLike | None, high: ArrayLike | None) -> Head:
    """Return the head that the readable account of the action space asks for."""
    space = _readable(data, "action_space")
    kind = str(space.get(":type:"))
    if "spaces.discrete.Discrete" in kind and str(space.get("start", "0")) == "0":
        return Argmax()
    if "spaces.box.Box" not in kind:
        raise InvalidNetworkError(f"the actions are {kind}; only Box and Discrete (start=0) can be mapped")
    low = _limits(space, "low", n_outputs) if low is None else low
    high = _limits(space, "high", n_outputs) if high is None else high
    return ClipBox(low, high) if on_policy else TanhBox(low, high)


def _limits(space: dict[str, Any], name: str, n_outputs: int) -> FloatArray:
    """Return the action limits printed in the file, (n_outputs,)."""
    text = str(space.get(name))
    try:
        limits = np.array(text.replace("[", " ").replace("]", " ").split(), dtype=str(space.get("dtype", "float32")))
    except (TypeError, ValueError):
        limits = np.zeros(0)
    if limits.shape != (n_outputs,):
        raise InvalidNetworkError(
            f"the action space's {name} reads {text!r}, expected {n_outputs} numbers; give action_{name}="
        )
    return limits.astype(np.float64)


def _readable(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the readable account of an object in `data`, without its pickle."""
    account = data.get(name)
    return {key: value for key, value in account.items() if key != ":serialized:"} if isinstance(account, dict) else {}
