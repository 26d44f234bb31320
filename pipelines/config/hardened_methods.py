"""Methods whose actor is a module of torch that hardens into a tree: soft trees, and experts behind a hard router."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from otr.control.settings import ExpertsSettings, RelaxedProgramSettings
from otr.setting import Hardness, Leaves
from pipelines.config.algo import AlgoConfig, PpoConfig, SacConfig
from pipelines.config.method import GrownConfig
from pipelines.config.setting import NotNegative, Range, Share
from pipelines.config.stages import ActorConfig
from pipelines.errors import ConfigError

EXPERTS = (2, 16)  # at least and at most; their tree has up to 2**15 leaves


def check_n_experts(method: str, depth: Any) -> None:
    """Raise ConfigError for a depth that is no number of experts."""
    least, most = EXPERTS
    if not (isinstance(depth, int) and least <= depth <= most):
        raise ConfigError(
            f"depth={depth!r}: of method={method} it is the number of experts; give {least} to {most} (depth=8)"
        )


@dataclass(frozen=True)
class HardenedConfig(GrownConfig):
    """A method whose actor is a module that hardens into a tree."""

    stages = ("train", "harden", "prune", "evaluate")
    tree_stage = "harden"
    decides_training = True

    def module_options(self, depth: Any) -> dict[str, Any]:
        """Return what the class of the module takes in addition to the numbers of inputs and outputs."""
        raise NotImplementedError


@dataclass(frozen=True)
class SoftConfig(HardenedConfig):
    """A method whose actor is a soft tree, trained by policy gradient."""

    beta_first: Hardness = 1.0  # how hard its tests are at first and in the end, growing geometrically
    beta_last: Hardness = 50.0
    anneal_until: Share = 0.8  # the fraction of the steps at which beta has reached its last value
    learning_rate_end: Share = 0.05  # what is left of the algorithm's learning rate at the end; it falls linearly

    forms: ClassVar[Mapping[str, str]] = {"soft": "soft", "discretised": "discretised"}

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle_widths: Sequence[int]) -> None:
        """Refuse algorithms that train no soft trees."""
        if not isinstance(algo, PpoConfig | SacConfig):
            raise ConfigError(f"method={self.name} is trained by algo=ppo_tree or algo=sac, not {algo.name}")


@dataclass(frozen=True)
class SdtConfig(SoftConfig):
    """A soft decision tree (Silva et al. 2020), with constant or affine leaves."""

    leaves: Leaves = "constant"

    label = "SDT"

    def module_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.soft_trees.soft_tree.SoftTree`."""
        return {"depth": depth, "affine_leaves": self.leaves == "linear"}


@dataclass(frozen=True)
class CdtConfig(SoftConfig):
    """A cascading decision tree (Ding et al. 2020) with `n_features` features between its two trees."""

    beta_last: Hardness = 30.0
    n_features: Annotated[int, Range(1, 1024)] = 8

    label = "CDT"

    def module_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.soft_trees.cascading_tree.CascadingTree`."""
        return {"feature_depth": depth[0], "n_features": self.n_features, "decision_depth": depth[1]}

    def check_depth(self, depth: Any) -> None:
        """Refuse all but two depths."""
        if not (isinstance(depth, list) and len(depth) == 2):
            raise ConfigError(f"depth={depth!r}: method=cdt has two trees; give both depths, as depth=[3,3]")


@dataclass(frozen=True)
class PiPrlConfig(RelaxedProgramSettings, SoftConfig):
    """pi-PRL (Qiu & Zhu 2022): `discretise_at` is the fraction of the steps at which the structure is chosen."""

    discretise_at: Share = 0.2

    label = "π-PRL"
    forms: ClassVar[Mapping[str, str]] = {"soft": "relaxed"}

    def module_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.soft_trees.relaxed_program.RelaxedProgram`."""
        return {"depth": depth, "structure_penalty": self.structure_penalty}


@dataclass(frozen=True)
class ExpertsConfig(HardenedConfig):
    """Linear experts, `depth` of them, of which a hard linear router lets one act (SMoSE, AAAI 2025)."""

    # Weight of `otr.control.LinearExperts.balance`, how unevenly they are used, in the actor's loss
    balance: NotNegative = ExpertsSettings.balance

    label = "Experts"
    fleet_only = True
    continuous_only = True
    ties_repeats = True

    def module_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.LinearExperts`."""
        return {"n_experts": depth}

    def check_depth(self, depth: Any) -> None:
        """Refuse all but a number of experts."""
        check_n_experts(self.name, depth)

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle_widths: Sequence[int]) -> None:
        """Refuse algorithms that train no experts."""
        if not isinstance(algo, SacConfig):
            raise ConfigError(f"method=experts is trained by algo=sac, not {algo.name}; leave algo out")
