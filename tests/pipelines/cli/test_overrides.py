"""Overrides as text: what a sweep of them makes, and how values are quoted."""

import argparse
from dataclasses import dataclass, field

import pytest

from pipelines.cli.compose import USAGE_ERRORS, message_of
from pipelines.cli.overrides import asked, combinations, parse, quoted, with_path_quoted
from pipelines.cli.settings import settings_of
from pipelines.config.setting import FreeText, Positive
from pipelines.errors import ConfigError


def test_a_sweep_makes_all_combinations_the_last_key_fastest():
    assert combinations(["a=1,2", "b=x", "c=range(0,2)"]) == [
        ["a=1", "b=x", "c=0"], ["a=1", "b=x", "c=1"], ["a=2", "b=x", "c=0"], ["a=2", "b=x", "c=1"]]  # fmt: skip
    assert combinations(["oracle=[32],[8,8]", "+experiment=e"]) == [
        ["oracle=[32]", "+experiment=e"], ["oracle=[8,8]", "+experiment=e"]]  # fmt: skip
    assert combinations(["a=choice(3,1)", "p='x y','~z'"])[0] == ["a=3", "p='x y'"]
    assert combinations(["a=1,2", "b=1", "a=3"]) == [["a=3", "b=1"]]  # a key that is given again keeps its place
    assert combinations(["seed=range(0,0)", "b=1"]) == []
    for read, word, message in (
        (combinations, ["a=interval(0,1)"], "give values, range"),
        (combinations, ["a=glob(*)"], "give values, range"),
        (parse, "depth", "depth is no key=value"),
        (parse, "depth=[8,8", r"^depth=\[8,8: the value cannot be read; is a bracket or a quote open"),
    ):
        with pytest.raises(ConfigError, match=message):
            read(word)


@pytest.mark.parametrize(
    ("text", "value"), [("a/b_c-1.2", "a/b_c-1.2"), ("a b", "'a b'"), ("it's", r"'it\'s'"), ("dépôt", "'dépôt'")]
)
def test_values_are_quoted_for_hydra(text, value):
    assert quoted(text) == value
    assert parse(f"key={value}").value() == text


def test_paths_are_quoted_and_nothing_else():
    for override in ("program=a,b.txt", "program='x y'", "program=[a]", "program=glob(*)", "env=a~b"):
        assert with_path_quoted(override) == override
    assert with_path_quoted("program=runs/s~1/p.txt,q r") == "program='runs/s~1/p.txt','q r'"
    assert with_path_quoted("model=ü.zip") == "model='ü.zip'"  # a letter, but none of Hydra's
    assert with_path_quoted("results_dir=my runs") == "results_dir='my runs'"


def test_the_home_folder_is_spelt_out(monkeypatch):
    monkeypatch.setenv("HOME", "/me")
    words = ["out=~/a.txt", "model=~/my a.zip,~/b.zip", "results_dir=~/runs", "name=~x", "program=s~1/p.txt"]
    there = ["out=/me/a.txt", "model='/me/my a.zip',/me/b.zip", "results_dir=/me/runs"]
    assert asked(argparse.Namespace(overrides=words)) == [*there, "name=~x", "program='s~1/p.txt'"]


@dataclass(frozen=True)
class Settings:
    out: FreeText | None = "page"
    run: list[FreeText] = field(default_factory=list)
    range: bool = False
    seconds: Positive | None = None


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ([], Settings()),
        (["out=runs/seed-0~1 (a), b", "range=true", "seconds=2"], Settings("runs/seed-0~1 (a), b", [], True, 2.0)),
        (["out='a b'", "run=a", "run=[b~1, 'c d']"], Settings("a b", ["a", "b~1", "c d"])),
        (["out"], "out is no key=value"),
        (["outt=a"], "there is no key 'outt'. Did you mean out"),
        (["range=1,2"], "range=1,2: give one value"),
        (["seconds=fast"], "seconds=fast: give a number"),
    ],
)
def test_settings_of_a_command_are_texts_as_written_and_lists_of_them(words, settings):
    if isinstance(settings, Settings):
        assert settings_of(Settings, words) == settings
    else:
        with pytest.raises(USAGE_ERRORS) as caught:
            settings_of(Settings, words)
        assert settings in message_of(caught.value)
