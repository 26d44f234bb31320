"""What a run is asked to do: frozen dataclasses, validated once, with the folder and the digest that name the run.

Hydra composes these from `conf/` (see `pipelines/cli.py`); nothing here knows Hydra.
"""

import dataclasses
import math
import re
from dataclasses import dataclass, field
from typing import Any

from pipelines.errors import ConfigError
from pipelines.methods import EXTRAS, METHODS, imitates, is_mapped, is_soft, is_written

LARGEST_SEED = 2**32 - 1


@dataclass(frozen=True)
class PidTerms:
    """How a PID policy observes an environment: [s, P, I, D] in place of the state s (`otr.control.pid_observation`).

    Attributes:
        goal: e, one number a component of the state.
        n_history: states before s that I sums over.
    """

    goal: tuple[float, ...]
    n_history: int


@dataclass(frozen=True)
class EnvConfig:
    """One environment: its gymnasium id and the names that programs print.

    `pid` is there where the method is a PID policy, which says so to whoever makes the environment.
    """

    name: str
    task: str  # the row of the tables and of conf/budget; hopper_v5 has task hopper
    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    feature_names: list[str] = field(default_factory=list)
    action_names: list[str] = field(default_factory=list)
    pid: PidTerms | None = field(default=None, metadata={"omegaconf_ignore": True})


@dataclass(frozen=True)
class AlgoConfig:
    """What every algorithm has."""

    name: str
    learning_rate: float


@dataclass(frozen=True)
class ArsConfig(AlgoConfig):
    """Augmented random search of a linear policy (Mania et al. 2018), under sb3-contrib's names.

    Attributes:
        n_delta: directions tried an update, each forth and back: 2 n_delta episodes.
        n_top: the best of them, which make the step.
        delta_std: length of the directions.
        with_bias: whether the policy has offsets; the original has none and normalises states instead.
    """

    n_delta: int
    n_top: int
    delta_std: float
    with_bias: bool


@dataclass(frozen=True)
class GradientConfig(AlgoConfig):
    """What algorithms with critics have: the widths of their hidden layers in `critic`; `weight_decay` is Adam's."""

    batch_size: int
    gamma: float
    critic: list[int]
    weight_decay: float


@dataclass(frozen=True)
class OnPolicyConfig(GradientConfig):
    """What PPO and TRPO share, under Stable-Baselines3's names."""

    n_envs: int
    n_steps: int
    gae_lambda: float


@dataclass(frozen=True)
class PpoConfig(OnPolicyConfig):
    """Proximal policy optimisation, under Stable-Baselines3's names.

    Attributes:
        use_sde: explore by a linear function of the state that is drawn anew every `sde_sample_freq` steps (-1: every
            rollout), instead of by noise drawn at every step; for continuous actions.
    """

    n_epochs: int
    clip_range: float
    ent_coef: float
    vf_coef: float
    max_grad_norm: float
    use_sde: bool = False
    sde_sample_freq: int = -1


@dataclass(frozen=True)
class TrpoConfig(OnPolicyConfig):
    """Trust region policy optimisation, under sb3-contrib's names."""

    target_kl: float
    cg_max_steps: int
    cg_damping: float
    n_critic_updates: int


@dataclass(frozen=True)
class OffPolicyConfig(GradientConfig):
    """What algorithms with a replay buffer share."""

    buffer_size: int
    learning_starts: int
    tau: float
    train_freq: int
    gradient_steps: int


@dataclass(frozen=True)
class DqnConfig(OffPolicyConfig):
    """Deep Q-learning, for labels: the actor is the network of the action values, so `critic` stays empty.

    Attributes:
        target_update_interval: steps between updates of the target network.
        exploration_fraction: of all steps, over which random actions become rarer.
        exploration_final_eps: their share from then on.
    """

    target_update_interval: int
    exploration_fraction: float
    exploration_final_eps: float
    max_grad_norm: float


@dataclass(frozen=True)
class ContinuousConfig(OffPolicyConfig):
    """What SAC, TD3 and DDPG share. `action_noise` is none, normal or ornstein_uhlenbeck."""

    action_noise: str
    action_noise_std: float
    action_noise_dt: float


@dataclass(frozen=True)
class SacConfig(ContinuousConfig):
    """Soft actor-critic. `ent_coef` is `auto`, or a number as a string for a fixed temperature."""

    ent_coef: str


@dataclass(frozen=True)
class Td3Config(ContinuousConfig):
    """Twin delayed DDPG."""

    policy_delay: int
    target_policy_noise: float
    target_noise_clip: float


@dataclass(frozen=True)
class DdpgConfig(ContinuousConfig):
    """Deep deterministic policy gradient."""


ALGORITHMS: dict[str, type[AlgoConfig]] = {
    "ppo": PpoConfig,
    "trpo": TrpoConfig,
    "sac": SacConfig,
    "td3": Td3Config,
    "ddpg": DdpgConfig,
    "dqn": DqnConfig,
    "ars": ArsConfig,
}


@dataclass(frozen=True)
class ActorConfig:
    """The actor beside its widths (`depth`).

    Attributes:
        negative_slope: 0 is ReLU, above 0 leaky ReLU.
        rescale_inputs: train on states rescaled from the environment's box to [-1, 1]; the rescaling is affine and is
            folded into the first layer afterwards, so the program reads the environment's own states.
    """

    negative_slope: float = 0.0
    rescale_inputs: bool = False


@dataclass(frozen=True)
class BudgetConfig:
    """How much is spent. The rest is the same for all tasks.

    Attributes:
        steps: environment steps per task.
        on_policy_steps: the same for soft trees and augmented random search, whose steps are cheaper and teach less.
        on_policy_interval_steps: between their evaluations. Training goes on with new episodes after each, in several
            environments at once, so there have to be enough steps for whole episodes.
        pid: what is spent on PID policies in place of the above: steps, eval_interval_steps, n_selection_episodes and
            n_evaluation_episodes.
    """

    name: str
    steps: dict[str, int]
    eval_interval_steps: int
    n_selection_episodes: int
    n_prune_episodes: int
    n_evaluation_episodes: int
    max_learning_starts: int
    n_rounds: int = 50
    n_round_episodes: int = 25
    n_choice_episodes: int = 100
    on_policy_steps: dict[str, int] = field(default_factory=dict)
    on_policy_interval_steps: int = 25_000
    pid: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class TrainConfig:
    """Training: environment steps in all, steps between evaluations, episodes per evaluation."""

    steps: int
    eval_interval_steps: int
    n_selection_episodes: int
    max_learning_starts: int


@dataclass(frozen=True)
class ImitateConfig:
    """Imitation under DAgger: the oracle plays first, then the imitator, which is fitted anew after every round.

    Attributes:
        n_initial_episodes: episodes of the oracle.
        n_rounds, n_episodes: rounds, and episodes of the imitator in each.
        n_choice_episodes: episodes on which the last two candidates are compared; none of them is reported.
    """

    n_initial_episodes: int = 25
    n_rounds: int = 50
    n_episodes: int = 25
    n_choice_episodes: int = 100


@dataclass(frozen=True)
class MapConfig:
    """Mapping: up to `max_leaves` the tree is written out, beyond it is held as activation patterns."""

    max_leaves: int


@dataclass(frozen=True)
class PruneConfig:
    """Pruning: the paths reached in `n_episodes` are kept; with `k` only the k most frequent of them."""

    n_episodes: int
    k: int | None


@dataclass(frozen=True)
class CertificationConfig:
    """The minimal tree and its certificate: no tree of more leaves, nor one that takes longer to find, is proved."""

    max_leaves: int = 2**13
    max_seconds: float = 600.0


@dataclass(frozen=True)
class SimplificationConfig:
    """Simplifying: what the program may lose, on episodes that are not reported.

    Attributes:
        n_episodes: that decide.
        return_loss: share of the mean return that may be lost on them.
        action_bound: instead of that: no action may change by more, anywhere in the environment's box of states or,
            where that is open, in the box around those visited.
        refit: whether tests may be refitted by sparse linear discriminant analysis.
    """

    n_episodes: int = 100
    return_loss: float = 0.02
    action_bound: float | None = None
    refit: bool = True


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluation: episode i starts from `reset(seed=first_seed + i)`, for every method alike."""

    n_episodes: int
    first_seed: int


@dataclass(frozen=True)
class MethodConfig:
    """The method's name; its stages are its row in `pipelines/methods.py`."""

    name: str


@dataclass(frozen=True)
class ViperConfig(MethodConfig):
    """VIPER: CART on rows drawn by the oracle's weights; the names are those of `otr.control.CartFit`."""

    max_samples: int
    min_samples_leaf: int


@dataclass(frozen=True)
class LmViperConfig(MethodConfig):
    """LM-VIPER: a linear model in every leaf; the names are those of `otr.control.LinearModelTreeFit`."""

    max_samples: int
    min_samples_leaf: int
    alpha: float


@dataclass(frozen=True)
class AugTreeConfig(MethodConfig):
    """AugTree: tests on the oracle's hidden units; the names are those of `otr.control.AugTreeFit`."""

    features: str
    leaves: str
    max_patterns: int
    weighted: bool
    criterion: str
    max_samples: int
    min_samples_leaf: int


@dataclass(frozen=True)
class NdpsConfig(MethodConfig):
    """NDPS: a soft tree fitted to the oracle, hardened and refitted; the names are those of `otr.control.NdpsImitator`.

    Attributes:
        max_samples: rows drawn for a fit.
        n_updates, n_updates_next: Adam's updates of the first fit, and of those that go on from the last round's tree.
        batch_size, learning_rate, beta_first, beta_last, ridge: see `otr.control.NdpsSettings`.
    """

    max_samples: int
    n_updates: int
    n_updates_next: int
    batch_size: int
    learning_rate: float
    beta_first: float
    beta_last: float
    ridge: float


@dataclass(frozen=True)
class SoftConfig(MethodConfig):
    """A method whose actor is a soft tree, trained by policy gradient.

    Attributes:
        beta_first, beta_last: how hard its tests are at first and at last, growing geometrically.
        anneal_until: the fraction of the steps at which beta has reached its last value.
        learning_rate_end: what is left of the algorithm's learning rate at the end, a fraction; it falls linearly.
    """

    beta_first: float
    beta_last: float
    anneal_until: float
    learning_rate_end: float


@dataclass(frozen=True)
class SdtConfig(SoftConfig):
    """A soft decision tree (Silva et al. 2020), with constant or affine leaves."""

    leaves: str


@dataclass(frozen=True)
class CdtConfig(SoftConfig):
    """A cascading decision tree (Ding et al. 2020) with `n_features` features between its two trees."""

    n_features: int


@dataclass(frozen=True)
class PiPrlConfig(SoftConfig):
    """pi-PRL (Qiu & Zhu 2022): `discretise_at` is the fraction of the steps at which the structure is chosen."""

    structure_penalty: float
    discretise_at: float


@dataclass(frozen=True)
class ProgramConfig(MethodConfig):
    """A program that somebody wrote: `program` is a file, or a name under conf/program."""

    program: str


@dataclass(frozen=True)
class PidConfig(MethodConfig):
    """A PID policy, whose actor gives the gains (Orfanos 2023, section 4.1.1).

    Attributes:
        goal: the state to come to rest in, one number a component.
        n_history: states before the present one that the policy knows.
        l1: weight of the sum of the gains' absolute output weights in the actor's loss.
        first_layer_scale: of the initial weights and biases of the first hidden layer, in units of torch's own. The
            penalty is on the output weights alone, so gains vary more cheaply behind large first-layer weights.
        zero_below: output weights smaller than this are set to zero before every evaluation: the penalty, taken in
            steps of the learning rate's size, leaves them swinging about it.
    """

    goal: list[float]
    n_history: int
    l1: float
    first_layer_scale: float
    zero_below: float


METHOD_CONFIGS: dict[str, type[MethodConfig]] = {
    "otr": MethodConfig,
    "linear": MethodConfig,
    "pid": PidConfig,
    "viper": ViperConfig,
    "lm_viper": LmViperConfig,
    "augtree": AugTreeConfig,
    "ndps": NdpsConfig,
    "sdt": SdtConfig,
    "cdt": CdtConfig,
    "pi_prl": PiPrlConfig,
    "program": ProgramConfig,
}


@dataclass(frozen=True)
class TrainerConfig:
    """Who trains: `sb3`, Stable-Baselines3, one run at a time."""

    name: str


@dataclass(frozen=True)
class FleetConfig(TrainerConfig):
    """Many runs of SAC trained as one (`pipelines/fleet`). Other algorithms are Stable-Baselines3's all the same.

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
        if isinstance(self.method, PidConfig):  # in one place, so that every stage sees the same environment
            terms = PidTerms(tuple(self.method.goal), self.method.n_history)
            object.__setattr__(self, "env", dataclasses.replace(self.env, pid=terms))
        _check_depth(self.depth, self.method.name)
        _check_stages(self.stages, self.method.name)
        _check_method(self)
        _check_numbers(self)

    @property
    def hidden_widths(self) -> tuple[int, ...]:
        """Widths of the actor's hidden layers; empty for depth 0, the linear policy."""
        widths = [self.depth] if isinstance(self.depth, int) else list(self.depth)
        return tuple(width for width in widths if width > 0)

    @property
    def fleet(self) -> FleetConfig | None:
        """The fleet's settings where a fleet trains this run; None where Stable-Baselines3 does."""
        trains_sac = isinstance(self.algo, SacConfig) and not is_written(self.method.name)
        return self.trainer if isinstance(self.trainer, FleetConfig) and trains_sac else None

    @property
    def trainer_name(self) -> str:
        """Who trains this run: `sb3`, the fleet's name, or `none` for a program."""
        if is_written(self.method.name):
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
        stages = METHODS[self.method.name]
        if self.stages is not None:
            return tuple(stage for stage in (*stages, *EXTRAS) if stage in self.stages)
        return (*stages, *(stage for stage in EXTRAS if getattr(self, stage)))


def _check_depth(depth: Any, method: str) -> None:
    widths = [depth] if isinstance(depth, int) else depth
    integers = isinstance(widths, list) and widths and all(type(width) is int for width in widths)
    if not integers or isinstance(depth, bool):
        raise ConfigError(f"depth={depth!r}: give a number of hidden neurons (depth=6) or one per layer (depth=[8,8])")
    if any(width < 0 for width in widths) or (len(widths) > 1 and 0 in widths):
        raise ConfigError(f"depth={depth!r}: a layer cannot have {min(widths)} neurons; depth=0 is the linear policy")
    if method == "linear" and depth != 0:
        raise ConfigError(f"method=linear is the policy of depth 0, but depth={depth!r}; add depth=0")
    if method == "cdt":
        if not (isinstance(depth, list) and len(depth) == 2):
            raise ConfigError(f"depth={depth!r}: method=cdt has two trees; give both depths, as depth=[3,3]")
    elif (imitates(method) or is_soft(method)) and (not isinstance(depth, int) or depth == 0):
        raise ConfigError(
            f"depth={depth!r}: method={method} grows a tree; give the tests on its longest path (depth=6)"
        )


def _check_stages(stages: list[str] | None, method: str) -> None:
    for stage in stages or ():
        known = (*METHODS[method], *(extra for extra in EXTRAS if extra != "certify" or is_mapped(method)))
        if stage not in known:
            raise ConfigError(f"stages: method={method} has no stage {stage!r}; it has {', '.join(known)}")


def _check_method(config: RunConfig) -> None:
    """Refuse an oracle that is no network, and choices that a method does not have."""
    if not 0 <= config.simplification.return_loss < 1:
        raise ConfigError(
            f"simplification.return_loss={config.simplification.return_loss}: give a share from 0 to below 1"
        )
    if config.certify and not is_mapped(config.method.name):
        raise ConfigError(
            f"certify=true: a tree of method={config.method.name} stands for no network that it could be proved equal "
            f"to; these do: {', '.join(method for method in METHODS if is_mapped(method))}"
        )
    if imitates(config.method.name) and (not config.oracle or any(width < 1 for width in config.oracle)):
        raise ConfigError(
            f"oracle={config.oracle}: give the hidden layers of the network to imitate, as oracle=[256,256]"
        )
    if is_soft(config.method.name) and not isinstance(config.algo, OnPolicyConfig):
        raise ConfigError(
            f"method={config.method.name} is trained by algo=ppo_tree or algo=trpo_tree, not {config.algo.name}"
        )
    if isinstance(config.algo, ArsConfig) and config.hidden_widths:
        raise ConfigError(f"algo=ars searches linear policies; depth={config.depth} has hidden neurons, add depth=0")
    if config.method.name == "pid" and not isinstance(config.algo, DdpgConfig):
        raise ConfigError(f"method=pid is trained by algo=ddpg_pid, not {config.algo.name}")
    if config.method.name == "pid" and config.actor.rescale_inputs:
        raise ConfigError("actor.rescale_inputs=true: method=pid reads the state and its errors in their own units")
    for name, choices in METHOD_CHOICES.items():
        value = getattr(config.method, name, None)
        if value is not None and value not in choices:
            raise ConfigError(f"method.{name}={value}: use one of {', '.join(choices)}")
    if getattr(config.method, "features", None) == "deep" and len(config.oracle) < 2:
        raise ConfigError(f"method.features=deep reads the oracle's deeper layers, but oracle={config.oracle} has one")


METHOD_CHOICES = {
    "features": ("all", "z", "deep"),
    "leaves": ("constant", "linear"),
    "criterion": ("gini", "entropy"),
}
RANGES: dict[str, tuple[float, float]] = {  # key: least and greatest value; keys of other algorithms are passed over
    "seed": (0, LARGEST_SEED),
    "n_workers": (1, math.inf),
    "actor.negative_slope": (0, math.nextafter(1, 0)),
    "train.steps": (1, math.inf),
    "train.eval_interval_steps": (1, math.inf),
    "train.n_selection_episodes": (1, math.inf),
    "train.max_learning_starts": (0, math.inf),
    "map.max_leaves": (1, math.inf),
    "prune.n_episodes": (1, math.inf),
    "prune.k": (1, math.inf),
    "evaluate.n_episodes": (1, math.inf),
    "evaluate.first_seed": (0, LARGEST_SEED),
    "algo.learning_rate": (1e-12, 10),
    "algo.batch_size": (1, math.inf),
    "algo.gamma": (0, 1),
    "algo.weight_decay": (0, 10),
    "algo.n_envs": (1, 4096),
    "algo.n_steps": (2, math.inf),
    "algo.n_epochs": (1, math.inf),
    "algo.gae_lambda": (0, 1),
    "algo.clip_range": (1e-6, 10),
    "algo.vf_coef": (0, math.inf),
    "algo.max_grad_norm": (1e-12, math.inf),
    "algo.sde_sample_freq": (-1, math.inf),
    "algo.buffer_size": (1, math.inf),
    "algo.learning_starts": (0, math.inf),
    "algo.tau": (1e-12, 1),
    "algo.train_freq": (1, math.inf),
    "algo.gradient_steps": (1, math.inf),
    "algo.action_noise_std": (0, math.inf),
    "algo.action_noise_dt": (1e-12, math.inf),
    "algo.policy_delay": (1, math.inf),
    "algo.target_update_interval": (1, math.inf),
    "algo.exploration_fraction": (1e-6, 1),
    "algo.exploration_final_eps": (0, 1),
    "algo.target_kl": (1e-12, math.inf),
    "algo.cg_max_steps": (1, math.inf),
    "algo.cg_damping": (0, math.inf),
    "algo.n_critic_updates": (1, math.inf),
    "algo.n_delta": (1, math.inf),
    "algo.n_top": (1, math.inf),
    "algo.delta_std": (1e-12, math.inf),
    "imitate.n_initial_episodes": (1, math.inf),
    "imitate.n_rounds": (0, math.inf),
    "imitate.n_episodes": (1, math.inf),
    "imitate.n_choice_episodes": (0, math.inf),
    "method.n_history": (1, math.inf),
    "method.l1": (0, math.inf),
    "method.first_layer_scale": (1e-12, math.inf),
    "method.zero_below": (0, math.inf),
    "method.max_samples": (1, math.inf),
    "method.min_samples_leaf": (1, math.inf),
    "method.max_patterns": (1, math.inf),
    "method.alpha": (0, math.inf),
    "method.n_updates": (1, math.inf),
    "method.n_updates_next": (1, math.inf),
    "method.batch_size": (1, math.inf),
    "method.learning_rate": (1e-12, 10),
    "method.beta_first": (1e-6, 1e6),
    "method.beta_last": (1e-6, 1e6),
    "method.ridge": (0, math.inf),
    "method.anneal_until": (0, 1),
    "method.learning_rate_end": (0, 1),
    "method.n_features": (1, 1024),
    "method.structure_penalty": (0, 100),
    "method.discretise_at": (0, 1),
    "trainer.n_envs": (1, 4096),
    "trainer.runs_per_process": (1, 4096),
}
TRACKERS = ("none", "tensorboard", "mlflow")
ACTION_NOISES = ("none", "normal", "ornstein_uhlenbeck")
FLEET_CHOICES = {
    "precision": ("fp32", "bf16"),
    "environments": ("gymnasium", "envpool"),
    "device": ("cpu", "cuda"),
}


def _check_numbers(config: RunConfig) -> None:
    """Refuse values that no run can use, naming the key, the value and what it may be."""
    for key, (least, greatest) in RANGES.items():
        value: Any = config
        for name in key.split("."):
            value = getattr(value, name, None)
        if value is not None and not least <= value <= greatest:
            raise ConfigError(f"{key}={value} is not between {least:g} and {greatest:g}")
    if isinstance(config.algo, GradientConfig) and any(width < 1 for width in config.algo.critic):
        raise ConfigError(f"algo.critic={config.algo.critic}: every layer needs at least 1 neuron")
    if isinstance(config.algo, ContinuousConfig) and config.algo.action_noise not in ACTION_NOISES:
        raise ConfigError(f"algo.action_noise={config.algo.action_noise}: use one of {', '.join(ACTION_NOISES)}")
    if isinstance(config.algo, SacConfig) and not re.fullmatch(r"auto|[0-9.]+(e-?[0-9]+)?", config.algo.ent_coef):
        raise ConfigError(f"algo.ent_coef={config.algo.ent_coef}: use auto, or a number for a fixed temperature")
    if config.fleet:
        _check_fleet(config.fleet, config.algo)
    if config.tracking not in TRACKERS:
        raise ConfigError(f"tracking={config.tracking}: use one of {', '.join(TRACKERS)}")
    if not config.results_dir:
        raise ConfigError("results_dir is empty; give a folder, or leave it out (and OTR_RESULTS_DIR unset)")


def _check_fleet(fleet: FleetConfig, algo: AlgoConfig) -> None:
    for key, choices in FLEET_CHOICES.items():
        if getattr(fleet, key) not in choices:
            raise ConfigError(f"trainer.{key}={getattr(fleet, key)}: use one of {', '.join(choices)}")
    assert isinstance(algo, SacConfig)
    if (algo.train_freq, algo.gradient_steps) != (1, 1):
        raise ConfigError(
            f"trainer={fleet.name} does one update for each environment step, but algo.train_freq={algo.train_freq} "
            f"and algo.gradient_steps={algo.gradient_steps}; leave both at 1, or use trainer=sb3"
        )
    if algo.action_noise == "ornstein_uhlenbeck":
        raise ConfigError(f"trainer={fleet.name} has no ornstein_uhlenbeck noise; use algo.action_noise=normal")
