"""The settings of a training, and which of them decide the actor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pipelines.config.algo import AlgoConfig
from pipelines.config.method import MethodConfig
from pipelines.config.setting import keyed_settings
from pipelines.config.stages import ActorConfig
from pipelines.config.trainer import FleetConfig
from pipelines.play.episodes import PlaysSelection

FLEET_VERSION = 1  # of the fleet trainer alone; part of its runs' settings


@dataclass(frozen=True)
class TrainSettings(PlaysSelection):
    """What a training reads of a run's configuration, under the same names."""

    algo: AlgoConfig
    actor: ActorConfig
    method: MethodConfig
    depth: Any  # of a hardened method; of a network `hidden_widths`
    hidden_widths: tuple[int, ...]
    fleet: FleetConfig | None
    results_dir: str
    folder: str
    side_by_side: bool
    tracking: str
    settings: Callable[[], dict[str, Any]]  # all of the run's, for its tracking


def train_keys(settings: TrainSettings) -> dict[str, Any]:
    """Return what decides the trained actor; programs' names and later stages' settings do not."""
    env, hidden_widths = settings.env.settings(), list(settings.hidden_widths)
    keyed: dict[str, Any] = {"env": env, "hidden_widths": hidden_widths, "seed": settings.seed}
    keyed |= {name: keyed_settings(getattr(settings, name)) for name in ("algo", "actor", "train")}
    if settings.method.decides_training:
        keyed["method"] = keyed_settings(settings.method)
    if settings.fleet:
        # These two were settings; committed runs, whose keys have them, all have these values.
        former = {"environments": "gymnasium", "precision": "fp32"}
        keyed["trainer"] = {**keyed_settings(settings.fleet), **former, "version": FLEET_VERSION}
    return keyed
