"""The return of random actions in every control task, which is the 0 of the performance profile.

`python -m pipelines.cli.random_returns` writes `pipelines/random_returns.csv`, in a minute.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import pipelines
from pipelines.cli.runs import run_config
from pipelines.config.env import EnvConfig
from pipelines.engine.store import write_csv
from pipelines.play.environments import make_env
from pipelines.report.cells import TASK_NAMES

SEEDS = range(1000, 1100)  # of the actions, and of the episodes: the starts on which policies are evaluated


def random_returns(env: EnvConfig) -> list[float]:
    """Return the return of an episode a seed, whose actions are drawn uniformly from the action space."""
    played, returns = make_env(env), []
    for seed in SEEDS:
        played.reset(seed=seed)
        played.action_space.seed(seed)
        total, is_over = 0.0, False
        while not is_over:
            _, reward, terminated, truncated, _ = played.step(played.action_space.sample())
            total, is_over = total + float(reward), terminated or truncated
        returns.append(total)
    played.close()
    return returns


def _row(task: str) -> dict[str, Any]:
    env = run_config([f"env={task}"]).env
    returns = random_returns(env)
    moments = {"mean": round(np.mean(returns), 3), "std": round(np.std(returns), 3)}
    seeds = {"first_seed": SEEDS[0], "n_episodes": len(SEEDS)}
    return {"task": task, "env_id": env.id, **moments, **seeds, "gymnasium": version("gymnasium")}


if __name__ == "__main__":
    rows = [_row(task) for task in TASK_NAMES]
    write_csv(Path(pipelines.__file__).with_name("random_returns.csv"), rows, rows[0])
