"""Stage parse: a handwritten program, as an oblique tree."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import otr
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.env import EnvConfig
from pipelines.config.methods import ProgramConfig
from pipelines.engine.stage import Inputs, Stage
from pipelines.engine.store import write_json, write_text
from pipelines.errors import ConfigError, did_you_mean
from pipelines.play.printed_programs import write_program
from pipelines.play.spaces import action_names, feature_names, spaces

TREE_FILES = (".json", ".npz")
DIGITS = 17  # that distinguish any two float64


@dataclass(frozen=True)
class ParseSettings:
    """What the stage reads of a run's configuration."""

    env: EnvConfig
    method: ProgramConfig
    program_text: str


def parse_keys(settings: ParseSettings) -> dict[str, Any]:
    """Return what decides the tree: the program's text, and what the environment makes of its answers."""
    return {
        "env": settings.env.settings(),
        "program_sha256": hashlib.sha256(settings.program_text.encode()).hexdigest(),
        "feature_names": settings.env.feature_names,
        "action_names": settings.env.action_names,
    }


def parse(inputs: Inputs, settings: ParseSettings, out: Path) -> None:
    """Write the program as it is, its tree, the tree's own program and `report.json`."""
    program = settings.method.program
    tree = policy_tree(settings.program_text, settings.env, program)
    write_text(out / "source.txt", settings.program_text)
    otr.save(tree, out / "tree")
    write_program(tree, settings.env, out)
    about = {"kind": "oblique_tree", "program": Path(program).name, "n_leaves": tree.n_leaves, "depth": tree.depth}
    write_json(out / "report.json", about)


def policy_tree(text: str, env: EnvConfig, where: str) -> otr.ObliqueTree:
    """Return a program as a policy: its answers are labels, or actions clipped to the environment's box.

    Raises:
        ConfigError: the text is no program over the environment's names, or no policy for it; begins with
            where:line:column.
    """
    space = spaces(env)
    try:
        tree = otr.parse_program(
            text,
            feature_names(env, space.n_inputs),
            output_names=action_names(env, space.n_actions),
            labels=space.box is None,
        )
        if space.box is not None:
            tree = tree.replace(head=tree.head.clipped_to(*space.box))
    except otr.ProgramError as error:
        place = f"{where}:{error.line}:{error.column}"
        raise ConfigError(f"{place}: {error.reason}\n{error.excerpt}") from error
    except (otr.TreeTooLargeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error
    return tree


def shipped_programs() -> list[str]:
    """Return the names of the programs that come with the package."""
    return sorted(path.stem for path in (CONF_DIR / "program").glob("*.txt"))


def holds_tree(path: Path) -> bool:
    """Return whether a file is one of the two in which `otr.save` keeps an oblique tree."""
    if path.suffix not in TREE_FILES or not path.is_file():
        return False
    try:
        return isinstance(otr.load(path), otr.ObliqueTree)
    except otr.OtrError as error:
        raise ConfigError(str(error)) from error


def _tree_text(path: Path, env: EnvConfig) -> str:
    """Return a saved tree as a program, all digits of its numbers kept."""
    tree, space = otr.load(path), spaces(env)
    if not isinstance(tree, otr.ObliqueTree):
        raise ConfigError(f"program={path} holds a network; give it as model={path}")
    if (tree.n_inputs, tree.n_answers) != (space.n_inputs, space.n_actions):
        raise ConfigError(
            f"{path}: the tree reads {tree.n_inputs} numbers and has {tree.n_answers} actions, {env.id} has "
            f"{space.n_inputs} and {space.n_actions}"
        )
    names = feature_names(env, space.n_inputs), action_names(env, space.n_actions)
    return otr.to_text(tree, feature_names=names[0], output_names=names[1], precision=DIGITS)


def read_program(name: str, env: EnvConfig) -> str:
    """Return the text of a shipped program, of a file, or of a saved tree with the environment's names.

    Raises:
        ConfigError: there is none, it is no text, or the tree is not for this environment.
    """
    if holds_tree(Path(name).expanduser()):
        return _tree_text(Path(name).expanduser(), env)
    shipped = shipped_programs()
    if not name:
        raise ConfigError(f"method=program: which program? Add program=FILE, or one of: {', '.join(shipped)}")
    path = CONF_DIR / "program" / f"{name}.txt" if name in shipped else Path(name).expanduser()
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        is_path = path.name != name or path.suffix
        hint = f" Shipped are: {', '.join(shipped)}" if is_path else did_you_mean(name, shipped)
        raise ConfigError(f"program={name}: there is no such file, and no such program is shipped.{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = "it is no UTF-8 text" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise ConfigError(f"program={name} cannot be read: {reason}") from error


PARSE = Stage("parse", version=1, inputs=(), keyed=parse_keys, run=parse, settings=ParseSettings)
