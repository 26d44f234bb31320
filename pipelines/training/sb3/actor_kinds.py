"""Which kind of actor a run trains by Stable-Baselines3."""

from pipelines.config.hardened_methods import SoftConfig
from pipelines.config.method import MethodConfig
from pipelines.config.methods import PidConfig
from pipelines.training.sb3.pid_actor import PidActor
from pipelines.training.sb3.relu_actor import ReluActor
from pipelines.training.sb3.soft_actor import SoftActor
from pipelines.training.settings import TrainSettings

ACTORS: dict[type[MethodConfig], type[ReluActor]] = {PidConfig: PidActor, SoftConfig: SoftActor}


def actor_of(config: TrainSettings) -> ReluActor:
    """Return a run's kind of actor, by the nearest class of its method that has one: a ReLU network if none has."""
    kinds = (ACTORS[method] for method in type(config.method).__mro__ if method in ACTORS)
    return next(kinds, ReluActor)(config)
