"""The return of random actions in every control task, which is the 0 of the performance profile.

`python -m pipelines.cli.random_returns` writes `pipelines/random_returns.csv`, in a minute.
"""

import copy
from contextlib import closing
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from otr.control.environments import GymnasiumVectorEnv
from otr.control.rollout import play_side_by_side
from pipelines.cli.runs import run_config
from pipelines.config.env import EnvConfig
from pipelines.engine.store import write_csv
from pipelines.play.environments import make_env
from pipelines.report.cells import TASK_NAMES

SEEDS = range(1000, 1100)  # of the actions, and of the episodes: the starts on which policies are evaluated


def play_randomly(env: EnvConfig) -> np.ndarray:
    """Return the return of an episode a seed, whose actions are drawn uniformly from the action space."""
    with closing(GymnasiumVectorEnv(partial(make_env, env))) as envs:
        spaces = [copy.deepcopy(envs.first.action_space) for _ in SEEDS]
        for space, seed in zip(spaces, SEEDS, strict=True):
            space.seed(seed)
        played = play_side_by_side(envs, lambda _, episodes: np.array([spaces[i].sample() for i in episodes]), SEEDS)
    return played.returns


def _row(task: str) -> dict[str, Any]:
    env = run_config([f"env={task}"]).env
    returns = play_randomly(env)
    moments = {"mean": round(np.mean(returns), 3), "std": round(np.std(returns), 3)}
    seeds = {"first_seed": SEEDS[0], "n_episodes": len(SEEDS)}
    return {"task": task, "env_id": env.id, **moments, **seeds, "gymnasium": version("gymnasium")}


if __name__ == "__main__":
    rows = [_row(task) for task in TASK_NAMES]
    write_csv(Path(__file__).parents[1] / "random_returns.csv", rows, rows[0])
