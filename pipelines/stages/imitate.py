"""Stage imitate: a tree or a small network that imitates the oracle, under DAgger: the best of its iterates.

A killed run goes on from its last whole round; its working files are kept with the checkpoints until the stage is done.
"""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import otr
from otr.control.dagger.loop import DaggerProgress, run_dagger
from otr.control.imitate import tree_fit
from otr.control.settings import DaggerSettings, FitSettings
from otr.control.spaces import of_two_outputs
from pipelines.config.env import EnvConfig
from pipelines.config.methods import ImitatingConfig
from pipelines.config.setting import keyed_settings
from pipelines.engine.archive import verified_manifest
from pipelines.engine.digests import digest
from pipelines.engine.seeding import episode_seeds, stream
from pipelines.engine.stage import Inputs, Stage
from pipelines.engine.store import write_csv, write_files, write_json
from pipelines.engine.time_left import time_left
from pipelines.play.actor_files import actor_files
from pipelines.play.episodes import play_seeds, playing_seconds
from pipelines.play.printed_programs import write_program
from pipelines.stages.oracle import load_oracle

STREAM_ELEMENTS = {"oracle": 0, "dagger": 1, "selection": 2, "fit": 3}
ITERATE_COLUMNS = ("round", "n_rows", "rollout_mean", "selection_mean", "n_selection_episodes", "n_leaves", "depth",
                   "seconds", "chosen")  # fmt: skip
REPORT_EVERY = 10  # rounds
VERSION = 1


@dataclass(frozen=True)
class ImitateSettings:
    """What the stage reads of a run's configuration."""

    env: EnvConfig
    method: ImitatingConfig
    depth: Any  # tests on a path, or experts; of a network `hidden_widths`
    hidden_widths: tuple[int, ...]
    imitate: DaggerSettings
    seed: int
    results_dir: str
    side_by_side: bool


def imitate_keys(settings: ImitateSettings) -> dict[str, Any]:
    """Return what decides the tree, given the oracle."""
    return {
        "env": settings.env.settings(),
        "method": keyed_settings(settings.method),
        "depth": settings.depth,
        "imitate": keyed_settings(settings.imitate),
        "seed": settings.seed,
        "feature_names": settings.env.feature_names,
        "action_names": settings.env.action_names,
    }


def working_folder(settings: ImitateSettings, inputs: Inputs) -> Path:
    """Return where the data set and the iterates are while the run is under way."""
    key = digest([VERSION, imitate_keys(settings), verified_manifest(inputs["oracle"])["output_digest"]])
    return Path(settings.results_dir) / "checkpoints" / key[:16]


def imitate(inputs: Inputs, settings: ImitateSettings, out: Path) -> None:
    """Imitate the oracle; write the chosen tree and its program, `iterates.csv` and `report.json`.

    Of a network the actor's files are written in place of the tree, which the stage map makes.
    """
    oracle = of_two_outputs(load_oracle(inputs["oracle"], Path(settings.results_dir)))
    folder = working_folder(settings, inputs)
    assert isinstance(settings.method, FitSettings)
    depth = settings.hidden_widths if settings.method.is_mapped else settings.depth
    fit = tree_fit(settings.method, depth, oracle, folder)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    result = run_dagger(
        oracle,
        fit,
        lambda policy, seeds, keep: play_seeds(policy, settings.env, seeds, keep_states=keep, n_workers=1),
        lambda name, index, n: episode_seeds(settings.seed, "imitate", n, STREAM_ELEMENTS[name], index),
        settings.imitate,
        stream(settings.seed, "imitate", STREAM_ELEMENTS["fit"]),
        folder,
        on_round=lambda progress: _show(progress, settings),
    )
    if isinstance(result.tree, otr.PatternTree):
        write_files(actor_files(result.tree.network), out)
    else:
        otr.save(result.tree, out / "tree")
        write_program(result.tree, settings.env, out)
    chosen = result.iterates[result.round]
    rows = [{**asdict(iterate), "chosen": iterate == chosen} for iterate in result.iterates]
    write_csv(out / "iterates.csv", [{**row, "seconds": round(row["seconds"], 3)} for row in rows], ITERATE_COLUMNS)
    write_json(
        out / "report.json",
        {
            "n_leaves": chosen.n_leaves,
            "depth": chosen.depth,
            "round": result.round,
            "oracle_return": result.oracle_mean,
            "n_rows": chosen.n_rows,
            "n_steps": result.n_steps,
        },
    )


def _show(progress: DaggerProgress, settings: ImitateSettings) -> None:
    """Print a line every few rounds."""
    r, n_rounds = progress.round, progress.n_rounds
    if r % REPORT_EVERY and r != n_rounds:
        return
    job = f"{settings.env.name} {settings.method.name} depth {settings.depth} seed {settings.seed}: "
    prefix = job * settings.side_by_side
    left = time_left((n_rounds - r) * progress.seconds)
    print(
        f"{prefix}imitate: round {r}/{n_rounds}  {progress.n_rows:,} states  return {progress.return_mean:.1f}  "
        f"{progress.n_leaves:,} leaves  about {left}",
        flush=True,
    )


def estimated_seconds(settings: ImitateSettings) -> float:
    """Return the likely time of the imitation on one core, the oracle's training apart."""
    imitation, method = settings.imitate, settings.method
    # Successive halving plays about as much again as its last two candidates do, six times over.
    n_chosen = 6 * imitation.n_choice_episodes
    n_episodes = imitation.n_initial_episodes + (imitation.n_rounds + 1) * imitation.n_episodes + n_chosen
    return playing_seconds(settings.env, n_episodes) + (imitation.n_rounds + 1) * method.fit_s


IMITATE = Stage(
    "imitate",
    VERSION,
    inputs=("oracle",),
    keyed=imitate_keys,
    run=imitate,
    settings=ImitateSettings,
    seconds_left=estimated_seconds,
    checkpoints=working_folder,
)
