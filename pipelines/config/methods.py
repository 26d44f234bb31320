"""The methods, a class each: its settings (a file of conf/method) and everything else that follows from the choice.

The tree of a run is made by one stage: `map` from the actor, trained or imported, `imitate` from an oracle, `harden`
from a trained soft tree or experts, `parse` from a program. What comes after that stage is the same for all methods.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from otr.control.settings import (
    AugTreeSettings,
    CartSettings,
    ExpertsSettings,
    ModelTreeSettings,
    NdpsSettings,
    StudentSettings,
)
from pipelines.config.algo import AlgoConfig, DdpgConfig
from pipelines.config.env import PidTerms
from pipelines.config.hardened_methods import CdtConfig, ExpertsConfig, PiPrlConfig, SdtConfig, check_n_experts
from pipelines.config.method import GrownConfig, MethodConfig
from pipelines.config.setting import DERIVED, Count, FreeText, NotNegative, Positive, Range
from pipelines.config.stages import ActorConfig
from pipelines.errors import ConfigError

# After all others, where polish=true, certify=true and so on request them
EXTRA_STAGES = ("polish", "certify", "simplify", "leaves", "video")


@dataclass(frozen=True)
class MappedConfig(MethodConfig):
    """OTR, and every method whose tree is mapped from the trained actor."""

    label = "OTR"
    stages: ClassVar[tuple[str, ...]] = ("train", "map", "prune", "evaluate")
    tree_stage = "map"
    is_mapped = True


@dataclass(frozen=True)
class TakesModel:
    """What a method has that takes a policy from a file."""

    model: Annotated[FreeText, DERIVED] = field(default="", kw_only=True)
    # The file of the statistics that its states were normalised by, or "none"; looked for next to a zip where not given
    normalise: Annotated[FreeText | None, DERIVED] = field(default=None, kw_only=True)
    output: Annotated[FreeText | None, DERIVED] = field(default=None, kw_only=True)  # the policy's, of an ONNX model


@dataclass(frozen=True)
class ModelConfig(TakesModel, MappedConfig):
    """A policy that was trained elsewhere, mapped as a trained actor is."""

    label = "model"
    stages = ("import", "map", "prune", "evaluate")
    actor_stage = "import"
    is_trained = False


@dataclass(frozen=True)
class LinearPolicyConfig(MappedConfig):
    """The linear policy: an actor without hidden neurons, a tree of depth 0."""

    label = "Linear"

    def check_depth(self, depth: Any) -> None:
        """Refuse hidden neurons."""
        if depth != 0:
            raise ConfigError(f"method=linear is the policy of depth 0, but depth={depth!r}; leave depth out")


@dataclass(frozen=True)
class PidConfig(MappedConfig):
    """A PID policy, whose actor gives the gains (Orfanos 2023, section 4.1.1)."""

    # The state to come to rest in, one number a component; of the pendulum cosine and sine of the angle, angle rate
    goal: Annotated[list[float], Range()] = field(default_factory=lambda: [1.0, 0.0, 0.0])
    n_history: Count = 5  # states before the present one that the policy knows, over which the integral sums
    # Weight of the sum of the gains' absolute output weights in the actor's loss, so that gains are nearly constant
    l1: NotNegative = 2.5
    # Scale of the first hidden layer's initial weights and biases, in units of torch's own. The penalty is on the
    # output weights alone, so gains vary more cheaply after large first-layer weights.
    first_layer_scale: Positive = 10.0
    # Output weights smaller than this are set to zero before every evaluation: the penalty, taken in steps of the
    # learning rate's size (three of Adam's), leaves them oscillating around it
    zero_below: NotNegative = 0.01

    label = "PID"
    forms: ClassVar[Mapping[str, str]] = {"constant_gains": "constant gains"}
    decides_training = True

    @property
    def pid_terms(self) -> PidTerms:
        """The goal and the length of the integral's window."""
        return PidTerms(tuple(self.goal), self.n_history)

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle_widths: Sequence[int]) -> None:
        """Refuse other algorithms than DDPG, and rescaled inputs."""
        if not isinstance(algo, DdpgConfig):
            raise ConfigError(f"method=pid is trained by algo=ddpg_pid, not {algo.name}")
        if actor.rescale_inputs:
            raise ConfigError("actor.rescale_inputs=true: method=pid reads the state and its errors in their own units")


@dataclass(frozen=True)
class ImitatingConfig(TakesModel, MethodConfig):
    """A method that imitates an oracle under DAgger: a network that is trained first, or a model from a file."""

    imitates = True
    fit_s: ClassVar[float]  # seconds of one fit at depth 6, measured on the lander

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle_widths: Sequence[int]) -> None:
        """Refuse an oracle that is no network."""
        super().check(algo, actor, oracle_widths)
        if not oracle_widths:
            raise ConfigError(
                f"oracle={oracle_widths}: give the hidden layers of the network to imitate, as oracle=[256,256]"
            )


@dataclass(frozen=True)
class DistilledConfig(StudentSettings, ImitatingConfig, MappedConfig):
    """OTR whose network is fitted to an oracle."""

    label = "OTR, distilled"
    stages = ("oracle", "imitate", "map", "prune", "evaluate")
    actor_stage = "imitate"
    fit_s = 3.0


@dataclass(frozen=True)
class ImitatingTreeConfig(ImitatingConfig, GrownConfig):
    """A method whose imitator is a tree from the start."""

    stages = ("oracle", "imitate", "prune", "evaluate")
    tree_stage = "imitate"


@dataclass(frozen=True)
class ViperConfig(CartSettings, ImitatingTreeConfig):
    """VIPER: CART on rows drawn by the oracle's weights."""

    label = "VIPER"
    fit_s = 0.3


@dataclass(frozen=True)
class LmViperConfig(ModelTreeSettings, ImitatingTreeConfig):
    """LM-VIPER: a linear model in every leaf."""

    label = "LM-VIPER"
    fit_s = 4.0


@dataclass(frozen=True)
class AugTreeConfig(AugTreeSettings, ImitatingTreeConfig):
    """AugTree: tests on the oracle's hidden units."""

    label = "AugTree"
    fit_s = 0.7

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle_widths: Sequence[int]) -> None:
        """Refuse deep features of an oracle with one layer."""
        super().check(algo, actor, oracle_widths)
        if self.features == "deep" and len(oracle_widths) < 2:
            raise ConfigError(
                f"method.features=deep reads the oracle's deeper layers, but oracle={oracle_widths} has one"
            )


@dataclass(frozen=True)
class NdpsConfig(NdpsSettings, ImitatingTreeConfig):
    """NDPS: a soft tree fitted to the oracle, hardened and refitted."""

    label = "NDPS"
    fit_s = 0.7


@dataclass(frozen=True)
class DistilledExpertsConfig(ExpertsSettings, ImitatingTreeConfig):
    """Linear experts fitted to an oracle of continuous actions."""

    label = "Experts, distilled"
    continuous_only = True
    ties_repeats = True
    fit_s = 2.0

    def check_depth(self, depth: Any) -> None:
        """Refuse all but a number of experts."""
        check_n_experts(self.name, depth)


@dataclass(frozen=True)
class ProgramConfig(MethodConfig):
    """A handwritten program: `program` is a file, or a name under conf/program."""

    program: Annotated[FreeText, DERIVED]

    label = "program"
    stages = ("parse", "prune", "evaluate")
    tree_stage = "parse"
    is_trained = False


METHODS: dict[str, type[MethodConfig]] = {
    "otr": MappedConfig,
    "linear": LinearPolicyConfig,
    "pid": PidConfig,
    "viper": ViperConfig,
    "lm_viper": LmViperConfig,
    "augtree": AugTreeConfig,
    "ndps": NdpsConfig,
    "distilled_otr": DistilledConfig,
    "distilled_experts": DistilledExpertsConfig,
    "sdt": SdtConfig,
    "cdt": CdtConfig,
    "pi_prl": PiPrlConfig,
    "experts": ExpertsConfig,
    "program": ProgramConfig,
    "model": ModelConfig,
}
