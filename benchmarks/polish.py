"""Polish: what it is worth on episodes that nothing was chosen or reported on.

Every run under results/runs that has the stage polish (OTR_RESULTS_DIR for another folder) plays with the policy that
was searched, network or tree, before and after, from the same first states: 1,000 episodes of the lander and the
mountain car, 5,000 of the pendulum, 100 of others. Their seeds are below those that training, selection, confirmation
and pruning draw from, and apart from the reported ones. The pendulum and the mountain car are played in numpy.

An entry a run holds the mean return after against that before; another has the mean of the paired differences against
its standard error, so that the ratio is the gain in standard errors. Runs that differ in the seed alone then have their
mean over seeds, with the standard error that its episodes give it.

Targets, of means over seeds: the lander 262 by AugTree of depth 2 and 270 by OTR of depth 2, the pendulum -148 by OTR
of depth 6, the mountain car 93.0 by OTR of depth 1.
"""

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import otr
from benchmarks.measure import Entry, results_dir
from pipelines.cli.runs import load_config
from pipelines.config.run import RunConfig
from pipelines.engine.seeding import FIRST_STREAM_SEED
from pipelines.engine.store import exists
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import Player, play_seeds
from pipelines.runs.derived import opened_run
from pipelines.stages.polish import POLISH, environments, load_searched, load_tree

N_EPISODES = {"LunarLander-v3": 1_000, "Pendulum-v1": 5_000, "MountainCarContinuous-v0": 1_000}
N_OTHER_EPISODES, N_QUICK_EPISODES = 100, 20
FIRST_SEED = FIRST_STREAM_SEED // 2
# By environment, method and depth: of the mean over seeds.
TARGETS = {
    ("lunarlander", "augtree", "depth-2"): "value >= 262",
    ("lunarlander", "otr", "depth-2"): "value >= 270",
    ("pendulum", "otr", "depth-6"): "value >= -148",
    ("mountaincar", "otr", "depth-1"): "value >= 93.0",
}


@dataclass(frozen=True)
class PolishedRun:
    """A run's returns before and after, (n_episodes,) each, from the same first states; `name` is its folder."""

    name: str
    before: np.ndarray
    after: np.ndarray

    @property
    def group(self) -> str:
        """The folder without the seed: runs of one group differ in that alone."""
        folder, _, seed = self.name.rpartition("/")
        return folder + seed[seed.find("~") :] if "~" in seed else folder

    @property
    def gain(self) -> float:
        """The mean of the paired differences."""
        return float((self.after - self.before).mean())

    @property
    def gain_error(self) -> float:
        """The standard error of the gain."""
        return float((self.after - self.before).std(ddof=1) / math.sqrt(len(self.before)))


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick plays 20 episodes of each run."""
    place = results_dir() / "runs"
    runs = []
    for run_dir in sorted(path.parent for path in place.glob("*/*/depth-*/*/*/summary.json")):
        if exists(run_dir / "polish" / "report.json"):
            run = played_run(run_dir, str(run_dir.relative_to(place)), N_QUICK_EPISODES if quick else None)
            print(f"polish: {run.name}: {run.before.mean():.1f} to {run.after.mean():.1f}", flush=True)
            runs.append(run)
    if not runs:
        print(f"polish: no run under {place} has the stage polish, which otr-run ... polish=true adds", flush=True)
    groups: dict[str, list[PolishedRun]] = {}
    for run in runs:
        groups.setdefault(run.group, []).append(run)
    return [entry for run in runs for entry in _run_entries(run)] + [
        entry for name, group in groups.items() for entry in group_entries(name, group)
    ]


def played_run(run_dir: Path, name: str, n_episodes: int | None = None) -> PolishedRun:
    """Play a run's policy before and after its polish."""
    config = load_config(run_dir, None)
    n_episodes = n_episodes or N_EPISODES.get(config.env.id, N_OTHER_EPISODES)
    first, last = config.evaluate.first_seed, config.evaluate.first_seed + config.evaluate.n_episodes
    if first < FIRST_SEED + n_episodes and last > FIRST_SEED:
        raise ValueError(f"{run_dir} reports the seeds {first} to {last - 1}, which are to be others than {FIRST_SEED}")
    with opened_run(config, run_dir) as whole:
        after: Any = load_searched(whole / "polish")
        is_network = isinstance(after, otr.ReluNetwork)
        before: Any = load_actor(whole / config.method.actor_stage) if is_network else load_tree(whole / "prune")
    return PolishedRun(name, *_returns([before, after], config, range(FIRST_SEED, FIRST_SEED + n_episodes)))


def _returns(policies: Sequence[Any], config: RunConfig, seeds: Sequence[int]) -> np.ndarray:
    """Return the returns (k, m) of policies from the same first states."""
    if environments(POLISH.of(config)) == "numpy":
        with closing(Player(config.env, "numpy")) as episodes:
            return episodes.play(policies, np.tile(seeds, (len(policies), 1))).returns
    return np.array([play_seeds(policy.predict, config.env, seeds).returns for policy in policies])


def _run_entries(run: PolishedRun) -> list[Entry]:
    after, before = float(run.after.mean()), float(run.before.mean())
    return [
        Entry(run.name, after, "return", "before", before, clock=None),
        _gain(run.name, run.gain, run.gain_error, len(run.before)),
    ]


def group_entries(name: str, runs: Sequence[PolishedRun]) -> list[Entry]:
    """Return the entries of the mean over the seeds of a group."""
    env, method, depth, *_ = name.split("/")
    target = None if "~" in name else TARGETS.get((env, method, depth))
    after, before = (float(np.mean([getattr(run, when).mean() for run in runs])) for when in ("after", "before"))
    gain, error = (np.array([getattr(run, what) for run in runs]) for what in ("gain", "gain_error"))
    what = f"{name}, mean of {len(runs)} seed{'s' * (len(runs) > 1)}"
    return [
        Entry(what, after, "return", "before", before, target, clock=None),
        _gain(what, float(gain.mean()), float(np.sqrt((error**2).sum()) / len(runs)), len(runs[0].before)),
    ]


def _gain(name: str, gain: float, error: float, n_episodes: int) -> Entry:
    """Return the entry of a gain; where nothing was kept it is 0, without an error."""
    what = f"{name}: gain, {n_episodes:,} paired episodes"
    peer, peer_value = ("its standard error", error) if error else (None, None)
    return Entry(what, gain, "return", peer, peer_value, clock=None)
