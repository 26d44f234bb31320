"""Which settings decide what comes out of a run: the keys of its stages and the name of its folder."""

import hashlib
from typing import Any

from pipelines.config import EnvConfig, RunConfig
from pipelines.config.setting import keyed_settings
from pipelines.engine.digests import folder_suffix, setting_differences


def run_folder(config: RunConfig, baseline: RunConfig) -> str:
    """Return the run's folder below `results_dir`: `runs/<env>/<method>/depth-<d>/<budget>/seed-<s>[~<digest>]`.

    `baseline` is what the same env, method, depth, budget and seed give without any other override; whatever differs
    from it goes into the digest, so that other settings never share a folder.
    """
    depth = "-".join(str(width) for width in config.hidden_widths) or "0"
    differences = setting_differences(settings(config), settings(baseline))
    seed = f"seed-{config.seed}{folder_suffix(differences)}"
    return f"runs/{config.env.name}/{config.method.name}/depth-{depth}/{config.budget_level}/{seed}"


def settings(config: RunConfig) -> dict[str, Any]:
    """Return the resolved settings that decide what comes out, as plain JSON-able data.

    The budget's table of steps is left out but for its name: `train`, `prune` and `evaluate` hold what it gave.
    """
    plain = keyed_settings(config, config.method)
    plain |= {"budget": config.budget.name, "depth": list(config.hidden_widths)}
    if config.program_text is not None:
        plain["program_sha256"] = hashlib.sha256(config.program_text.encode()).hexdigest()
    if not config.fleet:
        del plain["trainer"]
    return plain


def env_settings(env: EnvConfig) -> dict[str, Any]:
    """Return what decides how an environment behaves, for the keys of stages that play in it."""
    pid = {} if env.pid is None else {"pid": {"goal": list(env.pid.goal), "n_history": env.pid.n_history}}
    return {"id": env.id, "kwargs": env.kwargs, **pid}
