"""Names of inputs and answers, which may be any text, as programs take them: identifiers, and text of one line."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from otr.core.smooth_network import Layered
from otr.core.tree import ObliqueTree, require_tree

# What ends a comment in C or structured text, opens one there, or begins a trigraph: a space goes between.
_MARKS = re.compile(r"(?<=\*)(?=[/)])|(?<=[/(])(?=\*)|(?<=\?)(?=\?)")


@dataclass(frozen=True)
class Names:
    """The names in a program."""

    features: list[str]  # as given, in one line that prints (`shown_names`): for comments, labels and formulas
    answers: list[str]  # likewise
    feature_ids: list[str]
    output_ids: list[str]  # of the affine outputs
    answer_ids: list[str]  # of the values of the answer; the outputs' own, but for gains and terms


def names_for(
    tree: ObliqueTree,
    feature_names: Sequence[str] | None,
    output_names: Sequence[str] | None,
    *,
    reserved: Collection[str] = (),
    ignore_case: bool = False,
) -> Names:
    """Return the names of a tree's inputs and answers, and identifiers for its inputs and its affine outputs.

    The identifiers of the outputs are made from `output_names` where these name outputs, and are y0, y1, ... where they
    name labels; the terms and gains of a PID policy are P0, ..., theta_P0, ... No two identifiers are the same.
    Raise TypeError for what is no tree or no text, ValueError for a wrong number of names or a tree without inputs.
    """
    check_tree(tree)
    features, answers = shown_names(tree, feature_names, output_names)
    outputs = [f"y{i}" for i in range(tree.n_outputs)] if give_labels(tree) else answers
    joined = tree.head.output_names(tree.n_outputs, answers)
    fallbacks = [f"x{i}" for i in range(len(features))] + [f"y{i}" for i in range(len(outputs) + len(joined))]
    made = identifiers([*features, *outputs, *joined], fallbacks, reserved=reserved, ignore_case=ignore_case)
    d, o = len(features), len(features) + len(outputs)
    return Names(features, answers, made[:d], made[o:] if joined else made[d:o], made[d:o])


def names_of(
    policy: ObliqueTree | Layered, feature_names: Sequence[str] | None, output_names: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Return the names of a policy's inputs and of its outputs or, where it decides labels, of these.

    These are the names given, else the tree's own, else the usual ones, each of them unchanged.
    Raise TypeError for a name that is no text, ValueError for a wrong number of names and as `check_names` does.
    """
    features, usual_answers = _usual_names(policy)
    answers = usual_answers
    if isinstance(policy, ObliqueTree):
        features, answers = list(policy.feature_names or features), list(policy.output_names or answers)
    features, answers = _names(feature_names, features, "feature_names"), _names(output_names, answers, "output_names")
    # The number of a label without a name may be an input's name: no program gives it a value.
    are_numbers = answers == usual_answers == [str(label) for label in range(len(answers))]
    check_names(features, [] if are_numbers else answers)
    return features, answers


def check_names(features: Sequence[str], answers: Sequence[str]) -> None:
    """Raise ValueError for a text in place of a list, a name given twice, and an answer with an input's name."""
    for argument, names in (("feature_names", features), ("output_names", answers)):
        _require_list(names, argument)
        seen: set[str] = set()
        for name in names:
            if name in seen:
                raise ValueError(f"{argument} has {name!r} twice; give one of them another name")
            seen.add(name)
    inputs = set(features)
    for name in answers:
        if name in inputs:
            raise ValueError(f"output_names has {name!r}, which is an input's name, too; give it another one")


def _require_list(names: Sequence[str], argument: str) -> None:
    if isinstance(names, str):
        raise ValueError(f"{argument} is the text {names!r}, expected a list of names")


def _usual_names(policy: ObliqueTree | Layered) -> tuple[list[str], list[str]]:
    """Return the names of inputs and answers that have none: x0, x1, ..., and y0, y1, ... or the labels' numbers."""
    # The tree that a network is decides its labels by tests.
    labelled = policy.labels is not None if isinstance(policy, ObliqueTree) else policy.head.gives_labels
    prefix = "" if labelled else "y"
    return [f"x{i}" for i in range(policy.n_inputs)], [f"{prefix}{i}" for i in range(policy.n_answers)]


def shown_names(
    policy: ObliqueTree | Layered, feature_names: Sequence[str] | None, output_names: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Return the names of `names_of` in one line each; a name without printable characters becomes the default one."""
    given, usual = names_of(policy, feature_names, output_names), _usual_names(policy)
    features, answers = (
        [one_line(name) or plain for name, plain in zip(*both, strict=True)] for both in zip(given, usual, strict=True)
    )
    return features, answers


def _names(given: Sequence[str] | None, without: list[str], argument: str) -> list[str]:
    if given is None:
        return without
    _require_list(given, argument)
    if len(given) != len(without):
        raise ValueError(f"{argument} has {len(given)} names, expected {len(without)}")
    for i, name in enumerate(given):
        if not isinstance(name, str):
            raise TypeError(f"{argument}[{i}] is {name!r} of type {type(name).__name__}, expected a str")
    return list(given)


def check_tree(tree: ObliqueTree) -> None:
    """Raise TypeError for what is no tree, and as `check_policy` does."""
    require_tree(tree)
    check_policy(tree)


def check_policy(policy: ObliqueTree | Layered) -> None:
    """Raise ValueError for a policy that no format can write: without inputs."""
    if policy.n_inputs == 0:
        raise ValueError("the tree has no inputs; a program needs at least one")


def give_labels(policy: ObliqueTree | Layered) -> bool:
    """Return whether the answers of a tree or network are labels."""
    decided = isinstance(policy, ObliqueTree) and policy.labels is not None
    return decided or policy.head.gives_labels


def label_name(label: int, answers: Sequence[str]) -> str:
    """Return a label's name, or its number where it has none."""
    return answers[label] if 0 <= label < len(answers) else str(label)


def identifiers(
    names: Sequence[str], fallbacks: Sequence[str], *, reserved: Collection[str] = (), ignore_case: bool = False
) -> list[str]:
    """Return an identifier for each name: ASCII letters, digits and single underscores, a letter first, all distinct.

    A name that is one already, and is free, stays as it is. Accents are dropped, what is neither letter nor
    digit becomes an underscore, a number is appended to what is taken or one of the `reserved` words, and a name of
    which nothing is left becomes its fallback. With `ignore_case`, names that differ in case alone are the same.
    """
    key = str.lower if ignore_case else str
    plain = [_plain(name, fallback) for name, fallback in zip(names, fallbacks, strict=True)]
    kept = {key(name) for name, simple in zip(names, plain, strict=True) if name == simple}
    taken = {key(word) for word in reserved}
    made = []
    for name, simple in zip(names, plain, strict=True):
        identifier, n = simple, 1
        # Another name's own spelling is left to that name.
        while key(identifier) in taken or (identifier != name and key(identifier) in kept):
            n += 1
            identifier = f"{simple}_{n}"
        taken.add(key(identifier))
        made.append(identifier)
    return made


def _plain(name: str, fallback: str) -> str:
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    simple = re.sub(r"[^A-Za-z0-9]+", "_", ascii_only).strip("_")
    if not simple:
        return fallback
    return simple if simple[0].isalpha() else f"{fallback[0]}_{simple}"


def one_line(name: str) -> str:
    """Return a name in one line of characters that print: breaks, controls, surrogates and the like become spaces."""
    return " ".join("".join(" " if unicodedata.category(c)[0] in "CZ" else c for c in name).split())


def in_comment(name: str) -> str:
    """Return a name of one line so that it neither ends a comment of C or structured text, nor opens one in it."""
    return _MARKS.sub(" ", name)
