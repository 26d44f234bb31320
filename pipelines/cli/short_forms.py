"""Short forms of arguments of `otr-run`: a policy by its file, a column of Table 4.1, and settings of polishing."""

import functools
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from pipelines.cli.overrides import key_of, parse
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.method import MethodConfig
from pipelines.config.methods import EXTRA_STAGES, METHODS
from pipelines.errors import ConfigError, did_you_mean
from pipelines.stages.parse import holds_tree

# Short forms of a method with its policy, and what is done with the policy.
GIVEN_POLICIES = {"program": "evaluated", "model": "imported"}
TRUE = ("true", "1", "yes", "on", "y")  # as OmegaConf reads them
OF_A_MODEL = ("normalise", "output")
SHORT = (*GIVEN_POLICIES, *OF_A_MODEL, "column", "box")  # their keys


def spelt_out(overrides: Sequence[str]) -> list[str]:
    """Return overrides with those replaced that are short for others.

    `program=FILE` and `model=FILE` are a method and its policy; under a method that imitates, the model is the
    oracle, as is `oracle=FILE`. Hydra would take a program for a choice of the group conf/program, where the shipped
    ones are. `column=NAME` is a method and its depth, `box=` is `certification.box=`, and `polish.free=true` is
    `polishing.free=true`, because `polish` itself is the switch. An id for which conf/env has a file stands for that
    file's name.
    """
    overrides = [_of_its_kind(override) for override in _columns_spelt_out(overrides)]
    named = [override for override in overrides if key_of(override) in GIVEN_POLICIES]
    if len({key_of(override) for override in named}) > 1:
        raise ConfigError(f"{named[0]} and {named[-1]} are two policies; leave one of them out")
    methods = [override for override in overrides if override.startswith("method=")]
    for override in named:
        key = key_of(override)
        others = [each for each in methods if each != f"method={key}" and not (key == "model" and imitates(each))]
        if others:
            does = GIVEN_POLICIES[key]
            raise ConfigError(f"{override} is {does} by method={key}, not by {others[0]}; leave one of them out")
    written = []
    for override in overrides:
        if override.startswith("env="):
            env = str(parse(override).value())  # a sweep escapes the colon of module:Id
            written.append(f"env={_named_ids().get(env, env)}")
        elif override.startswith("box="):
            written.append(f"certification.{override}")
        elif override.startswith("polish."):
            written.append(f"polishing.{override.removeprefix('polish.')}")
        elif override in named:
            written += [*([] if methods else [f"method={key_of(override)}"]), f"method.{override}"]
        elif key_of(override) in OF_A_MODEL:
            if not any(key_of(each) in ("model", "oracle", "method.model") for each in overrides):
                raise ConfigError(f"{override}: of which model? Add model=FILE or oracle=FILE")
            written.append(f"method.{override.replace('normalise=null', 'normalise=none')}")
        elif override.startswith("oracle=") and isinstance(parse(override).value(), str):
            if not any(map(imitates, methods)):
                raise ConfigError(f"{override}: who is to imitate it? Add {imitating()}")
            written.append(f"method.model={override.removeprefix('oracle=')}")
        else:
            written.append(override)
    _check_stages(written)
    return written


@functools.cache
def _columns() -> dict[str, list[str]]:
    return {str(name): stands_for.split() for name, stands_for in OmegaConf.load(CONF_DIR / "column.yaml").items()}


def _columns_spelt_out(overrides: Sequence[str]) -> list[str]:
    """Return overrides with `column=NAME` replaced by those that it stands for (conf/column.yaml)."""
    columns, spelt_out = _columns(), []
    for override in overrides:
        name = override.removeprefix("column=")
        if name != override and name not in columns:
            raise ConfigError(f"{override}: there is no such column.{did_you_mean(name, list(columns))}")
        spelt_out += [override] if name == override else columns[name]
    return spelt_out


def _check_stages(overrides: Sequence[str]) -> None:
    """Refuse a switch given together with a list of stages that lacks its stage: it would do nothing."""
    words = {"stages", *EXTRA_STAGES}
    given = {key_of(override): parse(override).value() for override in overrides if key_of(override) in words}
    chosen = given.pop("stages", None)
    stages = [chosen] if isinstance(chosen, str) else chosen
    for switch, value in given.items():
        if str(value).lower() in TRUE and isinstance(stages, list) and switch not in stages:
            raise ConfigError(
                f"{switch}=true and stages=[{','.join(map(str, stages))}], which has no {switch}; "
                f"add {switch} to the stages, or leave one of the two out"
            )


@functools.cache
def _named_ids() -> dict[str, str]:
    """Return the names of the environments that have a file in conf/env, by id."""
    return {str(OmegaConf.load(path).env.id): path.stem for path in (CONF_DIR / "env").glob("*.yaml")}


def _of_its_kind(override: str) -> str:
    """Return an override with `model=FILE` as `program=FILE` where the file holds a tree, which is a program."""
    is_model = key_of(override) == "model" and not parse(override).is_sweep_override()
    return f"program={override[6:]}" if is_model and holds_tree(Path(str(parse(override).value()))) else override


def imitates(override: str) -> bool:
    """Return whether an override chooses a method that imitates."""
    return METHODS.get(override.removeprefix("method="), MethodConfig).imitates


def imitating() -> str:
    """Return the overrides of the methods that imitate, as text."""
    return " or ".join(f"method={name}" for name, method in METHODS.items() if method.imitates)
