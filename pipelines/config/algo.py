"""The algorithm that trains a run: a file of conf/algo."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pipelines.config.setting import AsBefore, Count, FreeText, NotNegative, OneOf, Positive, Range, Share, Text, Width
from pipelines.errors import ConfigError


@dataclass(frozen=True)
class AlgoConfig:
    """What every algorithm has."""

    name: FreeText
    learning_rate: Annotated[float, Range(1e-12, 10)]

    # Environment steps per second on one core of a 2020s server, evaluations included, measured
    steps_per_s: ClassVar[float]

    @property
    def rollout_steps(self) -> int:
        """The environment steps that training does at least, and in whole multiples."""
        return 1

    def check(self, depth: int | list[int]) -> None:
        """Raise ConfigError if the algorithm trains no actor of this depth."""


@dataclass(frozen=True)
class ArsConfig(AlgoConfig):
    """Augmented random search of a linear policy (Mania et al. 2018), under sb3-contrib's names."""

    n_delta: Count  # directions tried an update, each forth and back: 2 n_delta episodes
    n_top: Count  # the best of them, which make the step
    delta_std: Positive  # length of the directions
    with_bias: bool  # whether the policy has offsets; the original has none and normalises states instead

    steps_per_s = 10_000.0

    def check(self, depth: int | list[int]) -> None:
        """Refuse hidden neurons."""
        if depth not in (0, [0]):
            raise ConfigError(f"algo=ars searches linear policies; depth={depth} has hidden neurons, add depth=0")


@dataclass(frozen=True)
class GradientConfig(AlgoConfig):
    """What algorithms with critics have: the widths of their hidden layers in `critic`; `weight_decay` is Adam's."""

    batch_size: Count
    gamma: Share
    critic: list[Width]
    weight_decay: Annotated[float, Range(0, 10)]


@dataclass(frozen=True)
class OnPolicyConfig(GradientConfig):
    """What PPO and TRPO share, under Stable-Baselines3's names."""

    n_envs: Annotated[int, Range(1, 4096)]
    n_steps: Annotated[int, Range(2)]
    gae_lambda: Share

    steps_per_s = 1_700.0

    @property
    def rollout_steps(self) -> int:
        """A rollout of `n_steps` in each environment."""
        return self.n_steps * self.n_envs


@dataclass(frozen=True)
class PpoConfig(OnPolicyConfig):
    """Proximal policy optimisation, under Stable-Baselines3's names."""

    n_epochs: Count
    clip_range: Annotated[float, Range(1e-6, 10)]
    ent_coef: NotNegative
    vf_coef: NotNegative
    max_grad_norm: Positive
    # Explore by a linear function of the state that is drawn anew every `sde_sample_freq` steps (-1: every
    # rollout), instead of by noise drawn at every step; for continuous actions
    use_sde: Annotated[bool, AsBefore(False)] = False
    sde_sample_freq: Annotated[int, Range(-1), AsBefore(-1)] = -1


@dataclass(frozen=True)
class TrpoConfig(OnPolicyConfig):
    """Trust region policy optimisation, under sb3-contrib's names."""

    target_kl: Positive
    cg_max_steps: Count
    cg_damping: NotNegative
    n_critic_updates: Count


@dataclass(frozen=True)
class OffPolicyConfig(GradientConfig):
    """What algorithms with a replay buffer share."""

    buffer_size: Count
    learning_starts: Annotated[int, Range(0)]
    tau: Annotated[float, Range(1e-12, 1)]
    train_freq: Count
    gradient_steps: Count


@dataclass(frozen=True)
class DqnConfig(OffPolicyConfig):
    """Deep Q-learning, for labels: the actor is the network of the action values, so `critic` stays empty."""

    target_update_interval: Count  # steps between updates of the target network
    exploration_fraction: Annotated[float, Range(1e-6, 1)]  # of all steps, over which random actions become rarer
    exploration_final_eps: Share  # their share from then on
    max_grad_norm: Positive

    steps_per_s = 900.0


@dataclass(frozen=True)
class ContinuousConfig(OffPolicyConfig):
    """What SAC, TD3 and DDPG share; `action_noise_dt` is of the Ornstein-Uhlenbeck process."""

    action_noise: Annotated[str, OneOf("none", "normal", "ornstein_uhlenbeck")]
    action_noise_std: NotNegative
    action_noise_dt: Positive


@dataclass(frozen=True)
class SacConfig(ContinuousConfig):
    """Soft actor-critic. `ent_coef` is `auto`, or a number as a string for a fixed temperature."""

    ent_coef: Annotated[str, Text(r"auto|[0-9.]+(e-?[0-9]+)?", "use auto, or a number for a fixed temperature")]

    steps_per_s = 145.0


@dataclass(frozen=True)
class Td3Config(ContinuousConfig):
    """Twin delayed DDPG."""

    policy_delay: Count
    target_policy_noise: NotNegative
    target_noise_clip: NotNegative

    steps_per_s = 240.0


@dataclass(frozen=True)
class DdpgConfig(ContinuousConfig):
    """Deep deterministic policy gradient."""

    steps_per_s = 300.0


ALGORITHMS: dict[str, type[AlgoConfig]] = {
    "ppo": PpoConfig,
    "trpo": TrpoConfig,
    "sac": SacConfig,
    "td3": Td3Config,
    "ddpg": DdpgConfig,
    "dqn": DqnConfig,
    "ars": ArsConfig,
}
