"""Figure 4.7: an AugTree policy of depth 2 for the lander as a program, before and after its tests are simplified."""

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

import otr
from otr.shorten.refit_tests import RefittedTest, RefittedTree, refit_tests
from pipelines.config.run import RunConfig
from pipelines.engine.command_text import command_text
from pipelines.engine.stage import part_of
from pipelines.engine.store import read_csv
from pipelines.errors import MissingInputError, PipelineError
from pipelines.play.episodes import PlaysEvaluation, PlaysPruning, Rollout, play_evaluation, play_pruning
from pipelines.play.spaces import action_names, feature_names
from pipelines.report.figures.figure_4_6 import imitating_trees
from pipelines.report.published import published
from pipelines.report.text import page, write_file
from pipelines.runs.derived import opened_run

METHOD, DEPTH, PREFERRED_ORACLE = "augtree", 2, "[256]"
AGREEMENTS = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7)  # tried
MOST_LOST = 0.02  # of the return on the pruning episodes; the thesis's policy lost 1 %
DIGITS = 2


def write_figure_4_7(
    runs: pd.DataFrame, budget: str, load_config: Callable[[Path], RunConfig], results_dir: Path
) -> list[Path]:
    """Write the two programs with their returns and a picture of the simpler one under `results_dir/figures`.

    The run is the one with the best selection return, of those with an oracle of 256 units where there are any. As in
    the thesis the tests below the root are refitted and the root is rounded. States, and the returns that say how far
    to go, are those of the run's prune stream; no choice sees an episode that is reported. The return of the original
    is the one that the run recorded; all others are played. The arguments are those of `write_report`.
    """
    run = _chosen(imitating_trees(runs, budget), results_dir)
    run_dir = results_dir / "runs" / run.run
    config = load_config(run_dir)
    with opened_run(config, run_dir, "imitate") as whole:
        tree = otr.load(whole / "imitate" / "tree")
    if not isinstance(tree, otr.ObliqueTree):
        raise PipelineError(f"{run_dir}: its tree is held as patterns, which cannot be simplified")
    pruning = part_of(config, PlaysPruning)
    played = play_pruning(tree.predict, pruning)
    agreement, simplified = _simplest(tree, played, pruning)
    returns = play_evaluation(simplified.tree.predict, part_of(config, PlaysEvaluation)).returns

    names: dict[str, Any] = {
        "feature_names": feature_names(config.env, tree.n_inputs),
        "output_names": action_names(config.env, tree.n_outputs),
    }
    text = page(
        "figure_4_7.txt",
        run=run.run,
        oracle=run.oracle,
        before=_program(tree, names, "augtree", run.return_mean, run.return_std, run.n_episodes),
        after=_program(
            simplified.tree, names, "augtree-fig4.7-simplified", returns.mean(), returns.std(), len(returns)
        ),
        n_states=len(played.states),
        n_episodes=config.prune.n_episodes,
        agreement=agreement,
        tried=", ".join(f"{share:.0%}" for share in AGREEMENTS),
        most_lost=MOST_LOST,
        digits=DIGITS,
        tests="\n".join(map(_test_text, simplified.tests)),
    )
    figure = otr.draw_tree(
        simplified.tree,
        **names,
        max_terms=tree.n_inputs,
        states=played.states,
        title=f"AugTree on the lander, simplified: return {returns.mean():.1f}",
    )
    path = write_file(results_dir / "figures" / "figure_4_7.txt", text)
    otr.save_picture(figure, path.with_suffix(".png"))
    return [path, path.with_suffix(".png")]


COMMAND = ("+experiment=figure_4_6", "budget=quick", f"method={METHOD}", f"depth={DEPTH}")  # makes such a run


def _chosen(trees: pd.DataFrame, results_dir: Path) -> Any:
    """Return the row of the finished run with the best selection return of its tree."""
    finished = trees[(trees["method"] == METHOD) & (trees["depth"] == DEPTH)]
    if finished.empty:
        raise MissingInputError(
            f"{results_dir}: no AugTree of depth 2 has been run on the lander.\n"
            f"Run: {command_text('otr-run', COMMAND, results_dir)}"
        )
    preferred = finished[finished["oracle"] == PREFERRED_ORACLE]
    candidates = (finished if preferred.empty else preferred).itertuples()
    return max(candidates, key=lambda run: selection_return(results_dir / "runs" / run.run))


def selection_return(run_dir: Path) -> float:
    """Return the return of a run's tree on the episodes it was chosen by."""
    rows = read_csv(run_dir / "imitate" / "iterates.csv")
    return next(float(row["selection_mean"]) for row in rows if row["chosen"] == "True")


def _simplest(tree: otr.ObliqueTree, played: Rollout, config: PlaysPruning) -> tuple[float, RefittedTree]:
    """Return the loosest agreement that almost keeps the pruning episodes' return, else the tightest, and its tree."""
    least = played.returns.mean() - MOST_LOST * abs(played.returns.mean())
    nodes = range(1, tree.n_nodes)
    for agreement in reversed(AGREEMENTS):
        simplified = refit_tests(tree, played.states, agreement=agreement, digits=DIGITS, nodes=nodes)
        if play_pruning(simplified.tree.predict, config).mean_return >= least:
            break
    return agreement, simplified


def _program(
    tree: otr.ObliqueTree, names: dict[str, Any], method: str, mean: float, std: float, n_episodes: int
) -> str:
    """Return a tree's return, the thesis's under that method, and the tree as a program."""
    thesis = published()["text", "lunarlander", method, "2"].mean
    program = textwrap.indent(otr.to_text(tree, **names, precision=4).rstrip("\n"), "    ")
    return f"return {mean:.1f} ± {std:.1f} over {n_episodes} episodes (thesis: {thesis})\n\n{program}"


def _test_text(test: RefittedTest) -> str:
    return (
        f"test {test.node}: {test.change}, {test.n_coefficients_before} inputs to {test.n_coefficients}, "
        f"{test.n_left:,} states to the left and {test.n_right:,} to the right, at least {test.agreement:.1%} of "
        f"either still go there"
    )
