"""Finished runs: their folders, the commands that made them, and their trees."""

import difflib
import os
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np

import otr
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.methods import EXTRA_STAGES, ProgramConfig
from pipelines.config.run import RunConfig
from pipelines.engine.archive import MANIFEST, read_manifest, require_whole, verified_manifest
from pipelines.engine.command_text import command_text, place_of
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.store import CONFIG, exists, read_bytes, read_json
from pipelines.errors import ConfigError, MissingInputError, PipelineError, check_choice
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import play_seeds
from pipelines.runs.derived import opened_run

TREES = ("pruned", "full", "minimal", "polished", "simplified", "constant_gains", "compact", "polished_compact")
COMPACT = ("compact", "polished_compact")  # networks, which C alone can hold


def check_run(run: str) -> None:
    """Raise ConfigError where no run is named."""
    if not run:
        raise ConfigError("which run? Add run=FOLDER, such as run=hopper/otr/depth-6/quick/seed-0")


def find_run(run: str, results_dir: str) -> Path:
    """Return a run's folder: as given, or below results_dir, or below results_dir/runs; errors name what exists."""
    check_run(run)
    folder = find_folder(run, Path(results_dir))
    if folder is None:
        raise ConfigError(_no_such_run(run, Path(results_dir) / "runs"))
    folder = with_its_names(folder)
    if not exists(folder / CONFIG):
        command = run_command(folder)
        how = f"the run there did not come to its end\nRun: {command}" if command else "it is not the folder of a run"
        raise PipelineError(f"{folder} holds no config.yaml: {how}")
    if re.search(r"^data:", read_bytes(folder / CONFIG).decode(errors="replace"), re.M):
        raise PipelineError(
            f"{folder} is a fit of otr-fit, not a run of otr-run; its trees are read and written in Python: "
            'otr.to_c(otr.load("PATH"))'
        )
    return folder


def find_folder(run: str, results_dir: Path) -> Path | None:
    """Return the first folder of that name here, below results_dir, or below results_dir/runs; None without one."""
    tried = (Path(run), results_dir / run, results_dir / "runs" / run)
    return next((path for path in tried if path.is_dir()), None)


def with_its_names(folder: Path) -> Path:
    """Return a run's folder by a path with all its names, ENV/METHOD/DEPTH/BUDGET/SEED, from any working directory."""
    return folder if len(folder.parts) >= 5 and ".." not in folder.parts else Path(os.path.normpath(folder.absolute()))


def run_command(folder: Path) -> str | None:
    """Return the otr-run command that makes a run's folder, as far as its path shows it; None where it does not."""
    results_dir = results_of(folder)
    if results_dir is None:
        return None
    env, method, depth, budget, seed = folder.parts[-5:]
    if not (re.fullmatch(r"depth-[\d-]+", depth) and re.fullmatch(r"seed-\d+(~[0-9a-f]+)?", seed)):
        return None
    widths = depth.removeprefix("depth-").split("-")
    overrides = [f"env={env}", f"depth={widths[0]}" if len(widths) == 1 else f"depth=[{','.join(widths)}]"]
    overrides += [] if method == "otr" else [f"method={method}"]
    name, *others = budget.split("-")
    overrides += [f"budget={name}", *(f"algo={other}" if other == "ars" else f"trainer={other}" for other in others)]
    number, _, digest = seed.removeprefix("seed-").partition("~")
    overrides.append(f"seed={number}")
    settings = " and the settings that made the digest ~" + digest if digest else ""
    return f"{command_text('otr-run', overrides, results_dir)}{settings}"


def results_of(folder: Path) -> Path | None:
    """Return the folder of results that a run's folder is in, by `runs` above its five names; None if it was moved."""
    parents = folder.absolute().parents
    return parents[5] if len(parents) > 5 and parents[4].name == "runs" else None


def command_of(folder: Path, stage: str) -> str:
    """Return the command that made a run: where its path does not show it, the one that a stage recorded.

    A path shows it for an environment of conf/env and settings without a digest.
    """
    command = run_command(folder)
    recorded = read_manifest(folder / stage)["command"] if exists(folder / stage / MANIFEST) else ""
    if command and "~" not in folder.name and (CONF_DIR / "env" / f"{folder.parts[-5]}.yaml").is_file():
        return command
    if recorded.startswith("otr-run "):  # it names no results_dir itself
        results_dir = results_of(folder)
        return " ".join([recorded, *map(shlex.quote, place_of(results_dir) if results_dir else ())])
    return command or "the command that made the run"


def visited_states(run: RunConfig, policy: otr.ObliqueTree, n_episodes: int = 5) -> np.ndarray:
    """Return the states (n, d) that a policy visits in a few of the episodes that the run was pruned with."""
    seeds = episode_seeds(run.seed, "prune", min(n_episodes, run.prune.n_episodes))
    return play_seeds(policy.predict, run.env, seeds, keep_states=True, n_workers=1).states


def title_of(run: RunConfig, tree: str) -> str:
    """Return a title for a picture of one of a run's trees, or of a program."""
    if isinstance(run.method, ProgramConfig):
        return f"{run.env.name}, program {Path(run.method.program).name}"
    depth = ", ".join(map(str, run.hidden_widths)) or "0"
    return f"{run.env.name}, {run.method.name}, depth {depth}: {tree.replace('_', ' ')} tree"


def tree_of(form: str, run: RunConfig, folder: Path) -> Any:
    """Return one of a run's trees by its name in TREES; held as patterns where it is, those of COMPACT as networks.

    Raises:
        ConfigError: the run's method has no such tree.
        MissingInputError: the stage that makes it is not finished; names the command.
        PipelineError: a file was changed.
    """
    check_choice("tree", form, TREES)
    method = run.method.name
    if form in COMPACT and not run.method.is_mapped:
        raise ConfigError(f"tree={form}: a tree of method={method} stands for no network; use tree=full")
    if form == "constant_gains" and form not in run.method.forms:
        raise ConfigError(f"tree=constant_gains: gains are of method=pid, not of method={method}; use tree=pruned")
    stages = {
        "pruned": "prune",
        "constant_gains": "prune",
        "full": run.method.tree_stage,
        "minimal": "certify",
        "polished": "polish",
        "polished_compact": "polish",
        "simplified": "simplify",
    }
    stage = stages.get(form, run.method.actor_stage)
    if not exists(folder / stage / MANIFEST):
        extra = f" {stage}=true" if stage in EXTRA_STAGES else ""
        raise MissingInputError(
            f"{folder}: stage {stage}, which makes tree={form}, is not finished there\nRun: "
            f"{command_of(folder, run.method.actor_stage)}{extra}"
        )
    verified_manifest(folder / stage)
    require_whole(folder / stage)
    if form in COMPACT:
        if not exists(folder / stage / "actor.json"):
            raise ConfigError(f"tree={form}: the polish moved the tree's numbers, not a network's; use tree=polished")
        return load_actor(folder / stage)
    if form == "minimal" and not exists(folder / stage / "tree.json"):
        reason = read_json(folder / stage / "report.json").get("reason")
        raise PipelineError(f"{folder}: there is no minimal tree, as stage certify gave up: {reason}")
    with opened_run(run, folder, stage) as whole:
        return otr.load(whole / stage / ("constant_gains" if form == "constant_gains" else "tree"))


def _no_such_run(run: str, runs: Path) -> str:
    there = [path.relative_to(runs).as_posix() for path in runs.glob("*/*/depth-*/*/seed-*")]
    wanted = re.sub(r"^.*runs/", "", Path(run).as_posix())
    near = difflib.get_close_matches(wanted, there, n=3, cutoff=0.6)
    lines = [f"run={run}: there is no such folder, here or below {runs}."]
    lines += [f"Did you mean {' or '.join(near)}?"] if near else []
    command = run_command(runs / wanted)
    lines.append(f"To make it: {command}" if command else "A run's folder is runs/ENV/METHOD/depth-D/BUDGET/seed-S.")
    return "\n".join(lines)
