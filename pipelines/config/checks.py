"""What no run can be: refused before anything is done, with the key, its value and what it may be."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from pipelines.config.algo import (
    AlgoConfig,
    ArsConfig,
    ContinuousConfig,
    GradientConfig,
    SacConfig,
)
from pipelines.config.methods import EXTRA_STAGES, METHODS, MethodConfig
from pipelines.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.config.run import RunConfig
    from pipelines.config.trainer import FleetConfig

LARGEST_SEED = 2**32 - 1
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


def check(config: RunConfig) -> None:
    """Raise ConfigError if the run cannot be.

    Args:
        config: a run whose fields are of the right types.
    """
    _check_depth(config.depth)
    config.method.check_depth(config.depth)
    _check_stages(config.stages, config.method)
    _check_method(config)
    _check_numbers(config)


def _check_depth(depth: Any) -> None:
    widths = [depth] if isinstance(depth, int) else depth
    integers = isinstance(widths, list) and widths and all(type(width) is int for width in widths)
    if not integers or isinstance(depth, bool):
        raise ConfigError(f"depth={depth!r}: give a number of hidden neurons (depth=6) or one per layer (depth=[8,8])")
    if any(width < 0 for width in widths) or (len(widths) > 1 and 0 in widths):
        raise ConfigError(f"depth={depth!r}: a layer cannot have {min(widths)} neurons; depth=0 is the linear policy")


def _check_stages(stages: list[str] | None, method: MethodConfig) -> None:
    for stage in stages or ():
        known = (*method.stages, *(extra for extra in EXTRA_STAGES if extra != "certify" or method.is_mapped))
        if stage not in known:
            raise ConfigError(f"stages: method={method.name} has no stage {stage!r}; it has {', '.join(known)}")


def _check_method(config: RunConfig) -> None:
    """Refuse what the method cannot be used with, and choices that it does not have."""
    if not 0 <= config.simplification.return_loss < 1:
        raise ConfigError(
            f"simplification.return_loss={config.simplification.return_loss}: give a share from 0 to below 1"
        )
    if config.certify and not config.method.is_mapped:
        raise ConfigError(
            f"certify=true: a tree of method={config.method.name} stands for no network that it could be proved equal "
            f"to; these do: {', '.join(name for name, method in METHODS.items() if method.is_mapped)}"
        )
    config.method.check(config.algo, config.actor, config.oracle)
    if isinstance(config.algo, ArsConfig) and config.hidden_widths:
        raise ConfigError(f"algo=ars searches linear policies; depth={config.depth} has hidden neurons, add depth=0")
    for name, choices in METHOD_CHOICES.items():
        value = getattr(config.method, name, None)
        if value is not None and value not in choices:
            raise ConfigError(f"method.{name}={value}: use one of {', '.join(choices)}")


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
