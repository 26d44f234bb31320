"""Policies of Stable-Baselines3 whose actor is a soft tree, under PPO and TRPO.

The tree gives the logits, or the means of the Gaussian, itself; the critic is the usual MLP. What changes in the course
of training (how hard the tests are, which of pi-PRL's parameters learn, when its structure is chosen) is decided at the
start of each rollout by the steps done so far alone, so that a resumed run is bit for bit the run that was not
interrupted, on one type of processor with the same package versions.
"""

import copy
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as safetensors_bytes
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

import otr
from otr.control.cdt import CascadingTree
from otr.control.pi_prl import RelaxedProgram
from otr.control.soft_tree import SoftTree
from pipelines.config import CdtConfig, PiPrlConfig, RunConfig, SdtConfig, SoftConfig
from pipelines.engine.store import corrupt, json_text, read_json
from pipelines.errors import ConfigError
from pipelines.play.environments import state_box

SCHEMA = "otr/soft/1"

SoftModule = SoftTree | CascadingTree | RelaxedProgram


@dataclass(frozen=True)
class Shape:
    """What module an actor is.

    Attributes:
        kind: sdt, cdt or pi_prl.
        options: what its class takes beside the numbers of inputs and outputs.
    """

    kind: str
    options: dict[str, Any]


_MODULES: dict[str, type[SoftModule]] = {"sdt": SoftTree, "cdt": CascadingTree, "pi_prl": RelaxedProgram}


def shape_of(config: RunConfig) -> Shape:
    """Return the module that a run's method and depth ask for."""
    method, depth = config.method, config.depth
    if isinstance(method, SdtConfig):
        return Shape("sdt", {"depth": depth, "affine_leaves": method.leaves == "linear"})
    if isinstance(method, CdtConfig):
        options = {"feature_depth": depth[0], "n_features": method.n_features, "decision_depth": depth[1]}
        return Shape("cdt", options)
    assert isinstance(method, PiPrlConfig)
    return Shape("pi_prl", {"depth": depth, "structure_penalty": method.structure_penalty})


def schedule_of(config: RunConfig) -> "ScheduleConfig":
    """Return what changes in the course of a run's training."""
    method = config.method
    assert isinstance(method, SoftConfig)
    discretise_at = method.discretise_at if isinstance(method, PiPrlConfig) else 1.0
    return ScheduleConfig(
        config.train.steps,
        method.beta_first,
        method.beta_last,
        method.anneal_until,
        discretise_at,
        method.learning_rate_end,
    )


@dataclass(frozen=True)
class ScheduleConfig:
    """What changes in the course of training, in fractions of `n_steps`.

    Attributes:
        n_steps: environment steps of the whole training.
        beta_first, beta_last: how hard the tests are at first and at last; in between beta grows geometrically.
        anneal_until: fraction at which beta has reached its last value.
        discretise_at: fraction at which pi-PRL's structure is chosen; before it, rollouts update its program and its
            architecture in turns.
        learning_rate_end: what is left of the learning rate at the end, falling linearly.
    """

    n_steps: int
    beta_first: float
    beta_last: float
    anneal_until: float
    discretise_at: float
    learning_rate_end: float = 1.0

    def learning_rate(self, first: float, num_timesteps: int) -> float:
        """Return the learning rate of the rollout that begins after `num_timesteps`."""
        done = min(1.0, num_timesteps / self.n_steps)
        return first * (1.0 + done * (self.learning_rate_end - 1.0))

    def apply(self, module: SoftModule, num_timesteps: int, rollout_steps: int) -> None:
        """Bring `module` to what holds for the rollout that begins after `num_timesteps`."""
        done = num_timesteps / self.n_steps
        progress = min(1.0, done / self.anneal_until) if self.anneal_until > 0.0 else 1.0
        module.set_beta(self.beta_first * (self.beta_last / self.beta_first) ** progress)
        if isinstance(module, RelaxedProgram):
            if done >= self.discretise_at:
                module.discretise()
            in_turn = (num_timesteps // rollout_steps) % 2 == 0
            module.learns = "program" if module.is_discrete or in_turn else "architecture"


class SoftSchedule(BaseCallback):
    """Applies a `ScheduleConfig` at the start of every rollout."""

    model: OnPolicyAlgorithm

    def __init__(self, schedule: ScheduleConfig) -> None:
        super().__init__()
        self._schedule = schedule

    def _on_rollout_start(self) -> None:
        rollout_steps = self.model.n_steps * self.model.n_envs
        num_timesteps = self.model.num_timesteps
        self._schedule.apply(soft_module(self.model), num_timesteps, rollout_steps)
        rate = self._schedule.learning_rate(cast(float, self.model.learning_rate), num_timesteps)
        # By the steps done: Stable-Baselines3's own measure of progress begins anew with each segment.
        self.model.lr_schedule = lambda _progress_remaining: rate

    def _on_step(self) -> bool:
        return True


class SoftActorCriticPolicy(ActorCriticPolicy):
    """An actor that is a soft tree, and a critic that is an MLP.

    Use with ``policy_kwargs={"actor": Shape(...), "net_arch": {"pi": [], "vf": [64, 64]}}``.
    """

    def __init__(self, *args: Any, actor: Shape, **kwargs: Any) -> None:
        self._shape = actor
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        super()._build(lr_schedule)
        # The extractor hands the states on as they are, so that noise may depend on them (use_sde).
        if isinstance(self.action_dist, StateDependentNoiseDistribution):
            n_outputs = self.action_dist.action_dim
        else:
            n_outputs = cast(nn.Linear, self.action_net).out_features
        self.action_net = build_module(self._shape, self.features_dim, n_outputs)
        optimizer_class: Any = self.optimizer_class
        self.optimizer = optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


def build_module(shape: Shape, n_inputs: int, n_outputs: int) -> SoftModule:
    """Return a fresh module, drawn from torch's own generator as all of a Stable-Baselines3 policy is."""
    return _MODULES[shape.kind](n_inputs, n_outputs, **shape.options)


def soft_module(model: OnPolicyAlgorithm) -> SoftModule:
    """Return the actor of a model whose policy is a `SoftActorCriticPolicy`."""
    return cast(SoftModule, model.policy.action_net)


def exported_module(model: OnPolicyAlgorithm, config: RunConfig) -> SoftModule:
    """Return a copy of a model's actor that reads the environment's own states, where training rescales them too."""
    module = copy.deepcopy(soft_module(model))
    if config.actor.rescale_inputs:
        middle, half_width = state_box(config.env)
        module.substitute(-middle / half_width, 1.0 / half_width)
    return module.float()


def harden(module: SoftModule, action_space: "gym.Space[Any]", *, axis_aligned: bool = False) -> otr.ObliqueTree:
    """Return the hard tree as a policy: labels for discrete actions, values clipped to the box for continuous ones.

    Raises:
        ConfigError: the actions are neither, or a relaxed program is asked for axis-aligned tests.
    """
    head = _head(action_space)
    if not isinstance(module, RelaxedProgram):
        return module.harden(head, axis_aligned=axis_aligned)
    if axis_aligned:
        raise ConfigError("pi-PRL's programs have oblique tests; there is no axis-aligned form of them")
    return module.harden(head)


def soft_files(module: SoftModule, shape: Shape) -> dict[str, bytes]:
    """Return `soft.safetensors` (all parameters and buffers) and `soft.json` (what they belong to)."""
    tensors = {name: tensor.detach().contiguous() for name, tensor in module.state_dict().items()}
    about = {"schema": SCHEMA, "kind": shape.kind, "n_inputs": module.n_inputs, "n_outputs": module.n_outputs}
    text = json_text(about | {"options": shape.options})
    return {"soft.safetensors": safetensors_bytes(tensors), "soft.json": text.encode()}


def load_soft(folder: Path) -> SoftModule:
    """Return the module of `soft_files`; a truncated or foreign file is an error that names it."""
    about = read_json(folder / "soft.json")
    try:
        if about["schema"] != SCHEMA:
            raise ValueError(f"schema {about['schema']!r} where {SCHEMA!r} was expected")
        module = build_module(Shape(about["kind"], about["options"]), about["n_inputs"], about["n_outputs"])
        module.load_state_dict(load_file(folder / "soft.safetensors"))
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError, json.JSONDecodeError) as error:
        raise corrupt(folder / "soft.safetensors", error) from error
    return module


@dataclass(frozen=True)
class SoftPolicy:
    """A soft tree as a policy: what Stable-Baselines3's own did deterministically."""

    module: SoftModule
    head: otr.Head

    def predict(self, states: np.ndarray) -> np.ndarray:
        """Return actions (n, a) or labels (n,) for states (n, d)."""
        with torch.no_grad():
            outputs = self.module(torch.as_tensor(states, dtype=torch.float32)).numpy().astype(np.float64)
        return self.head(outputs)


def _head(action_space: "gym.Space[Any]") -> otr.Head:
    if isinstance(action_space, gym.spaces.Discrete) and action_space.start == 0:
        return otr.Argmax()
    if isinstance(action_space, gym.spaces.Box):
        return otr.ClipBox(action_space.low.ravel(), action_space.high.ravel())
    raise ConfigError(f"the actions are {action_space}; only Box and Discrete (start=0) can be trees")
