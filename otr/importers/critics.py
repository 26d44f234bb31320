"""The critics of an actor that was trained off policy, and those in the zip files of Stable-Baselines3."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otr.core.arrays import FloatArray
from otr.errors import ArtefactError, InvalidNetworkError
from otr.extras import naming_the_extra
from otr.files.zip_members import read_members
from otr.importers.input_statistics import find_statistics
from otr.importers.sb3_archive import load_tensors, read_archive, readable_slope
from otr.importers.sb3_layers import Tensors, linear_layers
from otr.importers.torch_modules import real_values

Layers = list[tuple[NDArray[Any], NDArray[Any]]]  # weights (n_critics, w_in, w_out), biases (n_critics, 1, w_out)


@dataclass(frozen=True)
class Critics:
    """Networks of one shape from a state, and below it an action in [-1, 1], to the action's value; their targets.

    Attributes:
        layers, targets: the networks and those that follow them slowly, layer by layer.
        gamma: the discount that they were trained with.
        negative_slope: of their activation below zero, 0 for ReLU.
        log_temperature: of the soft actor-critic; None where the values are without an entropy.
        log_std: rows [weights | offset] (n_actions, h + 1) of the actor's logarithms of deviations, which read what its
            last layer reads; None for an actor without.
    """

    layers: Layers
    targets: Layers
    gamma: float
    negative_slope: float = 0.0
    log_temperature: float | None = None
    log_std: NDArray[Any] | None = None

    @property
    def widths(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""
        return tuple(weight.shape[2] for weight, _ in self.layers[:-1])

    def fold_input_normalisation(self, middle: FloatArray, scale: FloatArray) -> Critics:
        """Return the critics that answer on states x (d,) as these do on (x - middle) / scale."""

        def folded(layers: Layers) -> Layers:
            (weight, bias), *others = layers
            weight, d = weight.copy(), len(middle)
            weight[:, :d] /= scale[:, None]
            return [(weight, bias - middle @ weight[:, :d][:, None]), *others]

        return replace(self, layers=folded(self.layers), targets=folded(self.targets))


@naming_the_extra("otr.read_critics")
def read_critics(file: str | os.PathLike[str]) -> Critics:
    """Return the critics of Stable-Baselines3's SAC, TD3 or DDPG, or of TQC, by which `imitate` polishes a tree.

    Args:
        file: the path of the zip file that `model.save` wrote; no code in it is run.

    Raises:
        InvalidNetworkError: it has no critics of (leaky) ReLU units, or they judge what VecNormalize made of states.
        ArtefactError: the file cannot be read.
        MissingExtraError: torch is not installed.

    Examples:
        >>> from stable_baselines3 import SAC
        >>> SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [16, 8]}).save("model.zip")
        >>> otr.read_critics("model.zip").widths
        (16, 8)
    """
    path = Path(file)
    critics = critics_of_zip(path)
    if critics is None:
        raise InvalidNetworkError(
            f"{path} has no critics of (leaky) ReLU units, as SAC, TD3, DDPG and TQC have; polish by a search"
        )
    if any(find_statistics(path)):
        raise InvalidNetworkError(
            f"{path}: its critics judge states and rewards as VecNormalize made them, and not the environment's; "
            "polish by a search"
        )
    return critics


def critics_of_zip(path: Path) -> Critics | None:
    """Return the critics in a zip file of Stable-Baselines3's SAC, TD3, DDPG or TQC, read without running code from it.

    None where it has none (PPO, DQN), normalised ones (CrossQ), others that are no (leaky) ReLU networks, or no
    discount.

    Raises:
        ArtefactError: the file cannot be read.
        InvalidNetworkError: its tensors are no networks.
    """
    tensors, data = read_archive(path)
    slope = readable_slope(data)
    n_critics = sum(name.startswith("critic.qf") and name.endswith(".0.weight") for name in tensors)
    gamma = data.get("gamma")
    if not n_critics or slope is None or not isinstance(gamma, int | float):
        return None
    log_std = None
    if "actor.log_std.weight" in tensors:
        parts = (real_values(tensors[f"actor.log_std.{kind}"], f"actor.log_std.{kind}") for kind in ("weight", "bias"))
        log_std = np.column_stack(list(parts))
    layers, targets = (_layers(tensors, part, n_critics) for part in ("critic", "critic_target"))
    return Critics(layers, targets, float(gamma), slope, _log_temperature(path, data), log_std)


def _layers(tensors: Tensors, part: str, n_critics: int) -> Layers:
    """Return critics' layers; of TQC's quantiles their mean."""
    names = [linear_layers(tensors, f"{part}.qf{critic}.") for critic in range(n_critics)]
    layers = [
        (
            np.stack([real_values(tensors[f"{name}.weight"], name).T for name in layer]),
            np.stack([real_values(tensors[f"{name}.bias"], name)[None] for name in layer]),
        )
        for layer in zip(*names, strict=True)
    ]
    weight, bias = layers[-1]
    return [*layers[:-1], (weight.mean(axis=2, keepdims=True), bias.mean(axis=2, keepdims=True))]


def _log_temperature(path: Path, data: dict[str, object]) -> float | None:
    """Return the logarithm of SAC's temperature, learnt or fixed."""
    if "ent_coef" not in data:
        return None
    if not path.exists() and path.suffix != ".zip":
        path = path.with_name(path.name + ".zip")
    label = f"pytorch_variables.pth in {path}"
    (_, content), *_ = read_members(path, str(path), ["pytorch_variables.pth"])
    found = load_tensors(content, label)
    if "log_ent_coef" in found:
        return float(found["log_ent_coef"].detach())
    if "ent_coef_tensor" in found:
        return float(np.log(max(float(found["ent_coef_tensor"]), 1e-8)))
    raise ArtefactError(f"{label} holds no temperature, only {sorted(found)[:5]}; save the model again")
