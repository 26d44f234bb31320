"""Modules that harden into trees: which one a run trains, what changes as it learns, its files, its hard tree."""

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as safetensors_bytes

import otr
from otr.control.experts import LinearExperts
from otr.control.soft_trees.cascading_tree import CascadingTree
from otr.control.soft_trees.relaxed_program import RelaxedProgram
from otr.control.soft_trees.soft_tree import SoftTree
from pipelines.config.algo import SacConfig
from pipelines.config.hardened_methods import HardenedConfig, PiPrlConfig, SoftConfig
from pipelines.engine.store import corrupt, json_text, read_json
from pipelines.errors import ConfigError
from pipelines.play.episodes import Rollout, play_selection
from pipelines.play.selection import InputUnits
from pipelines.training.settings import TrainSettings

SCHEMA = "otr/soft/1"
SAC_TURN = 2_048  # steps of pi-PRL's program, then as many of its architecture, where rollouts are one step

SoftModule = SoftTree | CascadingTree | RelaxedProgram
HardeningModule = SoftModule | LinearExperts


@dataclass(frozen=True)
class Shape:
    """What module an actor is."""

    kind: str  # sdt, cdt, pi_prl or experts
    options: dict[str, Any]  # what its class takes besides the numbers of inputs and outputs


_SOFT: dict[str, type[SoftModule]] = {"sdt": SoftTree, "cdt": CascadingTree, "pi_prl": RelaxedProgram}
_MODULES: dict[str, type[HardeningModule]] = {**_SOFT, "experts": LinearExperts}


def shape_of(config: TrainSettings) -> Shape:
    """Return the module that a run's method and depth ask for."""
    assert isinstance(config.method, HardenedConfig)
    return Shape(config.method.name, config.method.module_options(config.depth))


def build_module(shape: Shape, n_inputs: int, n_outputs: int, generator: torch.Generator | None = None) -> SoftModule:
    """Return a fresh soft tree; without a generator drawn from torch's own, as all of Stable-Baselines3's policy is."""
    return _SOFT[shape.kind](n_inputs, n_outputs, generator=generator, **shape.options)


def set_phase(module: SoftModule, method: SoftConfig, n_steps: int, of_steps: int, turn: int = SAC_TURN) -> None:
    """Set how hard the tests are, and what of pi-PRL's program learns, after so many steps of all.

    Until its structure is chosen, its program and its architecture learn in turns of `turn` steps.
    """
    done = n_steps / of_steps
    progress = min(1.0, done / method.anneal_until) if method.anneal_until > 0.0 else 1.0
    module.set_beta(method.beta_first * (method.beta_last / method.beta_first) ** progress)
    if isinstance(module, RelaxedProgram):
        assert isinstance(method, PiPrlConfig)
        if done >= method.discretise_at:
            module.discretise()
        is_programs_turn = n_steps // turn % 2 == 0
        module.learns = "program" if module.is_discrete or is_programs_turn else "architecture"


def rate_share(method: SoftConfig, n_steps: int, of_steps: int) -> float:
    """Return the share of the algorithm's learning rate that is left after so many steps of all."""
    return 1.0 + min(1.0, n_steps / of_steps) * (method.learning_rate_end - 1.0)


def evaluate_hardened(
    module: HardeningModule, config: TrainSettings, action_space: "gym.Space[Any]", units: InputUnits | None
) -> tuple[dict[str, bytes], Rollout]:
    """Return a module's files, as it reads the environment's own states, and its hard tree's selection episodes.

    Raises:
        InvalidTreeError: its numbers are not finite.
    """
    module = own_units(module, units)
    tree = harden(module, action_space, is_squashed=isinstance(config.algo, SacConfig))
    return soft_files(module, shape_of(config)), play_selection(tree.predict, config)


def own_units(module: HardeningModule, units: InputUnits | None) -> HardeningModule:
    """Return a copy of a module that reads the environment's own states, whatever units it was trained in."""
    module = copy.deepcopy(module)
    if units is not None:
        module.substitute(-units.middle / units.scale, 1.0 / units.scale)
    return module.float()


def harden(
    module: HardeningModule, action_space: "gym.Space[Any]", *, is_squashed: bool = False, axis_aligned: bool = False
) -> otr.ObliqueTree:
    """Return the hard tree as a policy: labels for discrete actions; continuous ones are clipped to their box.

    `is_squashed`: tanh leads them into the box instead, as it does those of SAC's actors.
    """
    head = _head(action_space, is_squashed)
    if not isinstance(module, RelaxedProgram | LinearExperts):
        return module.harden(head, axis_aligned=axis_aligned)
    if axis_aligned:
        raise ConfigError("pi-PRL's programs and experts have oblique tests; there is no axis-aligned form of them")
    return module.harden(head)


def soft_files(module: HardeningModule, shape: Shape) -> dict[str, bytes]:
    """Return `soft.safetensors` (all parameters and buffers) and `soft.json` (what they belong to)."""
    tensors = {name: tensor.detach().contiguous() for name, tensor in module.state_dict().items()}
    about = {"schema": SCHEMA, "kind": shape.kind, "n_inputs": module.n_inputs, "n_outputs": module.n_outputs}
    text = json_text(about | {"options": shape.options})
    return {"soft.safetensors": safetensors_bytes(tensors), "soft.json": text.encode()}


def load_soft(folder: Path) -> HardeningModule:
    """Return the module of `soft_files`; a truncated or foreign file is an error that names it."""
    about = read_json(folder / "soft.json")
    try:
        if about["schema"] != SCHEMA:
            raise ValueError(f"schema {about['schema']!r} where {SCHEMA!r} was expected")
        module = _MODULES[about["kind"]](about["n_inputs"], about["n_outputs"], **about["options"])
        module.load_state_dict(load_file(folder / "soft.safetensors"))
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError, json.JSONDecodeError) as error:
        raise corrupt(folder / "soft.safetensors", error) from error
    return module


@dataclass(frozen=True)
class SoftPolicy:
    """A soft tree as a policy: what Stable-Baselines3's own did deterministically, in float64.

    In float32 an answer depends on the number of other states in its batch, by some 1e-6 in a cascade, and with that
    the episodes on the number of workers.
    """

    module: HardeningModule
    head: otr.Head

    def __post_init__(self) -> None:
        object.__setattr__(self, "module", copy.deepcopy(self.module).double())

    def predict(self, states: np.ndarray) -> np.ndarray:
        """Return actions (n, a) or labels (n,) for states (n, d)."""
        with torch.no_grad():
            outputs = self.module(torch.as_tensor(states, dtype=torch.float64)).numpy()
        return self.head(outputs)


def _head(action_space: "gym.Space[Any]", is_squashed: bool) -> otr.Head:
    if isinstance(action_space, gym.spaces.Discrete) and action_space.start == 0:
        return otr.Argmax()
    if isinstance(action_space, gym.spaces.Box):
        box = otr.TanhBox if is_squashed else otr.ClipBox
        return box(action_space.low.ravel(), action_space.high.ravel())
    raise ConfigError(f"the actions are {action_space}; only Box and Discrete (start=0) can be trees")
