"""How an actor is trained by Stable-Baselines3, whatever kind it is; the answers here are a ReLU network's."""

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy

import otr
from pipelines.play.episodes import Rollout
from pipelines.play.selection import diverged, evaluate_network
from pipelines.training.sb3.normalisation import input_units
from pipelines.training.settings import TrainSettings


class ReluActor:
    """A ReLU network, Stable-Baselines3's own actor; other kinds of actors override what differs."""

    def __init__(self, config: TrainSettings) -> None:
        self.config = config

    def policy_class(self) -> str | type[BasePolicy]:
        """Return the class of the model's policy, or Stable-Baselines3's name for it."""
        return "MlpPolicy"

    def net_arch(self) -> list[int]:
        """Return the widths of the actor's hidden layers."""
        return list(self.config.hidden_widths)

    def policy_kwargs(self) -> dict[str, Any]:
        """Return what the policy's class takes besides the networks' widths and activations."""
        return {}

    def callbacks(self) -> list[BaseCallback]:
        """Return what is called while a segment is learnt."""
        return []

    def segment_learnt(self, model: BaseAlgorithm) -> None:
        """Change the model after a segment, before it is evaluated."""

    def exported(self, model: BaseAlgorithm) -> otr.ReluNetwork:
        """Return the model's actor as a network of the states that it was trained on."""
        return otr.from_sb3(model, normalise=None)

    def evaluate(self, model: BaseAlgorithm) -> tuple[dict[str, bytes], Rollout]:
        """Return the files of the finished actor, and the results of its selection episodes."""
        try:
            network = self.exported(model)
        except otr.InvalidNetworkError as error:
            raise diverged(model.num_timesteps, error) from error
        units = input_units(model, self.config)
        return evaluate_network(network, lambda X: model.predict(X, deterministic=True)[0], self.config, units)
