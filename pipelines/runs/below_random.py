"""What to look for where an imported policy returns less than random actions."""

from collections.abc import Mapping
from typing import Any

from pipelines.config.run import RunConfig
from pipelines.play.random_returns import random_returns


def warning_below_random(config: RunConfig, summary: Mapping[str, Any]) -> str | None:
    """Return what may be wrong with a policy from a file; None where it returns more, or nothing is known of that."""
    random = None if config.env.kwargs else random_returns("env_id").get(config.env.id)
    if config.imported is None or random is None:
        return None
    policy = "oracle" if config.method.imitates else "network"
    mean = float(summary["policies"][policy]["return_mean"])
    if mean >= random:
        return None
    is_raw_zip = config.imported.name.endswith(".zip") and not config.imported.is_normalised
    remedy = "was it trained under VecNormalize? vec_normalize=FILE names the file of its statistics"
    others = "was it trained for another environment, or with wrappers that this one lacks?"
    return (
        f"{config.imported.name} returns {mean:,.1f}, less than random actions do in {config.env.id} ({random:,.1f}): "
        f"{remedy if is_raw_zip else others}"
    )
