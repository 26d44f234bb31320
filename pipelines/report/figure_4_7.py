"""Figure 4.7: an AugTree policy of depth 2 for the lander as a program, before and after its tests are simplified."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from otr.shorten.refit_tests import RefittedTest, RefittedTree, refit_tests
from pipelines.config import RunConfig
from pipelines.engine.seeding import episode_seeds, evaluation_seeds
from pipelines.engine.store import read_csv, write_text
from pipelines.errors import PipelineError
from pipelines.play.environments import action_names, feature_names
from pipelines.play.rollout import Rollout, rollout
from pipelines.report.published import published
from pipelines.stages.derived import opened_run

PREFERRED_ORACLE = [256]
AGREEMENTS = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7)  # tried
MOST_LOST = 0.02  # of the return on the pruning episodes; the thesis's policy lost 1 %
DIGITS = 2


@dataclass(frozen=True)
class _Policy:
    """A tree and its returns over the evaluation episodes."""

    tree: otr.ObliqueTree
    returns: np.ndarray


def write_figure_4_7(runs: Sequence[RunConfig], results_dir: Path) -> list[Path]:
    """Write the two programs with their returns and a picture of the simpler one under `results_dir/figures`.

    The run is the one with the best selection return, of those with an oracle of 256 units where there are any. As in
    the thesis the tests below the root are refitted and the root is rounded. States, and the returns that say how far
    to go, are those of the run's prune stream; no choice sees an episode that is reported.

    Args:
        runs: AugTree's runs of depth 2, finished or not.
        results_dir: the folder that holds them.

    Returns:
        The text and the picture.

    Raises:
        PipelineError: none of the runs is finished.
    """
    config = _chosen(runs, results_dir)
    with opened_run(config, results_dir / config.folder, "imitate") as whole:
        tree = otr.load(whole / "imitate" / "tree")
    if not isinstance(tree, otr.ObliqueTree):
        raise PipelineError(f"{results_dir / config.folder}: its tree is held as patterns, which cannot be simplified")
    seeds = episode_seeds(config.seed, "prune", config.prune.n_episodes)
    played = rollout(tree.predict, config.env, seeds, keep_states=True, n_workers=1)
    states = played.states
    agreement, simplified = _simplest(tree, played, config, seeds)
    original, simpler = (_Policy(each, _returns(each, config)) for each in (tree, simplified.tree))

    folder = results_dir / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "figure_4_7.txt", folder / "figure_4_7.png"]
    write_text(paths[0], _text(config, original, simpler, simplified, agreement, len(states)))
    figure = otr.draw_tree(
        simpler.tree,
        **_names(config, tree),
        max_terms=tree.n_inputs,
        counts=np.bincount(simpler.tree.apply(states), minlength=tree.n_leaves),
        title=f"AugTree on the lander, simplified: return {simpler.returns.mean():.1f}",
    )
    otr.save_picture(figure, paths[1])
    return paths


def _chosen(runs: Sequence[RunConfig], results_dir: Path) -> RunConfig:
    """Return the finished run with the best selection return of its tree."""
    finished = [run for run in runs if (results_dir / run.folder / "summary.json").is_file()]
    if not finished:
        raise PipelineError(
            f"{results_dir}: no AugTree of depth 2 has been run on the lander.\n"
            "Run: otr-run +experiment=figure_4_6 budget=quick method=augtree depth=2"
        )
    preferred = [run for run in finished if run.oracle == PREFERRED_ORACLE]
    return max(preferred or finished, key=lambda run: selection_return(results_dir / run.folder))


def _simplest(
    tree: otr.ObliqueTree, played: Rollout, config: RunConfig, seeds: Sequence[int]
) -> tuple[float, RefittedTree]:
    """Return the loosest agreement, and its tree, with which the pruning episodes' return is almost what it was.

    The tightest one where none of them is.
    """
    least = played.returns.mean() - MOST_LOST * abs(played.returns.mean())
    nodes = range(1, tree.n_nodes)
    for agreement in reversed(AGREEMENTS):
        simplified = refit_tests(tree, played.states, agreement=agreement, digits=DIGITS, nodes=nodes)
        if rollout(simplified.tree.predict, config.env, seeds, n_workers=1).returns.mean() >= least:
            break
    return agreement, simplified


def selection_return(run_dir: Path) -> float:
    """Return the return of a run's tree on the episodes it was chosen by."""
    rows = read_csv(run_dir / "imitate" / "iterates.csv")
    return next(float(row["selection_mean"]) for row in rows if row["chosen"] == "True")


def _returns(tree: otr.ObliqueTree, config: RunConfig) -> np.ndarray:
    seeds = evaluation_seeds(config.evaluate.first_seed, config.evaluate.n_episodes)
    return rollout(tree.predict, config.env, seeds, n_workers=1).returns


def _names(config: RunConfig, tree: otr.ObliqueTree) -> dict[str, Any]:
    return {
        "feature_names": feature_names(config.env, tree.n_inputs),
        "output_names": action_names(config.env, tree.n_outputs),
    }


def _text(
    config: RunConfig, original: _Policy, simpler: _Policy, simplified: RefittedTree, agreement: float, n_states: int
) -> str:
    """Return the figure as text."""
    oracle, digits = str(config.oracle).replace(" ", ""), f"{DIGITS} significant digits"
    before, after = (
        published()["text", "lunarlander", f"augtree-fig4.7-{name}", "2"].mean for name in ("original", "simplified")
    )
    blocks = [
        "Figure 4.7: an AugTree policy of depth 2 for the lunar lander, before and after simplification",
        f"{config.folder}, which imitates an oracle with hidden layers {oracle}.\n"
        "It is the run with the best selection return; no reported episode has chosen it.",
        f"Before: {_returns_text(original)} (thesis: {before})\n\n{_program(config, original.tree)}",
        f"After: {_returns_text(simpler)} (thesis: {after})\n\n{_program(config, simpler.tree)}",
        f"The tests below the root were refitted by linear discriminant analysis with L1 on the {n_states:,} states\n"
        f"of the run's {config.prune.n_episodes} pruning episodes, each with the fewest inputs that send at least "
        f"{agreement:.0%} of either side\nwhere the original did. It is the least share of "
        f"{', '.join(f'{share:.0%}' for share in AGREEMENTS)} that loses at most\n{MOST_LOST:.0%} of the return on the "
        f"pruning episodes. Numbers have {digits}, the root's where they allow it.",
        "\n".join(_test_text(test) for test in simplified.tests),
        "Made by: otr-tabulate figure=4.7",
    ]
    return "\n\n".join(block.rstrip("\n") for block in blocks) + "\n"


def _program(config: RunConfig, tree: otr.ObliqueTree) -> str:
    lines = otr.to_text(tree, **_names(config, tree), precision=4).splitlines()
    return "\n".join(f"    {line}" for line in lines)


def _returns_text(policy: _Policy) -> str:
    returns = policy.returns
    return f"return {returns.mean():.1f} ± {returns.std():.1f} over {len(returns)} episodes"


def _test_text(test: RefittedTest) -> str:
    return (
        f"test {test.node}: {test.change}, {test.n_coefficients_before} inputs to {test.n_coefficients}, "
        f"{test.n_left:,} states to the left and {test.n_right:,} to the right, at least {test.agreement:.1%} of "
        f"either still go there"
    )
