"""The policy of a finished run as a program in another language, with the environment's names."""

import difflib
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np

import otr
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.methods import EXTRA_STAGES, ProgramConfig
from pipelines.config.run import RunConfig
from pipelines.config.setting import Folder, FreeText, OneOf, Range, check_settings
from pipelines.engine.archive import MANIFEST, read_manifest, verified_manifest
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.store import exists, read_json
from pipelines.errors import ConfigError, MissingInputError, PipelineError, did_you_mean
from pipelines.play.actor_files import load_actor
from pipelines.play.rollout import rollout
from pipelines.stages.derived import opened_run
from pipelines.stages.printed_programs import names_of_env

TREES = ("pruned", "full", "minimal", "polished", "simplified", "constant_gains", "compact", "polished_compact")
COMPACT = ("compact", "polished_compact")  # networks, which C alone can hold


@dataclass(frozen=True)
class ExportConfig:
    """What `otr-export` takes; None is the format's own default."""

    run: FreeText
    program: FreeText | None
    env: FreeText | None
    format: FreeText
    tree: FreeText
    out: FreeText | None
    name: FreeText | None
    dtype: Annotated[str | None, OneOf("double", "float")]
    precision: Annotated[int | None, Range(0)]
    results_dir: Folder
    debug: bool

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class Format:
    """A format: its files' suffix, what writes it, and which of the options name, dtype and precision that takes."""

    suffix: str
    write: Callable[..., Any]
    options: tuple[str, ...] = ()
    is_picture: bool = False  # of the tree, with the states that it visits
    is_text: bool = True


def _onnx(*arguments: Any, **options: Any) -> bytes:
    return bytes(otr.to_onnx(*arguments, **options).SerializeToString())


def _drawn(suffix: str, tree: otr.ObliqueTree, **options: Any) -> bytes:
    with TemporaryDirectory(prefix="otr-") as place:
        path = Path(place) / f"tree{suffix}"
        otr.save_picture(otr.draw_tree(tree, **options), path)
        return path.read_bytes()


FORMATS = {
    "text": Format(".txt", otr.to_text, ("precision",)),
    "python": Format(".py", otr.to_python, ("name",)),
    "c": Format(".c", otr.to_c, ("name", "dtype")),
    "structured_text": Format(".st", otr.to_structured_text, ("name",)),
    "latex": Format(".tex", otr.to_latex, ("precision",)),
    "dot": Format(".dot", otr.to_dot, ("precision",)),
    "onnx": Format(".onnx", _onnx, ("name", "dtype"), is_text=False),
    "json": Format(".json", otr.to_json),
    "svg": Format(".svg", otr.to_svg, ("precision",), is_picture=True),
    "png": Format(".png", partial(_drawn, ".png"), ("precision",), is_picture=True, is_text=False),
    "pdf": Format(".pdf", partial(_drawn, ".pdf"), ("precision",), is_picture=True, is_text=False),
}


def check_export(config: ExportConfig) -> None:
    """Raise ConfigError where the request cannot be met, whatever the run."""
    check_policy(config.run, config.program, config.env)
    if config.program and config.tree != "pruned":
        raise ConfigError(f"tree={config.tree}: program={config.program} is one tree; leave tree={config.tree} out")
    if not config.format:
        raise ConfigError(f"which format? Add format=NAME with one of: {', '.join(FORMATS)}")
    _check_name("format", config.format, list(FORMATS))
    _check_name("tree", config.tree, TREES)
    if config.tree in COMPACT and config.format != "c":
        raise ConfigError(f"tree={config.tree}: only format=c writes the network itself, not format={config.format}")
    if not FORMATS[config.format].is_text and config.out is None:
        raise ConfigError(
            f"format={config.format} is no text for a terminal; add out=policy{FORMATS[config.format].suffix}"
        )
    for option in ("name", "dtype", "precision"):
        if getattr(config, option) is not None and option not in FORMATS[config.format].options:
            takes = [name for name, known in FORMATS.items() if option in known.options]
            raise ConfigError(f"{option}={getattr(config, option)}: format={config.format} has none; "
                              f"these have: {', '.join(takes)}")  # fmt: skip


def check_run(run: str) -> None:
    """Raise ConfigError where no run is named."""
    if not run:
        raise ConfigError("which run? Add run=FOLDER, such as run=hopper/otr/depth-6/quick/seed-0")


def check_policy(run: str, program: str | None, env: str | None) -> None:
    """Raise ConfigError unless one policy is named: a run's, or a program with the environment that has its names."""
    if not program:
        check_run(run)
        if env:
            raise ConfigError(f"env={env}: a run has its own environment; leave env={env} out")
    elif run:
        raise ConfigError(f"run={run} and program={program} are two policies; leave one of them out")
    elif not env:
        raise ConfigError(f"program={program}: over which environment's names? Add env=NAME")


def find_run(run: str, results_dir: str) -> Path:
    """Return a run's folder: as given, or below results_dir, or below results_dir/runs; errors name what is there."""
    check_run(run)
    given, runs = Path(run), Path(results_dir) / "runs"
    tried = [given] if given.is_absolute() else [given, Path(results_dir) / given, runs / given]
    folder = next((path for path in tried if path.is_dir()), None)
    if folder is None:
        raise ConfigError(_no_such_run(run, runs))
    if not (folder / "config.yaml").is_file():
        command = run_command(folder)
        how = f"the run there did not come to its end\nRun: {command}" if command else "it is not the folder of a run"
        raise PipelineError(f"{folder} holds no config.yaml: {how}")
    if re.search(r"^data:", (folder / "config.yaml").read_text(encoding="utf-8", errors="replace"), re.M):
        raise PipelineError(
            f"{folder} is a fit of otr-fit, not a run of otr-run; its trees are read and written in Python: "
            'otr.to_c(otr.load("PATH"))'
        )
    return folder


def run_command(folder: Path) -> str | None:
    """Return the otr-run command that makes a run's folder, as far as its path tells; None where it tells nothing."""
    if len(folder.parts) < 5:
        return None
    env, method, depth, budget, seed = folder.parts[-5:]
    if not (re.fullmatch(r"depth-[\d-]+", depth) and re.fullmatch(r"seed-\d+(~[0-9a-f]+)?", seed)):
        return None
    widths = depth.removeprefix("depth-").split("-")
    overrides = [f"env={env}", f"depth={widths[0]}" if len(widths) == 1 else f'"depth=[{",".join(widths)}]"']
    overrides += [] if method == "otr" else [f"method={method}"]
    name, *others = budget.split("-")
    overrides += [f"budget={name}", *(f"algo={other}" if other == "ars" else f"trainer={other}" for other in others)]
    number, _, digest = seed.removeprefix("seed-").partition("~")
    overrides.append(f"seed={number}")
    settings = " and the settings that made the digest ~" + digest if digest else ""
    return f"otr-run {' '.join(overrides)}{place_of(folder)}{settings}"


def place_of(folder: Path) -> str:
    """Return the words that name the results that a run's folder lies in; nothing for `results`, the default."""
    place, here = folder.absolute().parents[4].parent, Path.cwd()
    if place == here / "results":
        return ""
    return f" results_dir={shlex.quote(str(place.relative_to(here) if place.is_relative_to(here) else place))}"


def command_of(folder: Path, stage: str) -> str:
    """Return the command that made a run: where its path does not tell, the one that a stage recorded.

    A path tells it for an environment of conf/env and settings without a digest.
    """
    command = run_command(folder)
    recorded = read_manifest(folder / stage)["command"] if exists(folder / stage / MANIFEST) else ""
    if command and "~" not in folder.name and (CONF_DIR / "env" / f"{folder.parts[-5]}.yaml").is_file():
        return command
    if recorded.startswith("otr-run "):
        return recorded + place_of(folder)  # which names no results_dir itself
    return command or "the command that made the run"


def program_of(config: ExportConfig, run: RunConfig, policy: Any) -> str | bytes:
    """Return a policy as the program that was asked for, as text, or as bytes where the format is not text.

    Raises:
        ConfigError: an option that the format refuses, or a tree that it cannot hold.
        PipelineError: a package is missing.
    """
    chosen = FORMATS[config.format]
    options = {name: getattr(config, name) for name in chosen.options if getattr(config, name) is not None}
    if chosen.is_picture:
        options |= {"states": visited_states(run, policy), "title": title_of(run, config.tree)}
    try:
        written: str | bytes = chosen.write(policy, **names_of_env(policy, run.env), **options)
    except ImportError as error:
        raise PipelineError(str(error)) from error
    except ValueError as error:
        raise ConfigError(f"format={config.format}: {error}") from error
    return written


def visited_states(run: RunConfig, policy: otr.ObliqueTree, n_episodes: int = 5) -> np.ndarray:
    """Return the states (n, d) that a policy visits in a few of the episodes that the run was pruned with."""
    seeds = episode_seeds(run.seed, "prune", min(n_episodes, run.prune.n_episodes))
    return rollout(policy.predict, run.env, seeds, keep_states=True, n_workers=1).states


def title_of(run: RunConfig, tree: str) -> str:
    """Return a title for a picture of one of a run's trees, or of a program."""
    if isinstance(run.method, ProgramConfig):
        return f"{run.env.name}, program {Path(run.method.program).name}"
    depth = ", ".join(map(str, run.hidden_widths)) or "0"
    return f"{run.env.name}, {run.method.name}, depth {depth}: {tree.replace('_', ' ')} tree"


def write_program(config: ExportConfig, program: str | bytes) -> Path:
    """Write a program to `out`, a file or a folder that is there, and return the file."""
    assert config.out is not None
    path = Path(config.out)
    if path.is_dir():
        path /= f"{config.name or 'policy'}{FORMATS[config.format].suffix}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(program.encode() if isinstance(program, str) else program)
    except OSError as error:
        raise PipelineError(f"out={config.out}: cannot be written ({error.strerror})") from error
    return path


def tree_of(form: str, run: RunConfig, folder: Path) -> Any:
    """Return one of a run's trees by its name in TREES; held as patterns where it is, those of COMPACT as networks.

    Raises:
        ConfigError: the run's method has no such tree.
        MissingInputError: the stage that makes it is not finished; names the command.
        PipelineError: a file was changed.
    """
    _check_name("tree", form, TREES)
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
            f"{command_of(folder.absolute(), run.method.actor_stage)}{extra}"
        )
    verified_manifest(folder / stage)
    if form in COMPACT:
        if not exists(folder / stage / "actor.json"):
            raise ConfigError(f"tree={form}: the polish moved the tree's numbers, not a network's; use tree=polished")
        return load_actor(folder / stage)
    if form == "minimal" and not exists(folder / stage / "tree.json"):
        reason = read_json(folder / stage / "report.json").get("reason")
        raise PipelineError(f"{folder}: there is no minimal tree, as stage certify gave up: {reason}")
    with opened_run(run, folder, stage) as whole:
        return otr.load(whole / stage / ("constant_gains" if form == "constant_gains" else "tree"))


def policy_of(config: ExportConfig, run: RunConfig, folder: Path) -> Any:
    """Return the tree of a run that was asked for, or the network behind it; raises as `tree_of` does."""
    tree = tree_of(config.tree, run, folder)
    if not isinstance(tree, otr.PatternTree):
        return tree
    if config.format != "c":
        raise ConfigError(
            f"tree=full: it has {tree.n_paths:,} leaves, held as activation patterns, which no file can list; "
            "use tree=pruned, or format=c, which writes the network that the tree is"
        )
    return tree.network


def _check_name(key: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise ConfigError(f"{key}={value}: there is no such {key}.{did_you_mean(value, known)}")


def _no_such_run(run: str, runs: Path) -> str:
    there = [path.relative_to(runs).as_posix() for path in runs.glob("*/*/depth-*/*/seed-*")]
    wanted = re.sub(r"^.*runs/", "", Path(run).as_posix())
    near = difflib.get_close_matches(wanted, there, n=3, cutoff=0.6)
    lines = [f"run={run}: there is no such folder, here or below {runs}."]
    lines += [f"Did you mean {' or '.join(near)}?"] if near else []
    command = run_command(runs / wanted)
    lines.append(f"To make it: {command}" if command else "A run's folder is runs/ENV/METHOD/depth-D/BUDGET/seed-S.")
    return "\n".join(lines)
