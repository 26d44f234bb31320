"""One run, whole."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from pipelines.config.algo import AlgoConfig, ArsConfig, SacConfig
from pipelines.config.budget import BudgetConfig
from pipelines.config.checks import check
from pipelines.config.env import EnvConfig
from pipelines.config.methods import EXTRA_STAGES, MethodConfig
from pipelines.config.stages import (
    ActorConfig,
    CertificationConfig,
    EvaluateConfig,
    ImitateConfig,
    MapConfig,
    PruneConfig,
    SimplificationConfig,
    TrainConfig,
)
from pipelines.config.trainer import FleetConfig, TrainerConfig


@dataclass(frozen=True)
class RunConfig:
    """One run. What is below `results_dir` changes how it is executed, never what comes out."""

    env: EnvConfig
    algo: AlgoConfig
    method: MethodConfig
    budget: BudgetConfig
    depth: Any  # an int, or a list of ints: one hidden layer each
    seed: int
    actor: ActorConfig
    train: TrainConfig
    map: MapConfig
    prune: PruneConfig
    evaluate: EvaluateConfig
    results_dir: str
    trainer: TrainerConfig = field(default_factory=lambda: TrainerConfig("sb3"))
    stages: list[str] | None = None
    n_workers: int | None = None
    side_by_side: bool = False  # other jobs share the terminal
    debug: bool = False
    certify: bool = False  # a further stage: the minimal tree and its certificate
    simplify: bool = False  # a further stage: a shorter program
    tracking: str = "none"  # where runs are also logged: none, tensorboard, mlflow
    oracle: list[int] = field(default_factory=lambda: [256, 256])  # hidden widths of the network that is imitated
    imitate: ImitateConfig = field(default_factory=ImitateConfig)
    certification: CertificationConfig = field(default_factory=CertificationConfig)
    simplification: SimplificationConfig = field(default_factory=SimplificationConfig)
    # The text of method=program, which the command line reads: the run is keyed by it, whatever file it came from.
    program_text: str | None = field(default=None, metadata={"omegaconf_ignore": True})
    # The run's folder below results_dir, which the command line works out from all of the above.
    folder: str = field(default="", metadata={"omegaconf_ignore": True})
    # The run that trains the oracle, for a method that imitates one; worked out there, too.
    oracle_run: "RunConfig | None" = field(default=None, metadata={"omegaconf_ignore": True})

    def __post_init__(self) -> None:
        if self.method.pid_terms:  # in one place, so that every stage sees the same environment
            object.__setattr__(self, "env", dataclasses.replace(self.env, pid=self.method.pid_terms))
        check(self)

    @property
    def hidden_widths(self) -> tuple[int, ...]:
        """Widths of the actor's hidden layers; empty for depth 0, the linear policy."""
        widths = [self.depth] if isinstance(self.depth, int) else list(self.depth)
        return tuple(width for width in widths if width > 0)

    @property
    def fleet(self) -> FleetConfig | None:
        """The fleet's settings where a fleet trains this run; None where Stable-Baselines3 does."""
        trains_sac = isinstance(self.algo, SacConfig) and not self.method.is_written
        return self.trainer if isinstance(self.trainer, FleetConfig) and trains_sac else None

    @property
    def trainer_name(self) -> str:
        """Who trains this run: `sb3`, the fleet's name, or `none` for a program."""
        if self.method.is_written:
            return "none"
        return self.fleet.name if self.fleet else "sb3"

    @property
    def budget_level(self) -> str:
        """The budget's name in the run's folder, with who trained where that is no gradient by Stable-Baselines3."""
        if isinstance(self.algo, ArsConfig):
            return f"{self.budget.name}-{self.algo.name}"
        return f"{self.budget.name}-{self.fleet.name}" if self.fleet else self.budget.name

    @property
    def selected_stages(self) -> tuple[str, ...]:
        """The stages to do, in the method's order."""
        stages = self.method.stages
        if self.stages is not None:
            return tuple(stage for stage in (*stages, *EXTRA_STAGES) if stage in self.stages)
        return (*stages, *(stage for stage in EXTRA_STAGES if getattr(self, stage)))
