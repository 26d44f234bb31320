"""The command with which a tree that people can read imitates a policy whose own tree is too large to read."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipelines.config.methods import TakesModel
from pipelines.config.run import RunConfig
from pipelines.engine.command_text import command_text

READABLE_LEAVES = 64  # the lines of a page
NAMES = ("env.feature_names=", "env.action_names=")
DEPTH = 3  # of the tree that is suggested
OTHERS = "viper, lm_viper and ndps make trees of other kinds, distilled_otr a small network whose tree is exact"


def imitating_command(config: RunConfig, overrides: Sequence[str] = ()) -> str:
    """Return the command that makes a tree which imitates the policy that a run of these overrides imports."""
    method, env = config.method, config.env
    assert isinstance(method, TakesModel)
    words = [f"env={env.id}"]
    words += [f"++env.kwargs.{name}={value}" for name, value in env.kwargs.items()]
    words += ["method=augtree", f"oracle={method.model}", f"depth={DEPTH}"]
    given = {"normalise": method.normalise, "output": method.output}
    words += [f"{key}={value}" for key, value in given.items() if value]
    words += [each for each in overrides if each.startswith(NAMES)]
    return command_text("otr-run", words, config.results_dir)


def advice(config: RunConfig, summary: Mapping[str, Any], overrides: Sequence[str] = ()) -> str | None:
    """Return what to do where the last tree of an imported policy is too large to be read; None where it is not."""
    if config.imported is None or not config.method.is_mapped or config.method.imitates:
        return None
    made = [summary[stage]["n_leaves"] for stage in ("simplify", "polish") if stage in summary]
    n_leaves = made[0] if made else summary["pruned_leaves"]
    if n_leaves <= READABLE_LEAVES:
        return None
    policy = "the policy as it was before the polish" if summary.get("polish", {}).get("kept") else "the policy"
    return (
        f"A tree of {n_leaves:,} leaves is more than a person reads. Of the methods that imitate {policy}, {OTHERS}; "
        f"augtree makes a tree of at most {2**DEPTH} leaves:\n  {imitating_command(config, overrides)}"
    )
