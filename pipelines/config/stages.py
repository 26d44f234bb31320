"""The actor, and the settings of the stages of a run that are not the method's."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from otr.control.settings import CriticPolishSettings, PolishSettings
from otr.setting import BelowOne, CountOrZero
from pipelines.config.setting import (
    AsBefore,
    Count,
    NotNegative,
    OneOf,
    Seed,
    Text,
    keyed_settings,
)


@dataclass(frozen=True)
class ActorConfig:
    """The actor, apart from its widths (`depth`)."""

    negative_slope: BelowOne = 0.0  # 0 is ReLU, above 0 leaky ReLU
    # Train on states rescaled from the environment's box to [-1, 1]; the rescaling is affine and is folded into the
    # first layer afterwards, so the program reads the environment's own states
    rescale_inputs: Annotated[bool, AsBefore(False)] = False
    # "input": a linear map of the state next to the neurons (dense links, Orfanos 2023, Corollary 1); "none" is without
    dense: Annotated[str, OneOf("none", "input"), AsBefore("none")] = "none"

    @property
    def links(self) -> Literal["input", False]:
        """The dense links as networks have them."""
        return "input" if self.dense == "input" else False


@dataclass(frozen=True)
class TrainConfig:
    """Training: environment steps in all, steps between evaluations, episodes per evaluation."""

    steps: Count
    eval_interval_steps: Count
    n_selection_episodes: Count
    max_learning_starts: CountOrZero


@dataclass(frozen=True)
class MapConfig:
    """Mapping: up to `max_leaves` the tree is written out, beyond it is held as activation patterns."""

    max_leaves: Count = 1024


@dataclass(frozen=True)
class PruneConfig:
    """Pruning: the paths reached in `n_episodes` are kept; with `k` only the k most frequent of them."""

    n_episodes: Count
    k: Count | None = None


@dataclass(frozen=True)
class PolishingConfig(PolishSettings):
    """Polishing: the finished policy's numbers improved on its return, by direct search (`otr.polish`) or critics."""

    # Null is by the critics where the method imitates an oracle that has some, else by search
    by: Annotated[str | None, OneOf("search", "critic"), AsBefore(None)] = None
    critic: CriticPolishSettings = field(default_factory=CriticPolishSettings)
    # Environment steps of the search, about: as many iterations as they pay for at the length that episodes have before
    steps: Count = 1_000_000
    # Whose numbers: the network's, where a tree is mapped from one (it is then mapped and pruned again), or the pruned
    # tree's. None is the network's where there is one
    numbers: Annotated[str | None, OneOf("network", "tree")] = None
    # Who computes the environments; None is numpy where that was compared with gymnasium, else gymnasium
    environments: Annotated[str | None, OneOf("gymnasium", "numpy")] = None

    def settings(self) -> dict[str, Any]:
        """Return what decides a polish by search, as committed polishes are keyed by it."""
        return {name: value for name, value in keyed_settings(self).items() if name not in ("by", "critic")}

    def settings_by_critic(self, *, of_network: bool) -> dict[str, Any]:
        """Return what decides a polish by critics; a tree has no neurons."""
        common = ("numbers", "free", "n_selection_episodes", "n_candidates", "environments")
        critic = self.critic if of_network else replace(self.critic, first_neurons=0)
        return {"by": "critic", **{name: getattr(self, name) for name in common}, **keyed_settings(critic)}


_LIMIT = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf)"
SIDE = rf"(\S(?:.*\S)?)\s+in\s+{_LIMIT}\s*\.\.\s*{_LIMIT}"
Side = Annotated[str, Text(SIDE, "give the sides of a box as [angle in -0.2..0.2, velocity in -1..1]")]


@dataclass(frozen=True)
class CertificationConfig:
    """The minimal tree and its certificate: no tree of more leaves, nor one that takes longer to find, is proved."""

    # The states for which it is proved; None is the environment's box or, where that is open, that around those visited
    box: Annotated[list[Side] | None, AsBefore(None)] = None
    max_leaves: Count = 2**13
    max_seconds: NotNegative = 600.0


@dataclass(frozen=True)
class SimplificationConfig:
    """Simplifying: what the program may lose, on episodes that are not reported."""

    n_episodes: Count = 100  # that decide
    return_loss: BelowOne = 0.02  # share of the mean return that may be lost on them
    # Instead of that: no action may change by more, anywhere in the environment's box of states or, where that is
    # open, in the box around those visited
    action_bound: NotNegative | None = None
    refit: bool = True  # whether tests may be refitted by sparse linear discriminant analysis


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluation: episode i starts from `reset(seed=first_seed + i)`, for every method alike."""

    n_episodes: Count
    first_seed: Seed = 1000
