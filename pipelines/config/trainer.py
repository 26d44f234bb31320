"""Who trains a run: a file of conf/trainer."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainerConfig:
    """Who trains: `sb3`, Stable-Baselines3, one run at a time."""

    name: str


@dataclass(frozen=True)
class FleetConfig(TrainerConfig):
    """Many runs of SAC trained as one (`pipelines/training/fleet`); Stable-Baselines3 trains all other algorithms.

    Attributes:
        n_envs: environments a run; as many updates follow each step of all of them.
        precision: fp32, or bf16 for the products between wide layers.
        environments: gymnasium, or envpool (an extra) for the environments that it computes as gymnasium does.
        device: cpu or cuda, which changes nothing but the rounding.
        runs_per_process: runs that are trained as one at most; how they are grouped changes no run on the CPU.
    """

    n_envs: int
    precision: str
    environments: str
    device: str
    runs_per_process: int


TRAINERS: dict[str, type[TrainerConfig]] = {"sb3": TrainerConfig, "fleet": FleetConfig}
