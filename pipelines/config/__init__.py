"""What a run is asked to do: frozen dataclasses, a module a group of conf/, validated once.

Hydra composes these from `conf/` (see `pipelines/cli`); nothing here knows Hydra.
"""

from pipelines.config.algo import (
    ALGORITHMS,
    AlgoConfig,
    ArsConfig,
    ContinuousConfig,
    DdpgConfig,
    DqnConfig,
    GradientConfig,
    OffPolicyConfig,
    OnPolicyConfig,
    PpoConfig,
    SacConfig,
    Td3Config,
    TrpoConfig,
)
from pipelines.config.budget import BudgetConfig
from pipelines.config.env import EnvConfig, PidTerms
from pipelines.config.methods import (
    METHODS,
    AugTreeConfig,
    CdtConfig,
    ImitatingConfig,
    LmViperConfig,
    MappedConfig,
    MethodConfig,
    NdpsConfig,
    PidConfig,
    PiPrlConfig,
    ProgramConfig,
    SdtConfig,
    SoftConfig,
    ViperConfig,
)
from pipelines.config.run import RunConfig
from pipelines.config.stages import (
    ActorConfig,
    EvaluateConfig,
    ImitateConfig,
    MapConfig,
    PruneConfig,
    TrainConfig,
)
from pipelines.config.trainer import TRAINERS, FleetConfig, TrainerConfig

__all__ = [
    "ALGORITHMS",
    "METHODS",
    "TRAINERS",
    "ActorConfig",
    "AlgoConfig",
    "ArsConfig",
    "AugTreeConfig",
    "BudgetConfig",
    "CdtConfig",
    "ContinuousConfig",
    "DdpgConfig",
    "DqnConfig",
    "EnvConfig",
    "EvaluateConfig",
    "FleetConfig",
    "GradientConfig",
    "ImitateConfig",
    "ImitatingConfig",
    "LmViperConfig",
    "MapConfig",
    "MappedConfig",
    "MethodConfig",
    "NdpsConfig",
    "OffPolicyConfig",
    "OnPolicyConfig",
    "PiPrlConfig",
    "PidConfig",
    "PidTerms",
    "PpoConfig",
    "ProgramConfig",
    "PruneConfig",
    "RunConfig",
    "SacConfig",
    "SdtConfig",
    "SoftConfig",
    "Td3Config",
    "TrainConfig",
    "TrainerConfig",
    "TrpoConfig",
    "ViperConfig",
]
