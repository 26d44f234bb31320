"""Stage polish: the numbers of a finished policy improved on its return by direct search."""

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

import otr
from otr.control.search.polish import PolishReport
from pipelines.config.run import RunConfig
from pipelines.engine.console import duration
from pipelines.engine.seeding import episode_seeds, stream_seed
from pipelines.engine.stage import Stage, picked
from pipelines.engine.store import exists, write_csv, write_files, write_json
from pipelines.play.actor_files import actor_files, load_actor
from pipelines.play.environments import episode_limit
from pipelines.stages.evaluate import EPISODE_COLUMNS, episode_rows
from pipelines.stages.evaluation_episodes import episodes_version, has_numpy_plant, moments, play_each
from pipelines.stages.map import map_actor
from pipelines.stages.printed_programs import and_names, write_program
from pipelines.stages.prune import load_tree, prune
from pipelines.training.search.episodes import SearchEpisodes
from pipelines.training.search.policy_search import search_settings

Policy = TypeVar("Policy", otr.ObliqueTree, otr.ReluNetwork)

ANNOUNCE_S = 10.0
LONG_POLISH_S = 60.0
# Environment steps of the search per second on one core, measured; in numpy with the batches of conf/env
NUMPY_STEPS_PER_S = {"pendulum": 4_000_000.0, "mountaincar": 300_000.0}
STEPS_PER_S = {"lunarlander": 18_000.0, "halfcheetah": 18_000.0, "swimmer": 14_000.0, "ant": 3_500.0}
OTHER_STEPS_PER_S = 8_000.0
SHARE_PLAYED = 0.5  # of an episode's longest length
CANDIDATE_COLUMNS = ("iteration", "selection_mean", "n_selection_episodes")


def polish(inputs: Mapping[str, Path], config: RunConfig, out: Path) -> None:
    """Search, and write the polished tree, `program.txt`, `candidates.csv`, `episodes.csv` and `report.json`.

    Of a mapped tree the network's numbers are searched, unless `polishing.numbers=tree`: then `out` has the actor's
    files too, and the tree is the new network's, pruned as the stage prune does. Of any other the pruned tree's are; a
    PID policy's tree is the one with constant gains, whose leaves are affine. `episodes.csv` has the evaluation
    episodes of the network or tree that was searched.
    """
    actor = config.method.actor_stage
    if config.polishes_network:
        network = load_actor(inputs[actor])
        polished: Any = search(network, config, "polish")
        write_files(actor_files(polished.policy), out)
        with TemporaryDirectory(prefix="otr-") as full:
            map_actor({actor: out}, config, Path(full))
            prune({actor: out, "map": Path(full)}, config, out)
        before: Any = network
    else:
        before = load_tree(inputs["prune"])
        polished = search(before, config, "polish")
        otr.save(polished.policy, out / "tree")
        write_program(polished.policy, config.env, out)
    write_csv(out / "candidates.csv", polished.candidates, CANDIDATE_COLUMNS)
    tree: Any = otr.load(out / "tree")
    policies = {"before": before, "after": polished.policy, "pruned": tree}
    played = play_each(policies, config)
    write_csv(out / "episodes.csv", episode_rows(played["after"]), EPISODE_COLUMNS)
    write_json(
        out / "report.json",
        {
            "numbers": "network" if config.polishes_network else "tree",
            "free": config.polishing.free,
            **polished.report,
            "n_leaves": tree.n_leaves,
            "depth": tree.depth,
            "n_episodes": config.evaluate.n_episodes,
            **moments(played["before"], "_before"),
            **moments(played["after"]),
            **moments(played["pruned"], "_pruned"),
        },
    )


@dataclass(frozen=True)
class Polished:
    """A policy after `search`, what the report says of it, and the rows of its candidates."""

    policy: Any
    report: dict[str, Any]
    candidates: list[dict[str, Any]]


def search(policy: Policy, config: RunConfig, purpose: str) -> Polished:
    """Polish a policy on its return in the run's environment; each purpose has directions and episodes of its own."""
    polishing, began = config.polishing, time.process_time()
    index = ("polish", "simplify").index(purpose)
    reports: list[PolishReport] = []
    announced = time.monotonic()

    def announce(report: PolishReport) -> None:
        nonlocal announced
        reports.append(report)
        if time.monotonic() - announced >= ANNOUNCE_S:
            announced = time.monotonic()
            (_, before), (iteration, now) = report.candidates[0], report.candidates[-1]
            print(
                f"{purpose}: iteration {iteration} of {report.n_iterations}, return {now:.1f} on the selection "
                f"episodes, {before:.1f} before",
                flush=True,
            )

    with closing(SearchEpisodes(config.env, environments(config))) as episodes:
        seeds = np.array([episode_seeds(config.seed, "prune", config.prune.n_episodes)])
        visited = episodes.play([policy], seeds, keep_states=True)
        vectors_steps = 2 * polishing.n_directions * polishing.n_episodes * visited.lengths.mean()
        n_steps = 0

        def evaluate(policies: Sequence[Any], seeds: np.ndarray) -> np.ndarray:
            nonlocal n_steps
            played = episodes.play(policies, seeds)
            n_steps += int(played.lengths.sum())
            return played.returns

        polished = otr.polish(
            policy,
            evaluate,
            states=visited.states,
            n_iterations=max(1, round(polishing.steps / vectors_steps)),
            settings=search_settings(config.polishing),
            n_episodes=polishing.n_episodes,
            common_starts="all" if polishing.common_starts == "all" else "pair",
            n_selection_episodes=polishing.n_selection_episodes,
            n_candidates=polishing.n_candidates,
            free=polishing.free and purpose == "polish",  # a shorter program stays as short
            seed=stream_seed(config.seed, "polish", index),
            report=announce,
        )
    cpu_seconds = round(time.process_time() - began, 3)
    return Polished(polished, _told(reports[-1], config) | {"n_steps": n_steps, "cpu_seconds": cpu_seconds},
                    [{"iteration": iteration, "selection_mean": mean,
                      "n_selection_episodes": polishing.n_selection_episodes}
                     for iteration, mean in reports[-1].candidates])  # fmt: skip


def environments(config: RunConfig) -> str:
    """Return who computes the environments of a polish."""
    return config.polishing.environments or ("numpy" if has_numpy_plant(config.env) else "gymnasium")


def estimated_seconds(config: RunConfig) -> float:
    """Return the likely time of the search on one core, its selection and confirmation episodes included."""
    polishing = config.polishing
    n_chosen = (polishing.n_candidates + 3) * polishing.n_selection_episodes
    longest = episode_limit(config.env)
    table = NUMPY_STEPS_PER_S if environments(config) == "numpy" else STEPS_PER_S
    rate = table.get(config.env.task, OTHER_STEPS_PER_S)
    return (polishing.steps + n_chosen * longest * SHARE_PLAYED) / rate


def announce_polish(config: RunConfig) -> None:
    """Print the likely time of a long polish."""
    seconds = estimated_seconds(config)
    if seconds >= LONG_POLISH_S:
        print(
            f"polish: a search of {config.polishing.steps:,} steps, about {duration(seconds)} on one core; one that is "
            "stopped begins anew",
            flush=True,
        )


def load_searched(folder: Path) -> otr.ObliqueTree | otr.ReluNetwork:
    """Return what a stage polish has searched, the network or the tree, as it came out."""
    return load_actor(folder) if exists(folder / "actor.json") else load_tree(folder)


def _told(report: PolishReport, config: RunConfig) -> dict[str, Any]:
    """Return what the report of the search says, for people."""
    iteration, best = max(report.candidates, key=lambda candidate: (candidate[1], -candidate[0]))
    before, after = report.confirmation or (None, None)
    return {
        "kept": report.kept,
        "n_numbers": report.n_numbers,
        "n_iterations": report.n_iterations,
        "best_iteration": iteration,
        "n_selection_episodes": config.polishing.n_selection_episodes,
        "selection_return_before": report.candidates[0][1],
        "selection_return": best,
        "confirmation_return_before": before,
        "confirmation_return": after,
        "n_episodes_played": report.n_played,
    }


# Its inputs depend on the method: `pipelines.stages.table.stages_of` sets them.
POLISH_SETTINGS = picked(
    env="env",
    seed="seed",
    polishing="polishing",
    max_leaves="map.max_leaves",
    prune="prune",
    evaluate="evaluate",
)
POLISH = Stage("polish", version=episodes_version, inputs=(), settings=and_names(POLISH_SETTINGS), run=polish)
