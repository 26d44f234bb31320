"""The names that a program may use, and what it has named itself so far."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager

from otr.programs.language.tokens import Place, Source, written

FUNCTIONS = {
    "abs": (1, 1),
    "argmax": (1, None),
    "clip": (3, 3),
    "exp": (1, 1),
    "fabs": (1, 1),  # C's names of abs, max and min
    "fabsf": (1, 1),
    "fmax": (2, 2),
    "fmaxf": (2, 2),
    "fmin": (2, 2),
    "fminf": (2, 2),
    "max": (1, None),
    "min": (1, None),
    "tanh": (1, 1),
}


class Scope:
    """Names in the order of the text: there are no loops, so what is not named above is not known."""

    def __init__(
        self, source: Source, features: Sequence[str], labels: Mapping[str, int], outputs: Collection[str] = ()
    ) -> None:
        """Know the inputs and, where a program answers labels, their names; else those of its outputs."""
        self._source = source
        self._outputs = outputs
        self.features = {name: index for index, name in enumerate(features)}
        self.labels = dict(labels)
        self.variables: dict[str, Place] = {}
        self._unread: list[dict[str, Place]] = [{}]  # of every block around, what it has named and nothing has used

    def use(self, name: str, at: Place) -> None:
        """Note that a name is used; raise ProgramError, with similar names, if nothing has that name."""
        if name not in self.features and name not in self.variables and name not in self.labels:
            label = f" It is an output's, which has no value here; for labels, give labels=True.{self._like(name)}"
            raise self._source.error(
                f"unknown name {name!r}.{label if name in self._outputs else self._like(name)}", at
            )
        for block in self._unread if name in self.variables else ():
            block.pop(name, None)

    def assign(self, name: str, at: Place) -> None:
        """Note that a name is given a value; raise ProgramError for an input's name, or if the last value is unused."""
        if name in self.features:
            raise self._source.error(f"{name!r} is an input; give the value a name of its own", at)
        if name in self._unread[-1]:
            line = self._unread[-1][name].line
            raise self._source.error(f"{name!r} has a value from line {line} that nothing has used; remove one", at)
        self.variables.setdefault(name, at)
        self._unread[-1][name] = at

    def check_function(self, name: str, at: Place) -> None:
        """Refuse brackets after what is no function's name."""
        if name in FUNCTIONS:
            return
        if name in self.features or name in self.variables or name in self.labels:
            raise self._source.error(f"{name!r} is no function; write {name} * (...) for a product", at)
        near = difflib.get_close_matches(name, FUNCTIONS, n=1)
        hint = f"Did you mean {near[0]}?" if near else f"Known are: {', '.join(FUNCTIONS)}"
        raise self._source.error(f"unknown function {name!r}. {hint}", at)

    @contextmanager
    def block(self) -> Iterator[None]:
        """Read the statements of a block."""
        self._unread.append({})
        yield
        self._unread.pop()

    def _like(self, name: str) -> str:
        known = [*self.features, *self.variables, *self.labels]
        near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        near = near or [other for other in known if other.lower() == name.lower()]
        if near:
            return f" Did you mean {' or '.join(map(written, near))}?"
        shown = [*map(written, known[:20]), *(["..."] if len(known) > 20 else [])]
        return f" Known are: {', '.join(shown)}" if known else " There are no inputs"
