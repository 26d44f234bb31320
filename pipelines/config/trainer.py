"""Who trains a run: a file of conf/trainer."""

from dataclasses import dataclass
from typing import Annotated

from pipelines.config.algo import AlgoConfig, SacConfig
from pipelines.config.setting import EXECUTION, FreeText, OneOf, Range
from pipelines.errors import ConfigError


@dataclass(frozen=True)
class TrainerConfig:
    """Who trains: `sb3`, Stable-Baselines3, one run at a time."""

    name: Annotated[FreeText, EXECUTION]


@dataclass(frozen=True)
class FleetConfig(TrainerConfig):
    """Many runs of SAC trained as one (`pipelines/training/fleet`); Stable-Baselines3 trains all other algorithms."""

    n_envs: Annotated[int, Range(1, 4096)]  # environments a run; as many updates follow each step of all of them
    precision: Annotated[str, OneOf("fp32", "bf16")]  # fp32, or bf16 for the products between wide layers
    # Runs that are trained as one at most; how they are grouped changes no run on the CPU
    runs_per_process: Annotated[int, Range(1, 4096), EXECUTION]

    def check(self, algo: AlgoConfig) -> None:
        """Raise ConfigError if the fleet does not train SAC with these settings."""
        assert isinstance(algo, SacConfig)
        if (algo.train_freq, algo.gradient_steps) != (1, 1):
            raise ConfigError(
                f"trainer={self.name} does one update for each environment step, but "
                f"algo.train_freq={algo.train_freq} and algo.gradient_steps={algo.gradient_steps}; leave both at 1, or "
                "use trainer=sb3"
            )
        if algo.ent_coef != "auto" and float(algo.ent_coef) == 0:
            raise ConfigError(
                f"algo.ent_coef={algo.ent_coef}: trainer={self.name} keeps the temperature's logarithm; give auto or a "
                "number above 0, or use trainer=sb3"
            )
        if algo.action_noise == "ornstein_uhlenbeck":
            raise ConfigError(f"trainer={self.name} has no ornstein_uhlenbeck noise; use algo.action_noise=normal")


TRAINERS: dict[str, type[TrainerConfig]] = {"sb3": TrainerConfig, "fleet": FleetConfig}
