"""The policy of a finished run as a program in another language, with the environment's names."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import otr
from pipelines.config.run import RunConfig
from pipelines.config.setting import Folder, FreeText, OneOf, Range, check_settings, results_folder
from pipelines.errors import ConfigError, PipelineError, check_choice
from pipelines.play.printed_programs import names_of_env
from pipelines.runs.finished_run import COMPACT, TREES, check_run, title_of, tree_of, visited_states


@dataclass(frozen=True)
class ExportConfig:
    """What `otr-export` takes; None is the format's own default."""

    run: FreeText = ""
    program: FreeText | None = None  # in place of a run
    env: FreeText | None = None  # whose names the program has
    format: FreeText = ""
    tree: FreeText = "pruned"
    out: FreeText | None = None
    name: FreeText | None = None
    dtype: Annotated[str | None, OneOf("double", "float")] = None
    precision: Annotated[int | None, Range(0)] = None
    results_dir: Folder = field(default_factory=results_folder)
    debug: bool = False

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


def check_export(config: ExportConfig, of_env: Sequence[str] = ()) -> None:
    """Raise ConfigError where the request cannot be met, whatever the run; `of_env` says more of the environment."""
    check_policy(config.run, config.program, config.env, of_env)
    if config.program and config.tree != "pruned":
        raise ConfigError(f"tree={config.tree}: program={config.program} is one tree; leave tree={config.tree} out")
    if not config.format:
        raise ConfigError(f"which format? Add format=NAME with one of: {', '.join(FORMATS)}")
    check_choice("format", config.format, list(FORMATS))
    check_choice("tree", config.tree, TREES)
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


def check_policy(run: str, program: str | None, env: str | None, of_env: Sequence[str] = ()) -> None:
    """Raise ConfigError unless one policy is named: a run's, or a program with the environment that has its names."""
    if not program:
        check_run(run)
        check_no_environment(env, of_env)
    elif run:
        raise ConfigError(f"run={run} and program={program} are two policies; leave one of them out")
    elif not env:
        raise ConfigError(f"program={program}: over which environment's names? Add env=NAME")


def check_no_environment(env: str | None, of_env: Sequence[str]) -> None:
    """Raise ConfigError where an environment, or more of it, is named for a run, which has its own."""
    for given in (*([f"env={env}"] if env else []), *of_env):
        raise ConfigError(f"{given}: a run has its own environment; leave {given} out")


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


def write_program(config: ExportConfig, program: str | bytes) -> Path:
    """Write a program to `out`, a file or an existing folder, and return the file."""
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
