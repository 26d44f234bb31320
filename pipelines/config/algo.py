"""The algorithm that trains a run: a file of conf/algo."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from otr.control.settings import SearchSettings
from otr.setting import CountOrZero, LearningRate
from pipelines.config.setting import (
    EXECUTION,
    AsBefore,
    Count,
    FreeText,
    NotNegative,
    OneOf,
    Positive,
    Range,
    Share,
    Text,
    Width,
    declared,
)
from pipelines.config.stages import ActorConfig
from pipelines.errors import ConfigError

MOST_LAYERS, WIDEST_LAYER = 2, 32  # of an actor that is searched


def widths_of(layers: Any) -> tuple[int, ...]:
    """Return the hidden widths that a setting gives: 6 is (6,), [8, 8] is (8, 8), and 0, the linear policy, is ()."""
    return tuple(width for width in (layers if isinstance(layers, Sequence) else [layers]) if width)


def is_small(layers: Any) -> bool:
    """Return whether a network of these hidden layers has neurons, and no more than a search moves."""
    widths = widths_of(layers)
    return 0 < len(widths) <= MOST_LAYERS and all(isinstance(width, int) and width <= WIDEST_LAYER for width in widths)


@dataclass(frozen=True)
class AlgoConfig:
    """What every algorithm has."""

    name: FreeText

    # Environment steps per second on one core of a 2020s server, evaluations included, measured
    steps_per_s: ClassVar[float]

    @property
    def training_rate(self) -> float:
        """The likely environment steps per second on one core."""
        return self.steps_per_s

    @property
    def rollout_steps(self) -> int:
        """The least environment steps of training, which does whole multiples of it."""
        return 1

    def check(self, key: str, layers: int | list[int], actor: ActorConfig) -> None:
        """Raise ConfigError if the algorithm does not train an actor of these hidden layers, the value of `key`."""


@dataclass(frozen=True)
class ArsConfig(SearchSettings, AlgoConfig):
    """Augmented random search (Mania et al. 2018) with the library's settings.

    Step and noise are in units of a network that reads normalised states and acts in half widths of the action box.
    """

    n_episodes: Count = 1  # of each candidate of an iteration
    # Whether the two policies of a direction, or all of an iteration, start from the same states
    common_starts: Annotated[str, OneOf("pair", "all")] = "pair"
    # Whether states are normalised by the mean and deviation of those visited so far, the paper's V2; its V1 does not
    normalise: bool = True
    # Of the environment's reward for every step, taken off while searching
    alive_bonus: Annotated[float, Range()] = 0.0
    # Steps of an episode at first, 0 for whole ones; they grow linearly to whole ones over this share of the search
    first_horizon: CountOrZero = 0
    horizon_until: Annotated[float, Range(1e-6, 1)] = 1.0
    # Searches of `start_steps` from different networks, of which the best one continues, for as many steps at
    # least; 1 for a single search
    n_starts: Count = 1
    start_steps: Count = 100_000
    # Who computes the environments: gymnasium, or numpy for those that were compared with gymnasium
    environments: Annotated[str, OneOf("gymnasium", "numpy")] = "gymnasium"
    expected_steps_per_s: Annotated[float, Range(1), EXECUTION] = 8_000.0

    @property
    def training_rate(self) -> float:
        """The likely environment steps per second on one core."""
        return self.expected_steps_per_s

    def check(self, key: str, layers: int | list[int], actor: ActorConfig) -> None:
        """Refuse networks too large to be searched, and settings that make no search."""
        if widths_of(layers) and not is_small(layers):
            raise ConfigError(
                f"{key}={layers}: algo=ars searches small networks, up to {MOST_LAYERS} layers of {WIDEST_LAYER} "
                "neurons; others, as algo=sac, train larger ones"
            )
        if actor.rescale_inputs:
            raise ConfigError("actor.rescale_inputs=true: algo=ars normalises states itself; leave it out")


@dataclass(frozen=True)
class GradientConfig(AlgoConfig):
    """What algorithms with critics have: the widths of their hidden layers in `critic`; `weight_decay` is Adam's."""

    learning_rate: LearningRate = 1e-3
    batch_size: Count = 100
    gamma: Share = 0.99
    critic: list[Width] = field(default_factory=lambda: [256, 256])
    weight_decay: Annotated[float, Range(0, 10)] = 0.0


@dataclass(frozen=True)
class PpoConfig(GradientConfig):
    """Proximal policy optimisation, under Stable-Baselines3's names."""

    n_envs: Annotated[int, Range(1, 4096)] = 1
    n_steps: Annotated[int, Range(2)] = 2048
    gae_lambda: Share = 0.95
    # Whether states, and rewards by the deviation of their discounted sum, are normalised by what was met so far
    # (VecNormalize); the states' part is affine and is folded into the actor, which reads the environment's own states
    normalise: Annotated[bool, AsBefore(False)] = field(default=False, kw_only=True)
    n_epochs: Count = 10
    clip_range: Annotated[float, Range(1e-6, 10)] = 0.2
    ent_coef: NotNegative = 0.0
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5
    # Explore by a linear function of the state that is redrawn every `sde_sample_freq` steps (-1: every
    # rollout), instead of by noise drawn at every step; for continuous actions
    use_sde: Annotated[bool, AsBefore(False)] = False
    sde_sample_freq: Annotated[int, Range(-1), AsBefore(-1)] = -1

    steps_per_s = 1_700.0

    @property
    def rollout_steps(self) -> int:
        """A rollout of `n_steps` in each environment."""
        return self.n_steps * self.n_envs

    def check(self, key: str, layers: int | list[int], actor: ActorConfig) -> None:
        """Refuse states that are normalised twice."""
        super().check(key, layers, actor)
        if self.normalise and actor.rescale_inputs:
            raise ConfigError("algo.normalise=true and actor.rescale_inputs=true both change the states: leave one out")


@dataclass(frozen=True)
class OffPolicyConfig(GradientConfig):
    """What algorithms with a replay buffer share."""

    buffer_size: Count = 1_000_000
    learning_starts: CountOrZero = 10_000
    tau: Annotated[float, Range(1e-12, 1)] = 0.005
    train_freq: Count = 1
    gradient_steps: Count = 1


@dataclass(frozen=True)
class DqnConfig(OffPolicyConfig):
    """Deep Q-learning, for labels: the actor is the network of the action values, so `critic` stays empty."""

    target_update_interval: Count = 250  # steps between updates of the target network
    exploration_fraction: Annotated[float, Range(1e-6, 1)] = 0.12  # of all steps, until random actions are rare
    exploration_final_eps: Share = 0.1  # their share from then on
    max_grad_norm: Positive = 10.0

    steps_per_s = 900.0


@dataclass(frozen=True)
class ContinuousConfig(OffPolicyConfig):
    """What SAC, TD3 and DDPG share; `action_noise_dt` is of the Ornstein-Uhlenbeck process."""

    action_noise: Annotated[str, OneOf("none", "normal", "ornstein_uhlenbeck")] = "normal"
    action_noise_std: NotNegative = 0.1
    action_noise_dt: Positive = 0.01


@dataclass(frozen=True)
class SacConfig(ContinuousConfig):
    """Soft actor-critic. `ent_coef` is `auto`, or a number as a string for a fixed temperature.

    The settings after it are of `trainer=fleet` alone.
    """

    ent_coef: Annotated[
        str, Text(r"auto|([0-9]+\.?[0-9]*|\.[0-9]+)(e-?[0-9]+)?", "use auto, or a number for a fixed temperature")
    ] = "auto"
    learning_rate_end: Annotated[float, Range(0, 1), AsBefore(1.0)] = 1.0  # share at the end, reached linearly
    actor_delay: Annotated[int, Range(1), AsBefore(1)] = 1  # updates of the critics for each of actor and temperature

    steps_per_s = 145.0

    @classmethod
    def of_fleets(cls) -> dict[str, Any]:
        """Return the settings that other trainers do not have, with the values that mean what these do."""
        kind: Any = cls
        marked = ((name, marker) for name, markers in declared(kind).items() for marker in markers)
        return {name: marker.value for name, marker in marked if isinstance(marker, AsBefore)}


@dataclass(frozen=True)
class Td3Config(ContinuousConfig):
    """Twin delayed DDPG."""

    policy_delay: Count = 2
    target_policy_noise: NotNegative = 0.2
    target_noise_clip: NotNegative = 0.5

    steps_per_s = 240.0


@dataclass(frozen=True)
class DdpgConfig(ContinuousConfig):
    """Deep deterministic policy gradient."""

    steps_per_s = 300.0


ALGORITHMS: dict[str, type[AlgoConfig]] = {
    "ppo": PpoConfig,
    "sac": SacConfig,
    "td3": Td3Config,
    "ddpg": DdpgConfig,
    "dqn": DqnConfig,
    "ars": ArsConfig,
}
