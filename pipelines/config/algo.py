"""The algorithm that trains a run: a file of conf/algo."""

from dataclasses import dataclass


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
