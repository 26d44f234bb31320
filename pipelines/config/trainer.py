"""Who trains a run: a file of conf/trainer."""

from dataclasses import dataclass
from typing import Annotated

from pipelines.config.algo import SacConfig
from pipelines.config.setting import EXECUTION, FreeText, Range
from pipelines.errors import ConfigError


@dataclass(frozen=True)
class TrainerConfig:
    """Who trains: `sb3`, Stable-Baselines3, one run at a time."""

    name: Annotated[FreeText, EXECUTION]

    def check(self, algo: SacConfig) -> None:
        """Raise ConfigError if the trainer does not train SAC with these settings."""
        for name, before in SacConfig.of_fleets().items():
            if getattr(algo, name) != before:
                raise ConfigError(
                    f"algo.{name}={getattr(algo, name)}: trainer={self.name} has no such setting; leave it out, or use "
                    "trainer=fleet"
                )


@dataclass(frozen=True)
class FleetConfig(TrainerConfig):
    """Many runs of SAC trained as one (`pipelines/training/fleet`); Stable-Baselines3 trains all other algorithms."""

    n_envs: Annotated[int, Range(1, 4096)] = 1  # environments per run; `algo.train_freq` counts the steps of all
    # Runs that are trained as one at most; how they are grouped changes no run on the CPU
    runs_per_process: Annotated[int, Range(1, 4096), EXECUTION] = 5

    def check(self, algo: SacConfig) -> None:
        if algo.ent_coef != "auto" and float(algo.ent_coef) == 0:
            raise ConfigError(
                f"algo.ent_coef={algo.ent_coef}: trainer={self.name} keeps the temperature's logarithm; give auto or a "
                "number above 0, or use trainer=sb3"
            )
        if algo.action_noise == "ornstein_uhlenbeck":
            raise ConfigError(f"trainer={self.name} has no ornstein_uhlenbeck noise; use algo.action_noise=normal")


SHRINK = "shrink"  # conf/trainer/shrink.yaml: the fleet's oracle, imitated briefly and polished by its critics
TRAINERS: dict[str, type[TrainerConfig]] = {"sb3": TrainerConfig, "fleet": FleetConfig}
