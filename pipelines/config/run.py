"""One run, whole."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from otr.control.settings import DaggerSettings
from pipelines.config.algo import AlgoConfig, ArsConfig, PpoConfig, SacConfig, widths_of
from pipelines.config.budget import BudgetConfig
from pipelines.config.env import EnvConfig
from pipelines.config.hardened_methods import SoftConfig
from pipelines.config.method import MethodConfig
from pipelines.config.methods import EXTRA_STAGES, METHODS, DistilledConfig, DistilledExpertsConfig
from pipelines.config.model import ImportedModel
from pipelines.config.setting import (
    DERIVED,
    EXECUTION,
    Count,
    Folder,
    FreeText,
    OneOf,
    OnlyWhere,
    Range,
    Seed,
    check_settings,
    keyed_settings,
)
from pipelines.config.stages import (
    ActorConfig,
    CertificationConfig,
    EvaluateConfig,
    MapConfig,
    PolishingConfig,
    PruneConfig,
    SimplificationConfig,
    TrainConfig,
)
from pipelines.config.trainer import SHRINK, FleetConfig, TrainerConfig
from pipelines.engine.digests import differences_suffix
from pipelines.engine.seeding import FIRST_STREAM_SEED
from pipelines.errors import ConfigError

OracleWidth = Annotated[int, Range(1, remedy="give the hidden layers of the network to imitate, as oracle=[256,256]")]


@dataclass(frozen=True)
class RunConfig:
    """One run."""

    env: EnvConfig
    algo: Annotated[AlgoConfig, OnlyWhere("is_trained")]
    method: MethodConfig
    budget: BudgetConfig
    train: Annotated[TrainConfig, OnlyWhere("is_trained")]
    prune: PruneConfig
    evaluate: EvaluateConfig
    results_dir: Folder
    # Hidden neurons of the actor, or a list of them, one a hidden layer; tests on the longest path of a grown tree
    depth: Any = 6
    seed: Seed = 0
    actor: Annotated[ActorConfig, OnlyWhere("is_trained")] = field(default_factory=ActorConfig)
    map: Annotated[MapConfig, OnlyWhere("is_mapped")] = field(default_factory=MapConfig)
    trainer: TrainerConfig = field(default_factory=lambda: TrainerConfig("sb3"))
    stages: Annotated[list[FreeText] | None, EXECUTION] = None  # the stages to do; None for all
    n_workers: Annotated[Count | None, EXECUTION] = None
    side_by_side: Annotated[bool, EXECUTION] = False  # whether other jobs share the terminal
    debug: Annotated[bool, EXECUTION] = False
    polish: Annotated[bool, EXECUTION] = False  # whether to do a further stage, direct search on the return
    certify: Annotated[bool, EXECUTION] = False  # whether to do a further stage, the minimal tree and its certificate
    simplify: Annotated[bool, EXECUTION] = False  # whether to do a further stage, a shorter program
    leaves: Annotated[bool, EXECUTION] = False  # whether to do a further stage, the return against the leaves kept
    video: Annotated[bool, EXECUTION] = False  # whether to do a further stage, an episode as a GIF
    tracking: Annotated[str, OneOf("none", "tensorboard"), EXECUTION] = "none"  # where the run is logged, too
    # Hidden widths of the network that is imitated, trained or imported
    oracle: Annotated[list[OracleWidth], OnlyWhere("imitates")] = field(default_factory=lambda: [256, 256])
    imitate: Annotated[DaggerSettings, OnlyWhere("imitates")] = field(default_factory=DaggerSettings)
    polishing: PolishingConfig = field(default_factory=PolishingConfig)
    certification: CertificationConfig = field(default_factory=CertificationConfig)
    simplification: SimplificationConfig = field(default_factory=SimplificationConfig)
    # The text of method=program, which the command line reads: the run is keyed by it, whatever file it came from
    program_text: Annotated[FreeText | None, DERIVED] = field(default=None, metadata={"omegaconf_ignore": True})
    # The policy of `method.model`, which the command line reads: the run is keyed by its file's digest
    imported: Annotated[ImportedModel | None, DERIVED] = field(default=None, metadata={"omegaconf_ignore": True})
    # The run's folder below `results_dir`, which the command line works out from all other settings
    folder: Annotated[FreeText, DERIVED] = field(default="", metadata={"omegaconf_ignore": True})
    # What differs from the usual run of its environment, method, depth, budget and seed, as overrides
    changes: Annotated[FreeText, DERIVED] = field(default="", metadata={"omegaconf_ignore": True})
    # The run that trains the oracle, for a method that imitates one; worked out there, too
    oracle_run: "Annotated[RunConfig | None, DERIVED]" = field(default=None, metadata={"omegaconf_ignore": True})

    summary_schema: ClassVar[str] = "otr/summary/1"

    def __post_init__(self) -> None:
        if self.method.pid_terms:  # in one place, so that every stage sees the same environment
            object.__setattr__(self, "env", dataclasses.replace(self.env, pid=self.method.pid_terms))
        _check_depth(self.depth)
        check_settings(self)
        self._check_stages()
        first, n = self.evaluate.first_seed, self.evaluate.n_episodes
        if first + n > FIRST_STREAM_SEED:
            raise ConfigError(
                f"evaluate.first_seed={first} with evaluate.n_episodes={n}: the last episode has seed {first + n - 1}, "
                f"and policies are selected on episodes from {FIRST_STREAM_SEED} on; give less"
            )
        self.method.check_depth(self.depth)
        self.method.check(self.algo, self.actor, self.oracle)
        if self.method.is_trained and not getattr(self.method, "model", ""):
            key = "oracle" if self.method.imitates else "depth"
            self.algo.check(key, getattr(self, key), self.actor)
            if self.actor.dense != "none" and self.trainer_name == "sb3":
                raise ConfigError(
                    f"actor.dense={self.actor.dense}: trainer=sb3 trains layered actors; use algo=ars, or algo=sac "
                    "with trainer=fleet"
                )
        if self.trainer.name == SHRINK and not isinstance(self.method, DistilledConfig | DistilledExpertsConfig):
            raise ConfigError(
                f"trainer=shrink makes a small policy out of a large one, which method={self.method.name} does not; "
                "use method=distilled_otr or method=distilled_experts"
            )
        if self.is_trained and isinstance(self.algo, SacConfig):
            self.trainer.check(self.algo)
        if self.method.fleet_only and not self.fleet:
            raise ConfigError(
                f"method={self.method.name} is trained by trainer=fleet, not trainer={self.trainer.name}; "
                "leave trainer out"
            )
        self._check_noise()

    def _check_noise(self) -> None:
        """Refuse exploration after which an actor cannot be read."""
        if isinstance(self.algo, PpoConfig) and self.algo.use_sde and not isinstance(self.method, SoftConfig):
            soft = ", ".join(name for name, method in METHODS.items() if issubclass(method, SoftConfig))
            raise ConfigError(
                f"algo.use_sde=true: actors of method={self.method.name} cannot be read after it; "
                f"leave it out, or use {soft}"
            )

    def _check_stages(self) -> None:
        """Refuse stages that the method does not have, and none at all."""
        if self.stages == []:
            raise ConfigError("stages=[] does nothing; name stages, as stages=[map,prune], or leave it out for all")
        name, is_mapped = self.method.name, self.method.is_mapped
        known = (*self.method.stages, *(extra for extra in EXTRA_STAGES if extra != "certify" or is_mapped))
        for stage in self.stages or ():
            if stage not in known:
                raise ConfigError(f"stages: method={name} has no stage {stage!r}; it has {', '.join(known)}")
        if self.certify and not is_mapped:
            raise ConfigError(
                f"certify=true: a tree of method={name} stands for no network that it could be proved equal to; these "
                f"do: {', '.join(name for name, method in METHODS.items() if method.is_mapped)}"
            )
        self._check_polishing()

    def _check_polishing(self) -> None:
        """Refuse settings of polishing that do not go together, or not with the method."""
        polishing = self.polishing
        is_read = bool(getattr(self.method, "model", "")) and self.imported is None  # not yet
        is_known = not is_read and (self.oracle_run is not None or not self.method.imitates)
        if polishing.by == "critic" and self.is_polished and is_known and not self.has_critics:
            raise ConfigError(
                "polishing.by=critic needs the critics of the actor that the policy is made from: trainer=fleet with "
                "algo=sac keeps them, and zips of Stable-Baselines3's SAC, TD3 and DDPG have some; use one of these, "
                "or polishing.by=search"
            )
        if polishing.numbers == "network" and not self.method.is_mapped:
            raise ConfigError(
                f"polishing.numbers=network: a tree of method={self.method.name} stands for no network; leave it out"
            )
        if self.is_polished and "certify" in self.selected_stages and not self.polishes_network:
            raise ConfigError(
                "polishing.numbers=tree with certify=true: a tree with other numbers stands for no network that it "
                "could be proved equal to; leave one of them out"
            )

    @property
    def is_polished(self) -> bool:
        """Whether the stages after a polish are of the polished policy."""
        return self.polish or "polish" in self.selected_stages

    @property
    def has_oracle(self) -> bool:
        """Whether it is known which run trains or imports the oracle."""
        return self.oracle_run is not None

    @property
    def has_critics(self) -> bool:
        """Whether the oracle, or without one the actor, is trained or imported with critics that are kept."""
        made_by = self.oracle_run or self
        return made_by.fleet is not None if made_by.imported is None else made_by.imported.critics is not None

    @property
    def actor_folder(self) -> str:
        """The folder, below `results_dir`, of the stage that trains or imports the oracle, or without one the actor."""
        made_by = self.oracle_run or self
        return f"{made_by.folder}/{made_by.method.actor_stage}"

    @property
    def polishes_network(self) -> bool:
        """Whether a polish searches the numbers of the network that the tree is mapped from, not the tree's."""
        return self.method.is_mapped and self.polishing.numbers != "tree"

    @property
    def hidden_widths(self) -> tuple[int, ...]:
        """Widths of the actor's hidden layers; empty for depth 0, the linear policy."""
        return widths_of(self.depth)

    @property
    def is_trained(self) -> bool:
        """Whether something is trained for this run, its own actor or the oracle."""
        return self.method.is_trained and self.imported is None

    @property
    def fleet(self) -> FleetConfig | None:
        """The fleet's settings where a fleet trains this run; None where Stable-Baselines3 does."""
        trains_sac = isinstance(self.algo, SacConfig) and self.is_trained
        return self.trainer if isinstance(self.trainer, FleetConfig) and trains_sac else None

    @property
    def trainer_name(self) -> str:
        """Who trains this run: `sb3`, the fleet's name, `ars`, or `none` for a program and an imported model."""
        if not self.is_trained:
            return "none"
        if isinstance(self.algo, ArsConfig):
            return self.algo.name
        return self.fleet.name if self.fleet else "sb3"

    @property
    def budget_level(self) -> str:
        """The budget's name in the run's folder, with the trainer where that is not Stable-Baselines3's gradients."""
        who = self.trainer_name
        return self.budget.name if who in ("sb3", "none") else f"{self.budget.name}-{who}"

    @property
    def selected_stages(self) -> tuple[str, ...]:
        """The stages to do, in the method's order."""
        stages = self.method.stages
        if self.stages is not None:
            return tuple(stage for stage in (*stages, *EXTRA_STAGES) if stage in self.stages)
        return (*stages, *(stage for stage in EXTRA_STAGES if getattr(self, stage)))

    def settings(self) -> dict[str, Any]:
        """Return the resolved settings that decide what comes out, as plain JSON-able data.

        The budget's table of steps is left out but for its name: `train`, `prune` and `evaluate` hold what it gave.
        """
        plain = keyed_settings(self, self.method)
        plain |= {"budget": self.budget.name, "depth": list(self.hidden_widths)}
        if self.program_text is not None:
            plain["program_sha256"] = hashlib.sha256(self.program_text.encode()).hexdigest()
        if self.imported is not None:
            plain["model_sha256"] = self.imported.sha256
        if not self.fleet:
            del plain["trainer"]
        return plain


def run_folder(config: RunConfig, differences: Mapping[str, list[Any]]) -> str:
    """Return the run's folder below `results_dir`: `runs/<env>/<method>/depth-<d>/<budget>/seed-<s>[~<digest>]`.

    `differences` are {setting: [value, usual one]} of what a command sets that no other part of the name says.
    """
    depth = "-".join(str(width) for width in config.hidden_widths) or "0"
    place = f"{config.env.name}/{config.method.name}/depth-{depth}/{config.budget_level}"
    return f"runs/{place}/seed-{config.seed}{differences_suffix(differences)}"


def changes_text(config: RunConfig, differences: Mapping[str, list[Any]]) -> str:
    """Return the differences as overrides: `method.leaves=constant, oracle=[32]`; mostly nothing."""
    shown = {key: _not_keyed(config, key) if new is None else new for key, (new, _) in differences.items()}
    return ", ".join(f"{key}={_as_override(value)}" for key, value in shown.items())


def _not_keyed(config: RunConfig, key: str) -> Any:
    """Return the value of a setting that keys leave out where it is as before (actor.dense=none), or None."""
    value: Any = config
    for name in key.split("."):
        value = getattr(value, name, None)
    return value


def _as_override(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _check_depth(depth: Any) -> None:
    """Refuse what is no number of neurons, nor a list of them."""
    widths = [depth] if isinstance(depth, int) else depth
    integers = isinstance(widths, list) and widths and all(type(width) is int for width in widths)
    if not integers or isinstance(depth, bool):
        raise ConfigError(f"depth={depth!r}: give a number of hidden neurons (depth=6) or one per layer (depth=[8,8])")
    if any(width < 0 for width in widths) or (len(widths) > 1 and 0 in widths):
        raise ConfigError(f"depth={depth!r}: give 0, the linear policy, or numbers of at least 1")
