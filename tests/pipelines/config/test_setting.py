"""Every setting declares what it may be; what it declares is enforced, and decides what is keyed."""

import dataclasses
import functools
import inspect
import math
import re
import types
import typing
from collections.abc import Callable
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import yaml

from otr.control.settings import CartSettings, SearchSettings
from pipelines.cli.commands.tabulate import TabulateConfig
from pipelines.cli.runs import RUN
from pipelines.config.algo import ALGORITHMS
from pipelines.config.budget import BudgetConfig
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.methods import METHODS
from pipelines.config.run import RunConfig
from pipelines.config.setting import (
    EXECUTION,
    AsBefore,
    Count,
    FreeText,
    OneOf,
    OnlyWhere,
    Range,
    Text,
    check_setting,
    check_settings,
    declared,
    expected,
    is_list,
    keyed_settings,
    not_keyed,
)
from pipelines.config.stages import PolishingConfig
from pipelines.config.trainer import TRAINERS
from pipelines.errors import ConfigError
from pipelines.runs.export import ExportConfig
from pipelines.runs.verify_run import VerifyConfig
from pipelines.supervised.config import LEARNERS, DataConfig, FitConfig

RUN_PARTS = {"algo": ALGORITHMS, "method": METHODS, "trainer": TRAINERS}
OF_ANY_TYPE = {
    ("RunConfig", "depth"),
    ("EnvConfig", "kwargs"),
    ("OtrConfig", "teacher"),
    *((kind, "teacher") for kind in ("CartConfig", "LinearConfig", "TaoConfig")),
}  # checked where they are read


def plain_types(hint: Any) -> set[type]:
    """Return the types of the values in a setting: of `list[int] | None`, int."""
    if get_origin(hint) is Annotated:
        return plain_types(get_args(hint)[0])
    if get_origin(hint) is dict:
        return plain_types(get_args(hint)[1])
    if get_origin(hint) in (list, tuple, typing.Union, types.UnionType):
        return {kind for part in get_args(hint) if part is not ... for kind in plain_types(part)}
    return {hint}


def example(kind: type) -> Any:
    """Return an object whose fields without a default have a value that they may have."""
    hints, values = get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            values[field.name] = example_value(hints[field.name], declared(kind)[field.name])
    return kind(**values)


def example_value(hint: Any, markers: tuple[Any, ...]) -> Any:
    if get_origin(hint) is list:
        return [example_value(get_args(hint)[0], markers)]
    if get_origin(hint) is dict:
        return {"a": example_value(get_args(hint)[1], markers)}
    if dataclasses.is_dataclass(hint):
        return example(hint)
    if hint is bool:
        return False
    ranges = [marker for marker in markers if isinstance(marker, Range)]
    if ranges:
        return next(value for value in (1, 0.5, 2, 0) if ranges[0].problem(value) is None)
    options = [marker.options[0] for marker in markers if isinstance(marker, OneOf)]
    return (*options, "auto")[0]


def settings_of(root: type, parts: dict[str, dict[str, type]]) -> list[tuple[str | None, type, str]]:
    """Return (part, class, field) of every setting of a configuration, whatever class a part has."""
    hints, found = get_type_hints(root), []
    for field in dataclasses.fields(root):
        kinds = [*parts.get(field.name, {}).values(), hints[field.name]] if field.name != "oracle_run" else []
        inner = [(field.name, kind, inside.name) for kind in dict.fromkeys(kinds) if dataclasses.is_dataclass(kind)
                 for inside in dataclasses.fields(kind)]  # fmt: skip
        found += inner or [(None, root, field.name)]
    return found


RUN_SETTINGS = settings_of(RunConfig, RUN_PARTS)
FIT_SETTINGS = settings_of(FitConfig, {"method": LEARNERS})
KINDS = list(dict.fromkeys(kind for _, kind, _ in (*RUN_SETTINGS, *FIT_SETTINGS)))


@pytest.mark.parametrize("kind", [*KINDS, TabulateConfig, ExportConfig, VerifyConfig], ids=lambda kind: kind.__name__)
def test_numbers_declare_a_range_and_texts_their_options(kind):
    for field, hint in get_type_hints(kind).items():
        if field not in declared(kind):  # a fact of the class, not a setting
            continue
        held, markers = plain_types(hint), declared(kind)[field]
        n_ranges = sum(isinstance(marker, Range) for marker in markers)
        n_texts = sum(isinstance(marker, OneOf | Text) for marker in markers)
        assert (n_ranges, n_texts) == (bool(held & {int, float}), str in held), field
        assert Any not in held or (kind.__name__, field) in OF_ANY_TYPE or field == "grid", field


def refused_values(kind: type, field: str) -> list[Any]:
    """Return values just outside what a field declares, in a list or a dict where its type is one."""
    values: list[Any] = []
    for marker in declared(kind)[field]:
        if isinstance(marker, Range):
            values += [math.nan] if float in plain_types(get_type_hints(kind)[field]) else []
            values += [marker.low - max(1e-9, abs(marker.low) / 2)] if marker.low > -math.inf else []
            values += [marker.high if marker.open else marker.high * 1.5] if marker.high < math.inf else []
        elif isinstance(marker, OneOf):
            values.append("neither of them")
        elif isinstance(marker, Text) and marker.pattern != ".*":
            values.append("")
    hint = get_type_hints(kind)[field]
    if get_origin(hint) is list:
        return [[value] for value in values]
    return [{"a": value} for value in values] if get_origin(hint) is dict else values


def is_refused(make: Callable[..., Any], part: str | None, kind: type, field: str, value: Any) -> bool:
    """Return whether a configuration with this value is refused by the name of the setting."""
    changes = {part: dataclasses.replace(example(kind), **{field: value})} if part else {field: value}
    with pytest.raises(ConfigError) as raised:
        make(**changes)
    return re.match(rf"{part + '.' if part else ''}{field}\b", str(raised.value)) is not None


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_values_outside_a_declared_range_are_refused(tiny, kind):
    fit = FitConfig(DataConfig("bace"), LEARNERS["cart"]("cart", "cart"), 0, "results")
    for settings, make in ((RUN_SETTINGS, tiny), (FIT_SETTINGS, functools.partial(dataclasses.replace, fit))):
        for part, of, field in settings:
            values = refused_values(kind, field) if of is kind else []
            accepted = [value for value in values if not is_refused(make, part, kind, field, value)]
            assert not accepted, f"{kind.__name__}.{field}"


@dataclasses.dataclass(frozen=True)
class Inner:
    share: Annotated[float, Range(0, 1, open=True)] = 0.5
    young: Annotated[bool, AsBefore(False)] = False


@dataclasses.dataclass(frozen=True)
class Outer:
    widths: list[Count] | None = None
    table: dict[str, Count] = dataclasses.field(default_factory=dict)
    kind: Annotated[str, OneOf("a", "b")] = "a"
    folder: Annotated[str, Text(".+", "give one")] = "here"
    n_workers: Annotated[Count | None, EXECUTION] = None
    inner: Inner = dataclasses.field(default_factory=Inner)
    special: Annotated[Inner, OnlyWhere("is_special")] = dataclasses.field(default_factory=Inner)
    limited: Annotated[float, Range(-1, 1e6)] = 0.0
    name: FreeText = ""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"widths": [3, 0]}, "widths=[3, 0]: 0 is not at least 1"),
        ({"table": {"x": 0}}, "table.x=0 is not at least 1"),
        ({"kind": "c"}, "kind=c: use one of a, b"),
        ({"folder": ""}, "folder is empty: give one"),
        ({"n_workers": 0}, "n_workers=0 is not at least 1"),
        ({"n_workers": "two"}, "n_workers=two is not a number"),
        ({"inner": Inner(1.0)}, "inner.share=1.0: give a number from 0 to below 1"),
        ({"special": Inner(math.nan)}, "special.share=nan: give a number from 0 to below 1"),
        ({"limited": -1.5}, "limited=-1.5 is not between -1 and 1000000"),
    ],
)
def test_messages_name_key_value_and_what_it_may_be(changes, message):
    with pytest.raises(ConfigError) as raised:
        check_settings(Outer(**changes))
    assert str(raised.value) == message
    check_settings(Outer(widths=[1], inner=Inner(0.0), limited=1e6))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("widths", "a list of whole numbers of at least 1, as [8,8] or null"),
        ("table", "values by name, as {a: 1}"),
        ("kind", "one of a, b"),
        ("n_workers", "a whole number of at least 1 or null"),
        ("inner", "its settings one by one (.share=, .young=)"),
        ("limited", "a number from -1 to 1000000"),
        ("name", "text"),
    ],
)
def test_what_a_setting_may_be_in_words(name, words):
    assert expected(Outer, name) == words
    assert (expected(Inner, "share"), expected(Inner, "young")) == ("a number from 0 to below 1", "true or false")
    assert is_list(Outer, name) == (name == "widths")


def test_a_value_from_elsewhere_is_checked_under_the_name_given():
    with pytest.raises(ConfigError, match=r"^grid: kind=c: use one of a, b"):
        check_setting(Outer, "kind", "c", "grid: kind")


def test_execution_and_settings_that_are_as_before_are_not_keyed():
    special, plain = types.SimpleNamespace(is_special=True), types.SimpleNamespace(is_special=False)
    kept = keyed_settings(Outer(inner=Inner(0.1, young=True), n_workers=3), special)
    assert kept == {
        "widths": None, "table": {}, "kind": "a", "folder": "here", "inner": {"share": 0.1, "young": True},
        "special": {"share": 0.5}, "limited": 0.0, "name": "",
    }  # fmt: skip
    del kept["special"]
    assert keyed_settings(Outer(), plain) == kept | {"inner": {"share": 0.5}}


def test_what_a_run_is_not_keyed_by():
    execution = {"results_dir", "stages", "n_workers", "side_by_side", "debug", "polish", "certify", "simplify",
                 "leaves", "video", "tracking"}  # fmt: skip
    assert set(not_keyed(RunConfig)) == execution | {"program_text", "imported", "folder", "changes", "oracle_run"}


def test_files_have_only_what_differs_from_the_dataclass():
    repeated = []
    for (group, name), kind in RUN.schemas.items():
        files = {RunConfig: "run.yaml", BudgetConfig: "budget/*.yaml"}.get(kind, f"{group}/*.yaml")
        for path in CONF_DIR.glob(files):
            content = yaml.safe_load(path.read_text())
            if any(str(each).startswith((name, f"/{name}")) for each in content.get("defaults", ())):
                repeated += [(path.name, *where) for where in _defaults_in(kind, content)]
    assert repeated == []


def _defaults_in(kind: type, content: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the keys at which a file's content has what the dataclass has by default."""
    found: list[tuple[str, ...]] = []
    for field in dataclasses.fields(kind):
        made = field.default_factory() if callable(field.default_factory) else field.default
        if field.name not in content or made is dataclasses.MISSING:
            continue
        if dataclasses.is_dataclass(made):
            found += [(field.name, *inner) for inner in _defaults_in(type(made), content[field.name])]
        elif content[field.name] == made:
            found.append((field.name,))
    return found


def test_what_the_library_declares_is_declared_again_nowhere():
    kinds = {*METHODS.values(), *ALGORITHMS.values(), PolishingConfig}
    for kind in kinds:
        shared = [base for base in kind.__mro__ if base.__module__ == "otr.control.settings"]
        names = {field.name for base in shared for field in dataclasses.fields(base)}
        assert not names & {name for base in kind.__mro__ if base not in shared for name in _own(base)}, kind
    assert issubclass(METHODS["viper"], CartSettings) and issubclass(PolishingConfig, SearchSettings)


def _own(kind: type) -> set[str]:
    return set(inspect.get_annotations(kind))
