"""What is known about an imitation without doing it: its key, its working files, its likely time.

Apart from `pipelines/stages/imitate.py`, because that imports scikit-learn, which planning and skipping need not wait
for.
"""

from pathlib import Path
from typing import Any

import gymnasium as gym

from pipelines.config import ImitatingConfig, RunConfig
from pipelines.config.settings import digest, settings
from pipelines.engine.stage import verified_manifest

IMITATE_VERSION = 1
STEPS_PER_S = 8_000.0  # environment steps on one core, with the states kept and labelled
SHARE_PLAYED = 0.5  # of an episode's longest length


def imitate_settings(config: RunConfig) -> dict[str, Any]:
    """Return what decides the tree, given the oracle."""
    everything = settings(config)
    return {
        "env": {"id": config.env.id, "kwargs": config.env.kwargs},
        "method": everything["method"],
        "depth": config.depth,
        "imitate": everything["imitate"],
        "seed": config.seed,
        "feature_names": config.env.feature_names,
        "action_names": config.env.action_names,
    }


def working_folder(config: RunConfig, oracle: Path) -> Path:
    """Return where the data set and the iterates lie while the run is under way; `oracle` is that stage's folder."""
    key = digest([IMITATE_VERSION, imitate_settings(config), verified_manifest(oracle)["output_digest"]])
    return Path(config.results_dir) / "checkpoints" / key[:16]


def estimated_seconds(config: RunConfig) -> float:
    """Return the likely time of the imitation on one core, the oracle's training apart."""
    imitation, method = config.imitate, config.method
    assert isinstance(method, ImitatingConfig)
    # Successive halving plays about as much again as its last two candidates do, six times over.
    n_chosen = 6 * imitation.n_choice_episodes
    n_episodes = imitation.n_initial_episodes + (imitation.n_rounds + 1) * imitation.n_episodes + n_chosen
    longest = gym.spec(config.env.id).max_episode_steps or 1000
    return n_episodes * longest * SHARE_PLAYED / STEPS_PER_S + (imitation.n_rounds + 1) * method.fit_s
