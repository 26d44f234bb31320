"""An actor that is a soft tree, under PPO and TRPO of Stable-Baselines3.

The tree gives the logits, or the means of the Gaussian, itself; the critic is the usual MLP. What changes in the course
of training (how hard the tests are, which of pi-PRL's parameters learn, when its structure is chosen) is decided at the
start of each rollout by the steps done so far alone, so that a resumed run is bit for bit the run that was not
interrupted, on one type of processor with the same package versions.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

import otr
from otr.control.pi_prl import RelaxedProgram
from pipelines.config.methods import PiPrlConfig, SoftConfig
from pipelines.config.run import RunConfig
from pipelines.play.environments import state_box
from pipelines.play.rollout import Rollout
from pipelines.play.selection import diverged, play_episodes
from pipelines.training.relu_actor import ReluActor
from pipelines.training.soft_trees import Shape, SoftModule, build_module, harden, shape_of, soft_files


class SoftActor(ReluActor):
    """A soft tree as the actor; its files are the module's, and the hard tree plays the selection episodes."""

    def policy_class(self) -> type[ActorCriticPolicy]:
        """Return the policy with a soft tree as its actor."""
        return SoftActorCriticPolicy

    def net_arch(self) -> list[int]:
        """Return no hidden layers: the states go into the tree as they are."""
        return []

    def policy_kwargs(self) -> dict[str, Any]:
        """Return the tree's shape."""
        return {"actor": shape_of(self.config)}

    def callbacks(self) -> list[BaseCallback]:
        """Return what changes in the course of training."""
        return [SoftSchedule(schedule_of(self.config))]

    def evaluate(self, model: BaseAlgorithm) -> tuple[dict[str, bytes], Rollout]:
        """Return the soft tree's files, and what came of the hard tree's selection episodes."""
        assert isinstance(model, OnPolicyAlgorithm)
        module = exported_module(model, self.config)
        try:
            tree = harden(module, model.action_space)
        except otr.InvalidTreeError as error:
            raise diverged(model.num_timesteps, error) from error
        return soft_files(module, shape_of(self.config)), play_episodes(tree.predict, self.config)


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
