"""An actor that is a soft tree, under PPO and SAC of Stable-Baselines3.

The tree gives the logits, or the means of the Gaussian, itself; the critic is the usual MLP. What changes in the course
of training (how hard the tests are, which of pi-PRL's parameters learn, when its structure is chosen) is decided at the
start of each rollout by the steps done so far alone, so that a resumed run is bit for bit the run that was not
interrupted, on one type of processor with the same package versions.
"""

from collections.abc import Callable
from typing import Any, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

import otr
from pipelines.config.algo import SacConfig
from pipelines.config.hardened_methods import SoftConfig
from pipelines.play.episodes import Rollout
from pipelines.play.selection import diverged
from pipelines.training.sb3.normalisation import input_units
from pipelines.training.sb3.relu_actor import ReluActor
from pipelines.training.soft_trees import (
    SAC_TURN,
    Shape,
    SoftModule,
    build_module,
    evaluate_hardened,
    rate_share,
    set_phase,
    shape_of,
)


class SoftActor(ReluActor):
    """A soft tree as the actor; its files are the module's, and the hard tree plays the selection episodes."""

    def policy_class(self) -> type[BasePolicy]:
        return SoftSacPolicy if isinstance(self.config.algo, SacConfig) else SoftActorCriticPolicy

    def net_arch(self) -> list[int]:
        return []  # the tree reads the states unchanged

    def policy_kwargs(self) -> dict[str, Any]:
        return {"actor": shape_of(self.config)}

    def callbacks(self) -> list[BaseCallback]:
        assert isinstance(self.config.method, SoftConfig)
        return [SoftSchedule(self.config.method, self.config.train.steps)]

    def evaluate(self, model: BaseAlgorithm) -> tuple[dict[str, bytes], Rollout]:
        """Return the soft tree's files, and the results of the hard tree's selection episodes."""
        try:
            units = input_units(model, self.config)
            return evaluate_hardened(soft_module(model), self.config, model.action_space, units)
        except otr.InvalidTreeError as error:
            raise diverged(model.num_timesteps, error) from error


class SoftSchedule(BaseCallback):
    """What changes in the course of a training of `n_steps`, set at the start of every rollout."""

    def __init__(self, method: SoftConfig, n_steps: int) -> None:
        super().__init__()
        self._method, self._n_steps = method, n_steps

    def _on_rollout_start(self) -> None:
        """Set how hard the tests are, what of pi-PRL's program learns, and the learning rate, by the steps done."""
        model, n_steps = self.model, self.model.num_timesteps
        turn = model.n_steps * model.n_envs if isinstance(model, OnPolicyAlgorithm) else SAC_TURN
        set_phase(soft_module(model), self._method, n_steps, self._n_steps, turn)
        rate = cast(float, model.learning_rate) * rate_share(self._method, n_steps, self._n_steps)
        # By the steps done: Stable-Baselines3's own measure of progress restarts with each segment.
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
        # The extractor passes the states on unchanged, so that noise may depend on them (use_sde).
        if isinstance(self.action_dist, StateDependentNoiseDistribution):
            n_outputs = self.action_dist.action_dim
        else:
            n_outputs = cast(nn.Linear, self.action_net).out_features
        self.action_net = build_module(self._shape, self.features_dim, n_outputs)
        optimizer_class: Any = self.optimizer_class
        self.optimizer = optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


class SoftSacActor(Actor):
    """SAC's actor with a soft tree for the means; the logarithms of the deviations are linear in the state."""

    def __init__(self, *args: Any, shape: Shape, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.mu = build_module(shape, self.features_dim, get_action_dim(self.action_space))


class SoftSacPolicy(SACPolicy):
    """SAC's policy with a `SoftSacActor`.

    Use with ``policy_kwargs={"actor": Shape(...), "net_arch": {"pi": [], "qf": [256, 256]}}``.
    """

    def __init__(self, *args: Any, actor: Shape, **kwargs: Any) -> None:
        self._shape = actor
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: Any = None) -> SoftSacActor:
        """Return the actor; a method of Stable-Baselines3's."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return SoftSacActor(**kwargs, shape=self._shape).to(self.device)


def soft_module(model: BaseAlgorithm) -> SoftModule:
    """Return the actor of a model whose policy is a `SoftActorCriticPolicy` or a `SoftSacPolicy`."""
    policy = model.policy
    return cast(SoftModule, policy.actor.mu if isinstance(policy, SoftSacPolicy) else policy.action_net)
