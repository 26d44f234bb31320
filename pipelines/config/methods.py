"""The methods, a class each: its settings (a file of conf/method) and everything else that follows from the choice.

The tree of a run is made by one stage: `map` from the actor, trained or imported, `imitate` from an oracle, `harden`
from a soft tree, `parse` from a program. What comes after that stage is the same for all methods.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from pipelines.config.algo import AlgoConfig, DdpgConfig, OnPolicyConfig, PpoConfig, SacConfig
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import PidTerms
from pipelines.config.setting import DERIVED, AsBefore, Count, FreeText, NotNegative, OneOf, Positive, Range, Share
from pipelines.config.stages import ActorConfig
from pipelines.errors import ConfigError

# After all others, where polish=true, certify=true and so on ask for them
EXTRA_STAGES = ("polish", "certify", "simplify", "leaves", "video", "mp4")
# Soft trees learn with other numbers of steps (conf/budget).
ON_POLICY_STEPS = [
    'train.steps="${budget.on_policy_steps.${env.task}}"',
    'train.eval_interval_steps="${budget.on_policy_interval_steps}"',
]
# So does direct search, whose actors have a linear map beside their neurons.
SEARCH_STEPS = [
    *(f'train.{name}="${{budget.search.${{env.task}}.{name}}}"'
      for name in ("steps", "eval_interval_steps", "n_selection_episodes")),
    "actor.dense=input",
    "actor.rescale_inputs=false",  # states are normalised by what is visited
]  # fmt: skip
Leaves = Annotated[str, OneOf("constant", "linear")]
Criterion = Annotated[str, OneOf("gini", "entropy")]
Hardness = Annotated[float, Range(1e-6, 1e6)]


@dataclass(frozen=True)
class MethodConfig:
    """What every method has. The attributes of the class are facts of the method, not settings."""

    name: FreeText  # the name of the method

    label: ClassVar[str]  # what tables call it
    # Further forms of its policy that are evaluated beside the tree, each with what tables call it
    forms: ClassVar[Mapping[str, str]] = {}
    stages: ClassVar[tuple[str, ...]]  # its stages in order, without the extra ones
    tree_stage: ClassVar[str]  # the stage that makes its tree
    actor_stage: ClassVar[str] = "train"  # the stage that makes its actor, where there is one
    is_mapped: ClassVar[bool] = False  # whether the tree is a trained network's, which it can be proved equal to
    imitates: ClassVar[bool] = False  # whether the tree imitates an oracle, which is trained first
    # Whether something is trained; not where the policy is a program that somebody wrote, or a model from elsewhere
    is_trained: ClassVar[bool] = True
    decides_training: ClassVar[bool] = False  # whether the settings of the method decide what is trained

    @classmethod
    def implied(cls, given: Mapping[str, str]) -> list[str]:
        """Return the overrides that the choice of this method implies; they stand before those that are given."""
        return list(SEARCH_STEPS) if given.get("algo", "").startswith("ars") else []

    @property
    def pid_terms(self) -> PidTerms | None:
        """What a PID policy observes in place of the state; None for all other methods."""
        return None

    def check_depth(self, depth: Any) -> None:
        """Raise ConfigError if the method makes no tree of this depth."""

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle: Sequence[int]) -> None:
        """Raise ConfigError if the method cannot be used with this algorithm, this actor or this oracle."""
        if isinstance(algo, PpoConfig) and algo.use_sde:
            soft = ", ".join(name for name, method in METHODS.items() if issubclass(method, SoftConfig))
            raise ConfigError(
                f"algo.use_sde=true: actors of method={self.name} cannot be read after it; leave it out, or use {soft}"
            )


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
    # The file of the VecNormalize that it was trained under, or "none"; looked for beside the model where not given
    vec_normalize: Annotated[FreeText | None, DERIVED] = field(default=None, kw_only=True)
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

    @classmethod
    def implied(cls, given: Mapping[str, str]) -> list[str]:
        """Return the depth of 0."""
        return [*super().implied(given), "depth=0"]

    def check_depth(self, depth: Any) -> None:
        """Refuse hidden neurons."""
        if depth != 0:
            raise ConfigError(f"method=linear is the policy of depth 0, but depth={depth!r}; leave depth out")


@dataclass(frozen=True)
class PidConfig(MappedConfig):
    """A PID policy, whose actor gives the gains (Orfanos 2023, section 4.1.1)."""

    goal: Annotated[list[float], Range()]  # the state to come to rest in, one number a component
    n_history: Count  # states before the present one that the policy knows
    l1: NotNegative  # weight of the sum of the gains' absolute output weights in the actor's loss
    # Scale of the first hidden layer's initial weights and biases, in units of torch's own. The penalty is on the
    # output weights alone, so gains vary more cheaply behind large first-layer weights.
    first_layer_scale: Positive
    # Output weights smaller than this are set to zero before every evaluation: the penalty, taken in steps of the
    # learning rate's size, leaves them swinging about it
    zero_below: NotNegative

    label = "PID"
    forms: ClassVar[Mapping[str, str]] = {"constant_gains": "constant gains"}
    decides_training = True

    @classmethod
    def implied(cls, given: Mapping[str, str]) -> list[str]:
        """Return the depth of 1 with which the thesis trains PID policies, their budget, and algo=ddpg_pid."""
        budget = [
            f'train.{name}="${{budget.pid.{name}}}"'
            for name in ("steps", "eval_interval_steps", "n_selection_episodes")
        ]
        algo = [] if "algo" in given else ["algo=ddpg_pid"]
        evaluation = 'evaluate.n_episodes="${budget.pid.n_evaluation_episodes}"'
        # Their environment is gymnasium's, which is slower than the pendulum's own in numpy.
        polishing = [
            'polishing.steps="${budget.pid.polish_steps}"',
            "polishing.n_episodes=4",
            "polishing.n_selection_episodes=100",
        ]
        units = "actor.rescale_inputs=false"  # states and errors are read in their own
        return [*super().implied(given), "depth=1", units, evaluation, *budget, *polishing, *algo]

    @property
    def pid_terms(self) -> PidTerms:
        """The goal and the length of the integral's window."""
        return PidTerms(tuple(self.goal), self.n_history)

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle: Sequence[int]) -> None:
        """Refuse other algorithms than DDPG, and rescaled inputs."""
        if not isinstance(algo, DdpgConfig):
            raise ConfigError(f"method=pid is trained by algo=ddpg_pid, not {algo.name}")
        if actor.rescale_inputs:
            raise ConfigError("actor.rescale_inputs=true: method=pid reads the state and its errors in their own units")


@dataclass(frozen=True)
class GrownConfig(MethodConfig):
    """A method that grows a tree, whose `depth` is the number of tests on the longest path."""

    def check_depth(self, depth: Any) -> None:
        """Refuse all but a number of tests."""
        if not isinstance(depth, int) or depth == 0:
            raise ConfigError(
                f"depth={depth!r}: method={self.name} grows a tree; give the tests on its longest path (depth=6)"
            )


@dataclass(frozen=True)
class ImitatingConfig(TakesModel, MethodConfig):
    """A method that imitates an oracle under DAgger: a network that is trained first, or a model from a file."""

    imitates = True
    fit_s: ClassVar[float]  # seconds of one fit at depth 6, measured on the lander

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle: Sequence[int]) -> None:
        """Refuse an oracle that is no network."""
        super().check(algo, actor, oracle)
        if not oracle:
            raise ConfigError(f"oracle={oracle}: give the hidden layers of the network to imitate, as oracle=[256,256]")


@dataclass(frozen=True)
class DistilledConfig(ImitatingConfig, MappedConfig):
    """OTR whose network is fitted to an oracle; the names are those of `otr.control.StudentFit`."""

    dense: Annotated[str, OneOf("none", "input")]
    negative_slope: Annotated[float, Range(0, 1, open=True)]
    max_samples: Count
    n_starts: Count
    n_updates: Count
    ridge: NotNegative

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
class ViperConfig(ImitatingTreeConfig):
    """VIPER: CART on rows drawn by the oracle's weights; the names are those of `otr.control.CartFit`."""

    max_samples: Count
    min_samples_leaf: Count
    criterion: Annotated[Criterion, AsBefore("gini")] = field(default="gini", kw_only=True)
    weighted: Annotated[bool, AsBefore(True)] = field(default=True, kw_only=True)

    label = "VIPER"
    fit_s = 0.3


@dataclass(frozen=True)
class LmViperConfig(ImitatingTreeConfig):
    """LM-VIPER: a linear model in every leaf; the names are those of `otr.control.LinearModelTreeFit`."""

    max_samples: Count
    min_samples_leaf: Count
    alpha: NotNegative

    label = "LM-VIPER"
    fit_s = 4.0


@dataclass(frozen=True)
class AugTreeConfig(ImitatingTreeConfig):
    """AugTree: tests on the oracle's hidden units; the names are those of `otr.control.AugTreeFit`."""

    features: Annotated[str, OneOf("all", "z", "deep")]
    leaves: Leaves
    max_patterns: Count
    weighted: bool
    criterion: Criterion
    max_samples: Count
    min_samples_leaf: Count

    label = "AugTree"
    fit_s = 0.7

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle: Sequence[int]) -> None:
        """Refuse deep features of an oracle with one layer."""
        super().check(algo, actor, oracle)
        if self.features == "deep" and len(oracle) < 2:
            raise ConfigError(f"method.features=deep reads the oracle's deeper layers, but oracle={oracle} has one")


@dataclass(frozen=True)
class NdpsConfig(ImitatingTreeConfig):
    """NDPS: a soft tree fitted to the oracle, hardened and refitted; names as in `otr.control.NdpsImitator`."""

    max_samples: Count  # rows drawn for a fit
    n_updates: Count  # Adam's updates of the first fit, and of those that go on from the last round's tree
    n_updates_next: Count
    batch_size: Count  # this and what follows: see `otr.control.NdpsSettings`
    learning_rate: Annotated[float, Range(1e-12, 10)]
    beta_first: Hardness
    beta_last: Hardness
    ridge: NotNegative
    leaves: Annotated[Leaves, AsBefore("linear")] = field(default="linear", kw_only=True)

    label = "NDPS"
    fit_s = 0.7


@dataclass(frozen=True)
class SoftConfig(GrownConfig):
    """A method whose actor is a soft tree, trained by policy gradient."""

    beta_first: Hardness  # how hard its tests are at first and at last, growing geometrically
    beta_last: Hardness
    anneal_until: Share  # the fraction of the steps at which beta has reached its last value
    learning_rate_end: Share  # what is left of the algorithm's learning rate at the end, a fraction; it falls linearly

    forms: ClassVar[Mapping[str, str]] = {"soft": "soft", "discretised": "discretised"}
    stages = ("train", "harden", "prune", "evaluate")
    tree_stage = "harden"
    decides_training = True

    @classmethod
    def implied(cls, given: Mapping[str, str]) -> list[str]:
        """Return the steps of soft trees, and the algorithm that the environment has for them, where none is given."""
        if given.get("algo") == "sac":  # whose steps are the budget's own
            return []
        implied = list(ON_POLICY_STEPS)
        if "algo" not in given:
            own = (f"ppo_{given['method']}_{given.get('env', '')}", f"ppo_tree_{given.get('env', '')}")
            files = (name for name in own if (CONF_DIR / "algo" / f"{name}.yaml").is_file())
            implied.append(f"algo={next(files, 'ppo_tree')}")
        return implied

    def tree_options(self, depth: Any) -> dict[str, Any]:
        """Return what the class of the soft tree takes beside the numbers of inputs and outputs."""
        raise NotImplementedError

    def check(self, algo: AlgoConfig, actor: ActorConfig, oracle: Sequence[int]) -> None:
        """Refuse algorithms that train no soft trees."""
        if not isinstance(algo, OnPolicyConfig | SacConfig):
            raise ConfigError(
                f"method={self.name} is trained by algo=ppo_tree, algo=trpo_tree or algo=sac, not {algo.name}"
            )


@dataclass(frozen=True)
class SdtConfig(SoftConfig):
    """A soft decision tree (Silva et al. 2020), with constant or affine leaves."""

    leaves: Leaves

    label = "SDT"

    def tree_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.soft_tree.SoftTree`."""
        return {"depth": depth, "affine_leaves": self.leaves == "linear"}


@dataclass(frozen=True)
class CdtConfig(SoftConfig):
    """A cascading decision tree (Ding et al. 2020) with `n_features` features between its two trees."""

    n_features: Annotated[int, Range(1, 1024)]

    label = "CDT"

    def tree_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.cdt.CascadingTree`."""
        return {"feature_depth": depth[0], "n_features": self.n_features, "decision_depth": depth[1]}

    def check_depth(self, depth: Any) -> None:
        """Refuse all but two depths."""
        if not (isinstance(depth, list) and len(depth) == 2):
            raise ConfigError(f"depth={depth!r}: method=cdt has two trees; give both depths, as depth=[3,3]")


@dataclass(frozen=True)
class PiPrlConfig(SoftConfig):
    """pi-PRL (Qiu & Zhu 2022): `discretise_at` is the fraction of the steps at which the structure is chosen."""

    structure_penalty: Annotated[float, Range(0, 100)]
    discretise_at: Share

    label = "π-PRL"
    forms: ClassVar[Mapping[str, str]] = {"soft": "relaxed"}

    def tree_options(self, depth: Any) -> dict[str, Any]:
        """Return the options of `otr.control.pi_prl.RelaxedProgram`."""
        return {"depth": depth, "structure_penalty": self.structure_penalty}


@dataclass(frozen=True)
class ProgramConfig(MethodConfig):
    """A program that somebody wrote: `program` is a file, or a name under conf/program."""

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
    "sdt": SdtConfig,
    "cdt": CdtConfig,
    "pi_prl": PiPrlConfig,
    "program": ProgramConfig,
    "model": ModelConfig,
}
