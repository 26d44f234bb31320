"""How things are measured: alternately with their peer, by the least of several rounds, against a target."""

import operator
import os
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_COMPARE = {"<=": operator.le, ">=": operator.ge}


def results_dir() -> Path:
    """Return the folder with the committed runs, under which benchmarks write, too."""
    return Path(os.environ.get("OTR_RESULTS_DIR", "results"))


def output_dir(quick: bool) -> Path:
    """Return the folder that benchmarks write to; quick ones do not overwrite whole ones."""
    return results_dir() / "benchmarks" / "quick" if quick else results_dir() / "benchmarks"


@dataclass(frozen=True)
class Entry:
    """One measurement: `value` and `peer_value` are in `unit`, the ratio is value / peer_value.

    Attributes:
        name: what was measured.
        value, unit: ours.
        peer, peer_value: what it is compared with, in the same unit; None where there is none.
        target: "ratio <= 1.5", "value >= 10" and so on; None for a measurement that only informs.
        clock: "process" (CPU time, which other programs disturb little), "wall", or None where no time is measured.
        details: what else was measured, by name.
    """

    name: str
    value: float
    unit: str
    peer: str | None = None
    peer_value: float | None = None
    target: str | None = None
    clock: str | None = "process"
    details: dict[str, float] | None = None

    def __post_init__(self) -> None:
        if self.target is not None:
            self._parsed_target()

    @property
    def ratio(self) -> float | None:
        """value / peer_value."""
        return None if self.peer_value is None else self.value / self.peer_value

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None where there is no target."""
        if self.target is None:
            return None
        measured, compare, limit = self._parsed_target()
        return bool(_COMPARE[compare](measured, limit))

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as it is written to results/benchmarks/<name>.json; measured numbers with four digits."""
        return {
            "name": self.name,
            "value": _rounded(self.value),
            "unit": self.unit,
            "peer": self.peer,
            "peer_value": _rounded(self.peer_value),
            "ratio": _rounded(self.ratio),
            "target": self.target,
            "met": self.met,
            "clock": self.clock,
            **({"details": {key: _rounded(each) for key, each in self.details.items()}} if self.details else {}),
        }

    def _parsed_target(self) -> tuple[float, str, float]:
        parts = (self.target or "").split()
        if len(parts) != 3 or parts[0] not in ("value", "ratio") or parts[1] not in _COMPARE:
            raise ValueError(f"{self.name}: the target is {self.target!r}, expected 'value|ratio <=|>= number'")
        measured = self.value if parts[0] == "value" else self.ratio
        if measured is None:
            raise ValueError(f"{self.name}: the target is {self.target!r}, but there is no peer_value to compare with")
        return measured, parts[1], float(parts[2])


def alternate(
    *functions: Callable[[], Any], rounds: int, repeats: int = 1, clock: Callable[[], float] = time.process_time
) -> list[float]:
    """Return the least seconds of each function over rounds in which they take turns: A, B, A, B, ...

    A machine that is slower for a while is slower for both, and the least of the rounds is the one least disturbed.

    Args:
        functions: what to time, ours and its peers.
        rounds: rounds, at least 1.
        repeats: calls timed together in a round, for functions much faster than the clock's resolution.
        clock: `time.process_time`, or `time.perf_counter` where other processes do part of the work.

    Returns:
        Seconds a call, one number for each function.
    """
    least = [float("inf")] * len(functions)
    for _ in range(rounds):
        for i, function in enumerate(functions):
            began = clock()
            for _ in range(repeats):
                function()
            least[i] = min(least[i], (clock() - began) / repeats)
    return least


def repeats_for(function: Callable[[], Any], seconds: float) -> int:
    """Return how many calls of `function` take about `seconds`, at least 1; calls it a few times."""
    function()  # the first call may build caches
    return max(1, int(seconds / max(alternate(function, rounds=3)[0], 1e-7)))


def peak_bytes(function: Callable[[], Any]) -> int:
    """Return the most memory that `function` held at once, beyond what was held before; its result counts."""
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")
