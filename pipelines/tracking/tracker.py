"""Runs logged to TensorBoard as well: settings, learning curves as they grow, final returns, the program.

Tracking is write-only and never affects a run. A tracker that fails is reported once and disabled until the run's end,
where what it has missed is logged from the run's files.
"""

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipelines.engine.digests import digest, flat
from pipelines.engine.store import read_csv
from pipelines.errors import ConfigError
from pipelines.tracking.event_files import TensorBoard, Tracked

Row = Mapping[str, Any]


def check_tracking(config: Tracked) -> None:
    """Raise ConfigError where the tracker that is asked for cannot be used here, with what to do about it."""
    name = config.tracking
    if name != "none" and not find_spec(name):
        raise ConfigError(f"tracking={name} needs the extra {name}: pip install 'otr[{name}]'")


class Tracker:
    """Logs one run, `config.folder`; with tracking=none it does nothing. No method ever raises for a tracker's sake."""

    def __init__(self, config: Tracked) -> None:
        self._config = config
        self._backend: TensorBoard | None = None
        self._last_step = 0
        self._is_off = config.tracking == "none"

    def segment_done(self, progress: Row, evaluation: Row) -> None:
        """Log a segment's rows of `progress.csv` and `evaluations.csv`; one that was logged before is skipped."""
        self._try(lambda: self._log_segment(progress, evaluation))

    def catch_up(self, progress: Sequence[Row], evaluations: Sequence[Row]) -> None:
        """Log what a checkpoint has and the tracker has not, as a kill may have come between the two."""
        for rows in zip(progress, evaluations, strict=True):
            self.segment_done(*rows)

    def finish(self, summary: Mapping[str, Any], run_dir: Path) -> None:
        """Log what is still missing of a finished run; nothing where all of it is there already."""
        self._is_off = self._config.tracking == "none"
        self._try(lambda: self._complete(summary, run_dir))

    def _log_segment(self, progress: Row, evaluation: Row) -> None:
        step = int(progress["steps"])
        if self._backend is None:
            self._backend = TensorBoard(self._config, _parameters(self._config))
            if self._backend.result() is not None:  # complete, but here it is being trained: start again
                self._backend.start(_parameters(self._config))
            self._last_step = self._backend.last_step()
        if step > self._last_step:
            self._backend.log(step, _curves(progress, evaluation))
            self._last_step = step

    def _complete(self, summary: Mapping[str, Any], run_dir: Path) -> None:
        backend = TensorBoard(self._config, _parameters(self._config))
        result = digest(summary)  # a stage that is added later changes it
        if backend.result() == result:
            return
        if backend.result() is not None:
            backend.start(_parameters(self._config))
        step = backend.last_step()
        is_trained = (run_dir / "train").is_dir()  # not what imitates or is written
        rows = (read_csv(run_dir / "train" / f"{name}.csv") for name in ("progress", "evaluations") if is_trained)
        for progress, evaluation in zip(*rows, strict=True):
            if int(progress["steps"]) > step:
                step = int(progress["steps"])
                backend.log(step, _curves(progress, evaluation))
        backend.complete(step, _numbers(flat(summary), "final/"), run_dir, result)

    def _try(self, action: Callable[[], None]) -> None:
        if self._is_off:
            return
        try:
            action()
        except Exception as error:  # no failure of a tracker ends a run
            self._is_off = True
            _warn_once(self._config.tracking, self._config.folder, f"{type(error).__name__}: {error}".splitlines()[0])


@functools.cache
def _warn_once(tracker: str, folder: str, reason: str) -> None:
    print(
        f"tracking={tracker} does not work and is left out for {folder} ({reason[:200]}); once it works, the same "
        "command logs what is missing",
        flush=True,
    )


def _parameters(config: Tracked) -> dict[str, str]:
    values = flat(config.settings())
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()}


def _curves(progress: Row, evaluation: Row) -> dict[str, float]:
    return _numbers(progress, "train/") | _numbers(evaluation, "selection/")


def _numbers(row: Row, prefix: str) -> dict[str, float]:
    """Return the numbers of a row, of a CSV file's too, under prefixed names; what is no number is left out."""
    numbers = {}
    for name, value in row.items():
        try:
            numbers[f"{prefix}{name}"] = float(value == "True" if value in ("True", "False") else value)
        except (TypeError, ValueError):
            continue
    return numbers
