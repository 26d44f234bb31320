"""Made-up runs with known returns: their summaries, as `otr-run` writes them."""

import json
from pathlib import Path
from typing import Any


def write_run(results_dir: Path, run: str, return_mean: float, /, **changes: Any) -> Path:
    """Write the summary of `run`, its folder below `runs`; `changes` replace what the folder tells. Return the file."""
    env, method, depth, budget, seed = run.split("/")
    widths = [int(width) for width in depth.removeprefix("depth-").split("-")]
    summary = {
        "schema": "otr/summary/1", "env": env, "task": env.removesuffix("_v5"), "env_id": f"{env}-id", "method": method,
        "depth": widths[0] if len(widths) == 1 else widths, "budget": budget, "algorithm": "sac",
        "trainer": "fleet" if budget.endswith("-fleet") else "sb3", "versions": {"gymnasium": "1.4.0"},
        "seed": int(seed.removeprefix("seed-").split("~")[0]), "steps": 100_000, "return_mean": return_mean,
        "n_episodes": 100, "pruned_depth": 3.0,
    }  # fmt: skip
    path = results_dir / "runs" / run / "summary.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(summary | changes))
    return path
