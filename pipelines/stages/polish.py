"""Stage polish: the numbers of a finished policy improved on its return, by direct search or by an oracle's critics."""

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

import otr
from otr.control.search.polish import PolishReport
from pipelines.config.method import MethodConfig
from pipelines.config.stages import MapConfig, PolishingConfig
from pipelines.engine.archive import MANIFEST
from pipelines.engine.console import duration
from pipelines.engine.seeding import episode_seeds, stream_seed, stream_seeds
from pipelines.engine.stage import Inputs, Stage, part_of, picked
from pipelines.engine.store import exists, read_json, write_csv, write_files, write_json
from pipelines.errors import ConfigError
from pipelines.play.actor_files import actor_files, load_actor, load_oracle_network
from pipelines.play.environments import is_discrete, make_env
from pipelines.play.episodes import (
    Player,
    PlaysEvaluation,
    PlaysPruning,
    episodes_version,
    moments,
    play_each,
    playing_seconds,
)
from pipelines.play.printed_programs import and_names, write_program
from pipelines.play.vector_envs import check_environments, fastest_environments, make_vector_env
from pipelines.stages.evaluate import EPISODE_COLUMNS, episode_rows
from pipelines.stages.map import MapSettings, map_actor
from pipelines.stages.prune import PruneSettings, load_tree, prune
from pipelines.training.critics import CRITICS, load_critics

Policy = TypeVar("Policy", otr.ObliqueTree, otr.ReluNetwork)

ANNOUNCE_S = 10.0
LONG_POLISH_S = 60.0
UPDATES_PER_S = 250.0  # of a small actor and its critics, a step of the environment each
LEARNING_ELEMENT = 2  # of the stream "polish"; 0 and 1 are those of searches
CANDIDATE_COLUMNS = ("iteration", "selection_mean", "n_selection_episodes")


@dataclass(frozen=True)
class SearchedSettings(PlaysPruning, PlaysEvaluation):
    """What a search over a policy's numbers reads of a run's configuration."""

    method: MethodConfig
    polishing: PolishingConfig


@dataclass(frozen=True)
class PolishStageSettings(SearchedSettings):
    """What the stage reads of a run's configuration."""

    map: MapConfig
    polishes_network: bool
    has_oracle: bool
    has_critics: bool
    actor_folder: str
    folder: str
    results_dir: str


def polish(inputs: Inputs, settings: PolishStageSettings, out: Path) -> None:
    """Improve, and write the polished tree, `program.txt`, `candidates.csv`, `episodes.csv` and `report.json`.

    Of a mapped tree the network's numbers move, unless `polishing.numbers=tree`: then `out` has the actor's
    files too, and the tree is the new network's, pruned as the stage prune does. Of any other the pruned tree's are; a
    PID policy's tree is the one with constant gains, whose leaves are affine. `episodes.csv` has the evaluation
    episodes of the network or tree that was polished.
    """
    actor = settings.method.actor_stage
    improved = improve_by_critic if polishes_by(settings) == "critic" else partial(search, purpose="polish")
    if settings.polishes_network:
        network = load_actor(inputs[actor])
        polished: Any = improved(network, settings)
        write_files(actor_files(polished.policy), out)
        with TemporaryDirectory(prefix="otr-") as full:
            map_actor({actor: out}, part_of(settings, MapSettings), Path(full))
            prune({actor: out, "map": Path(full)}, part_of(settings, PruneSettings), out)
        before: Any = network
    else:
        before = load_tree(inputs["prune"])
        polished = improved(before, settings)
        otr.save(polished.policy, out / "tree")
        write_program(polished.policy, settings.env, out)
    write_csv(out / "candidates.csv", polished.candidates, CANDIDATE_COLUMNS)
    tree: Any = otr.load(out / "tree")
    policies = {"before": before, "after": polished.policy, "pruned": tree}
    played = play_each(policies, settings)
    write_csv(out / "episodes.csv", episode_rows(played["after"]), EPISODE_COLUMNS)
    write_json(
        out / "report.json",
        {
            "numbers": "network" if settings.polishes_network else "tree",
            "free": settings.polishing.free,
            **polished.report,
            "n_leaves": tree.n_leaves,
            "depth": tree.depth,
            "n_episodes": settings.evaluate.n_episodes,
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


def search(policy: Policy, settings: SearchedSettings, purpose: str) -> Polished:
    """Polish a policy on its return in the run's environment; each purpose has directions and episodes of its own."""
    polishing, account = settings.polishing, _Account(purpose)
    index = ("polish", "simplify").index(purpose)
    with closing(Player(settings.env, environments(settings))) as player:
        seeds = np.array([episode_seeds(settings.seed, "prune", settings.prune.n_episodes)])
        visited = player.play([policy], seeds, keep_states=True)
        vectors_steps = 2 * polishing.n_directions * polishing.n_episodes * visited.lengths.mean()
        polished = otr.polish(
            policy,
            player.returns,
            states=visited.states,
            n_iterations=max(1, round(polishing.steps / vectors_steps)),
            settings=polishing,
            scale=polishing.scale,
            n_episodes=polishing.n_episodes,
            common_starts=polishing.common_starts,
            n_selection_episodes=polishing.n_selection_episodes,
            n_candidates=polishing.n_candidates,
            free=polishing.free and purpose == "polish",  # a shorter program stays as short
            tied=settings.method.ties_repeats,
            seed=stream_seed(settings.seed, "polish", index),
            report=account.announce,
        )
    account.n_steps = player.n_steps - int(visited.lengths.sum())
    return account.polished(polished, settings, **account.size(settings))


def improve_by_critic(policy: Any, settings: PolishStageSettings) -> Polished:
    """Polish a policy by the critics of the actor that it was made from, with the soft actor-critic.

    Raises:
        PipelineError: there are no critics.
        ConfigError: critics improve no policy of this head.
    """
    from otr.control.critic_polish.learner import polish_by_critics  # imports torch

    polishing, account, folder = settings.polishing, _Account("polish"), critics_folder(settings)
    critics, where = load_critics(folder), environments(settings)
    if not isinstance(policy.head, otr.ClipBox | otr.TanhBox):
        raise ConfigError(
            f"polishing.by=critic improves policies whose actions tanh or a clip leads into their box, not "
            f"{type(policy.head).__name__}; use polishing.by=search"
        )
    oracle = load_oracle_network(folder) if exists(folder / "actor.json") else None
    with closing(Player(settings.env, where)) as player, closing(make_vector_env(settings.env, where)) as envs:
        polished = polish_by_critics(
            policy, player.returns, envs, critics, oracle,
            seeds=stream_seeds(3, settings.seed, "polish", LEARNING_ELEMENT), settings=polishing.critic,
            n_selection_episodes=polishing.n_selection_episodes, n_candidates=polishing.n_candidates,
            free=polishing.free, tied=settings.method.ties_repeats, seed=stream_seed(settings.seed, "polish", 0),
            report=account.announce, say=lambda text: print(f"polish: {text}", flush=True),
        )  # fmt: skip
    critic = polishing.critic
    account.n_steps = player.n_steps + critic.refill_steps + critic.steps
    own = {"n_refill_steps": critic.refill_steps, "n_learning_steps": critic.steps}
    return account.polished(polished, settings, by="critic", **own, candidate_seconds=account.candidate_seconds)


class _Account:
    """The cost and the result of a polish so far."""

    def __init__(self, purpose: str) -> None:
        self._purpose, self._began, self._announced = purpose, time.process_time(), time.monotonic()
        self._reports: list[PolishReport] = []
        self._seconds: list[float] = []  # of CPU, at each candidate
        self.n_steps = 0

    def announce(self, report: PolishReport) -> None:
        """Keep what is reported; print it every few seconds, and what came out."""
        is_last = bool(self._reports) and report.candidates == self._reports[-1].candidates
        self._reports.append(report)
        self._seconds.append(round(time.process_time() - self._began, 3))
        (_, before), (iteration, now) = report.candidates[0], report.candidates[-1]
        if report.confirmation is not None:
            before, now = report.confirmation
            result = f"the best {'is kept' if report.kept else 'is not kept'}, return {now:.1f} on other episodes"
        elif is_last:
            result = "nothing is kept, no candidate has a higher return on the selection episodes"
        elif time.monotonic() - self._announced >= ANNOUNCE_S:
            result = f"iteration {iteration:,} of {report.n_iterations:,}, return {now:.1f} on the selection episodes"
        else:
            return
        self._announced = time.monotonic()
        print(f"{self._purpose}: {result}, {before:.1f} before", flush=True)

    @property
    def candidate_seconds(self) -> list[float]:
        """The seconds of CPU at which each candidate had played, the original first."""
        return self._seconds[: len(self._reports[-1].candidates)]

    def size(self, settings: SearchedSettings) -> dict[str, float]:
        """Return the size of a scale by sensitivity."""
        return {} if settings.polishing.scale == "uniform" else {"size": self._reports[-1].size}

    def polished(self, policy: Any, settings: SearchedSettings, **about: Any) -> Polished:
        """Return the policy with its report."""
        report, n_selection = self._reports[-1], settings.polishing.n_selection_episodes
        spent = {"n_steps": self.n_steps, "cpu_seconds": round(time.process_time() - self._began, 3)}
        rows = [
            {"iteration": iteration, "selection_mean": mean, "n_selection_episodes": n_selection}
            for iteration, mean in report.candidates
        ]
        return Polished(policy, about | _told(report, settings) | spent, rows)


def critics_folder(settings: PolishStageSettings) -> Path:
    """Return where the critics of a run are: with its oracle, or with its own actor."""
    return Path(settings.results_dir) / settings.actor_folder


def needed_critics(settings: PolishStageSettings) -> tuple[str, ...]:
    """Return the file of critics where these are to polish a run."""
    is_polished = exists(Path(settings.results_dir) / settings.folder / "polish" / MANIFEST)
    return (CRITICS,) if not is_polished and polishes_by(settings) == "critic" else ()


def polishes_by(settings: PolishStageSettings) -> str:
    """Return what polishes a run: as it is set, else "critic" where its oracle was kept with critics, else "search".

    The manifest of the oracle says so, whether or not the file still exists: results from before critics were
    kept, and what was polished then, stay what they are.
    """
    if settings.polishing.by is not None:
        return settings.polishing.by
    manifest = _manifest(settings)
    has_critics = settings.has_oracle and exists(manifest) and CRITICS in read_json(manifest)["outputs"]
    return "critic" if has_critics else "search"


def will_polish_by(settings: PolishStageSettings) -> str:
    """Return what polishes a run once its oracle is there."""
    is_to_come = settings.polishing.by is None and settings.has_oracle and not exists(_manifest(settings))
    return "critic" if is_to_come and settings.has_critics else polishes_by(settings)


def check_polish(settings: PolishStageSettings) -> None:
    """Raise ConfigError where a run's polish cannot be done as it is set."""
    check_environments(settings.env, environments(settings))
    if settings.polishing.scale == "uniform":
        return
    if will_polish_by(settings) == "critic":
        raise ConfigError(
            "polishing.scale=sensitivity is of a search, and critics polish this run: give one of "
            "polishing.by=search and polishing.scale=uniform"
        )
    if is_discrete(make_env(settings.env)):
        raise ConfigError(
            f"polishing.scale=sensitivity is for continuous actions, and those of {settings.env.id} are labels; "
            "leave it out"
        )


def _manifest(settings: PolishStageSettings) -> Path:
    """Return the manifest of the stage that keeps a run's critics, if any."""
    return critics_folder(settings) / MANIFEST


def environments(settings: SearchedSettings) -> str:
    """Return who computes the environments of a polish."""
    return settings.polishing.environments or fastest_environments(settings.env)


def estimated_seconds(settings: PolishStageSettings) -> float:
    """Return the likely time of a polish on one core, its selection and confirmation episodes included."""
    polishing = settings.polishing
    n_chosen = (polishing.n_candidates + 3) * polishing.n_selection_episodes
    by_critic, critic = will_polish_by(settings) == "critic", polishing.critic
    n_steps = critic.refill_steps if by_critic else polishing.steps
    seconds = playing_seconds(settings.env, n_chosen, environments(settings), n_steps=n_steps)
    return seconds + (critic.steps / UPDATES_PER_S if by_critic else 0.0)


def announce_polish(runs: Sequence[PolishStageSettings]) -> None:
    """Print the likely time of a long polish."""
    (settings,) = runs
    seconds = estimated_seconds(settings)
    if seconds >= LONG_POLISH_S:
        by_critic = polishes_by(settings) == "critic"
        what = "critics in" if by_critic else "a search of"
        n_steps = settings.polishing.critic.steps if by_critic else settings.polishing.steps
        print(
            f"polish: {what} {n_steps:,} steps, about {duration(seconds)} on one core; if stopped, it starts over",
            flush=True,
        )


def load_searched(folder: Path) -> otr.ObliqueTree | otr.ReluNetwork:
    """Return what a stage polish has searched, the network or the tree, as polished."""
    return load_actor(folder) if exists(folder / "actor.json") else load_tree(folder)


def _told(report: PolishReport, settings: SearchedSettings) -> dict[str, Any]:
    """Return the report of the search as a readable text."""
    iteration, best = max(report.candidates, key=lambda candidate: (candidate[1], -candidate[0]))
    before, after = report.confirmation or (None, None)
    return {
        "kept": report.kept,
        "n_numbers": report.n_numbers,
        "n_iterations": report.n_iterations,
        "best_iteration": iteration,
        "n_selection_episodes": settings.polishing.n_selection_episodes,
        "selection_return_before": report.candidates[0][1],
        "selection_return": best,
        "confirmation_return_before": before,
        "confirmation_return": after,
        "n_episodes_played": report.n_played,
    }


_BY_SEARCH = picked(
    env="env", seed="seed", polishing="polishing", max_leaves="map.max_leaves", prune="prune",
    evaluate="evaluate"
)  # fmt: skip


def polish_keys(settings: PolishStageSettings) -> dict[str, Any]:
    """Return what decides a polish; its inputs, made from the actor that has the critics, decide these."""
    keyed = _BY_SEARCH(settings)
    if polishes_by(settings) == "critic":
        keyed["polishing"] = settings.polishing.settings_by_critic(of_network=settings.polishes_network)
    return keyed


# Its inputs depend on the method: `pipelines.runs.stage_table.stages_of` sets them.
POLISH = Stage(
    "polish", version=episodes_version, inputs=(), keyed=and_names(polish_keys), run=polish,
    settings=PolishStageSettings, announce=announce_polish, seconds_left=estimated_seconds, needs=needed_critics,
)  # fmt: skip
