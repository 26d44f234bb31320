"""The settings of every method, and of those that grow a tree."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from pipelines.config.algo import AlgoConfig
from pipelines.config.env import PidTerms
from pipelines.config.setting import FreeText
from pipelines.config.stages import ActorConfig
from pipelines.errors import ConfigError


@dataclass(frozen=True)
class MethodConfig:
    """What every method has. The class attributes are facts of the method, not settings."""

    name: FreeText  # the name of the method

    label: ClassVar[str]  # what tables call it
    # Further forms of its policy that are evaluated in addition to the tree, each with what tables call it
    forms: ClassVar[Mapping[str, str]] = {}
    stages: ClassVar[tuple[str, ...]]  # its stages in order, without the extra ones
    tree_stage: ClassVar[str]  # the stage that makes its tree
    actor_stage: ClassVar[str] = "train"  # the stage that makes its actor, where there is one
    is_mapped: ClassVar[bool] = False  # whether the tree is a trained network's, which it can be proved equal to
    imitates: ClassVar[bool] = False  # whether the tree imitates an oracle, which is trained first
    # Whether something is trained; not where the policy is a handwritten program, or an imported model
    is_trained: ClassVar[bool] = True
    decides_training: ClassVar[bool] = False  # whether the settings of the method decide what is trained
    fleet_only: ClassVar[bool] = False  # whether its actors are trained by trainer=fleet alone
    continuous_only: ClassVar[bool] = False  # whether its actions are real numbers, never labels
    ties_repeats: ClassVar[bool] = False  # whether tests and leaves that its tree repeats stay alike in a polish

    @property
    def pid_terms(self) -> PidTerms | None:
        """What a PID policy observes in place of the state; None for all other methods."""
        return None

    def check_depth(self, depth: Any) -> None:
        """Raise ConfigError if the method makes no tree of this depth."""

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle_widths: Sequence[int]) -> None:
        """Raise ConfigError if the method cannot be used with this algorithm, this actor or this oracle."""


@dataclass(frozen=True)
class GrownConfig(MethodConfig):
    """A method that grows a tree, whose `depth` is the number of tests on the longest path."""

    def check_depth(self, depth: Any) -> None:
        """Refuse all but a number of tests."""
        if not isinstance(depth, int) or depth == 0:
            raise ConfigError(
                f"depth={depth!r}: method={self.name} grows a tree; give the tests on its longest path (depth=6)"
            )
