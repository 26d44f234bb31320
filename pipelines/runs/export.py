"""The policy of a finished run as a program in another language, with the environment's names."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, cast

import numpy as np

import otr
from otr.clock import time_limit
from otr.programs.c.arduino import arduino_sketch
from pipelines.config.run import RunConfig
from pipelines.config.setting import Folder, FreeText, OneOf, Range, check_settings, results_folder
from pipelines.config.stages import Side
from pipelines.errors import ConfigError, PipelineError, check_choice
from pipelines.play.printed_programs import names_of_env
from pipelines.runs.finished_run import COMPACT, TREES, check_run, title_of, tree_of, visited_states
from pipelines.runs.verify_run import question_domain, wanted_box

_N_TESTED = 100  # random inputs with which C in fixed point tests itself
_BOUND_S = 30.0  # for the bound of what floats change


@dataclass(frozen=True)
class ExportConfig:
    """What `otr-export` takes; None is the format's own default."""

    run: FreeText = ""
    program: FreeText | None = None  # in place of a run
    model: FreeText | None = None  # likewise, the file of a policy, as of otr-run
    env: FreeText | None = None  # whose names that has
    format: FreeText = ""
    tree: FreeText = "pruned"
    out: FreeText | None = None
    name: FreeText | None = None
    dtype: Annotated[str | None, OneOf("double", "float")] = None
    precision: Annotated[int | None, Range(0)] = None
    box: list[Side] | None = None
    bits: Annotated[int | None, Range(2, 24)] = None
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
    is_fixed: bool = False  # in fixed point, which needs a box of states


def _onnx(*arguments: Any, **options: Any) -> bytes:
    return bytes(otr.to_onnx(*arguments, **options).SerializeToString())


def _drawn(suffix: str, tree: otr.ObliqueTree, **options: Any) -> bytes:
    with TemporaryDirectory(prefix="otr-") as place:
        path = Path(place) / f"tree{suffix}"
        otr.save_picture(otr.draw_tree(tree, **options), path)
        return path.read_bytes()


def _c_fixed(fixed: otr.FixedPointTree, **options: Any) -> str:
    """Return C with a test of its own: random inputs, and what Python answers."""
    low, high = fixed.input_low, fixed.input_high
    states = np.random.default_rng(0).integers(low, high + 1, (_N_TESTED, fixed.n_inputs))
    return otr.to_c(fixed, test_states=np.concatenate((low[None], high[None], states)), **options)


FORMATS = {
    "text": Format(".txt", otr.to_text, ("precision",)),
    "python": Format(".py", otr.to_python, ("name",)),
    "c": Format(".c", otr.to_c, ("name", "dtype", "box")),
    "c_fixed": Format(".c", _c_fixed, ("name", "box", "bits"), is_fixed=True),
    "arduino": Format(".ino", arduino_sketch, ("name", "box", "bits"), is_fixed=True),
    "micropython": Format(".py", otr.to_python, ("name", "box", "bits"), is_fixed=True),
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
    check_policy(config.run, config.program, config.env, of_env, config.model)
    if config.model and (config.format != "c" or config.tree != "pruned"):
        raise ConfigError(
            f"model={config.model} is written as the network that it is, by format=c without tree=; for its tree: "
            f"otr-run env={config.env} model={config.model}"
        )
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
    for option in ("name", "dtype", "precision", "box", "bits"):
        if getattr(config, option) is not None and option not in FORMATS[config.format].options:
            takes = [name for name, known in FORMATS.items() if option in known.options]
            raise ConfigError(f"{option}={getattr(config, option)}: format={config.format} has none; "
                              f"these have: {', '.join(takes)}")  # fmt: skip


def check_policy(
    run: str, program: str | None, env: str | None, of_env: Sequence[str] = (), model: str | None = None
) -> None:
    """Raise ConfigError unless one policy is named: a run's, or a program or a model and the environment it is for."""
    files = [f"{key}={file}" for key, file in (("program", program), ("model", model)) if file]
    if not files:
        check_run(run)
        check_no_environment(env, of_env)
    elif run or len(files) > 1:
        named = [*([f"run={run}"] if run else []), *files]
        raise ConfigError(f"{' and '.join(named)} are two policies; leave one of them out")
    elif not env:
        raise ConfigError(f"{files[0]}: over which environment's names? Add env=NAME")


def check_no_environment(env: str | None, of_env: Sequence[str]) -> None:
    """Raise ConfigError where an environment, or more of it, is named for a run, which has its own."""
    for given in (*([f"env={env}"] if env else []), *of_env):
        raise ConfigError(f"{given}: a run has its own environment; leave {given} out")


def program_of(config: ExportConfig, run: RunConfig, policy: Any, folder: Path | None = None) -> tuple[Any, str]:
    """Return a policy as the program that was asked for, as text or bytes, and what is proved of its rounding.

    Raises:
        ConfigError: an option that the format refuses, or a tree that it cannot hold.
        PipelineError: a package is missing.
    """
    chosen, note = FORMATS[config.format], ""
    known = [name for name in ("name", "dtype", "precision") if name in chosen.options]
    options: dict[str, Any] = {name: getattr(config, name) for name in known if getattr(config, name) is not None}
    options |= names_of_env(policy, run.env)
    if chosen.is_picture:
        options |= {"states": visited_states(run, policy), "title": title_of(run, config.tree)}
    try:
        if chosen.is_fixed:
            box, what = question_domain(config.box, run, folder, policy)
            policy, note = _in_fixed_point(policy, box, what, config.bits)
        elif config.format == "c":
            options["error"], note = _bounded_in_floats(config, run, folder, policy)
        return chosen.write(policy, **options), note
    except ImportError as error:
        raise PipelineError(str(error)) from error
    except (TypeError, ValueError, otr.InvalidTreeError) as error:
        raise ConfigError(f"format={config.format}: {error}") from error


def _in_fixed_point(
    tree: otr.ObliqueTree, box: otr.Domain, what: str, bits: int | None
) -> tuple[otr.FixedPointTree, str]:
    """Return a tree in fixed point, and what is proved of it."""
    fixed = otr.to_fixed_point(tree, box, 16 if bits is None else bits)
    proof = otr.certify_fixed_point(fixed, tree, box)
    sizes = np.sqrt((tree.P**2).sum(axis=1))
    distance = max((margin / size for margin, size in zip(proof.margins or (), sizes, strict=True) if size), default=0)
    is_near = f"no action is off by more than {proof.max_error:.2g}"
    is_near = "the label is the tree's" if fixed.head.gives_labels else is_near
    share = "" if proof.share is None else f" ({proof.share:.2%} of its range)"
    return fixed, f"{fixed.bits} bits: {is_near}{share}, farther than {distance:.2g} from the tests; on {what}"


def _bounded_in_floats(
    config: ExportConfig, run: RunConfig, folder: Path | None, policy: Any
) -> tuple[otr.FloatErrorBound | None, str]:
    """Return what rounding changes of a tree over a box that is known, and that as text; None where it has no bound."""
    is_known = config.box is not None or wanted_box(run) is not None
    if not isinstance(policy, otr.ObliqueTree) or isinstance(policy.head, otr.PidBox) or not is_known:
        return None, ""
    box, what = question_domain(config.box, run, folder, policy)
    try:
        with time_limit(_BOUND_S, lambda: "the tree is large"):
            error = otr.float_error(policy, box, cast(Any, config.dtype or "double"))
    except otr.TimeLimitError:
        return None, ""
    return error, f"{error}; on {what}"


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
