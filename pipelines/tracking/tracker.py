"""Runs logged to TensorBoard as well: settings, learning curves as they grow, final returns, the program.

Tracking is write-only and never affects a run. A tracker that fails is reported once and disabled until the run's end,
where its whole record is written from the run's files.
"""

import functools
import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from pipelines.engine.digests import digest, flat
from pipelines.engine.store import read_csv, write_text
from pipelines.errors import ConfigError

Row = Mapping[str, Any]


class Tracked(Protocol):
    """A run, or its training, as far as it is logged."""

    @property
    def tracking(self) -> str: ...
    @property
    def results_dir(self) -> str: ...
    @property
    def folder(self) -> str: ...
    @property
    def settings(self) -> Callable[[], dict[str, Any]]: ...


def check_tracking(config: Tracked) -> None:
    """Raise ConfigError where the tracker that is asked for cannot be used here, with what to do about it."""
    name = config.tracking
    if name != "none" and not find_spec(name):
        raise ConfigError(f"tracking={name} needs the extra {name}: pip install 'otr[{name}]'")


class Tracker:
    """Logs one run, `config.folder`; with tracking=none it does nothing. No method ever raises for a tracker's sake.

    Its record is event files under `results_dir/tensorboard`; `result.txt` there is the digest of the summary that was
    logged whole.
    """

    def __init__(self, config: Tracked) -> None:
        self._config = config
        self._folder = Path(config.results_dir) / "tensorboard" / config.folder.removeprefix("runs/")
        self._writer: Any = None
        self._is_off = config.tracking == "none"

    def segment_done(self, progress: Row, evaluation: Row) -> None:
        """Log a segment's rows of `progress.csv` and `evaluations.csv`."""
        self._try(lambda: self._log([(progress, evaluation)]))

    def catch_up(self, progress: Sequence[Row], evaluations: Sequence[Row]) -> None:
        """Begin the record of a training that starts or resumes, with what its checkpoint has."""
        self._try(lambda: self._begin(zip(progress, evaluations, strict=True)))

    def finish(self, summary: Mapping[str, Any], run_dir: Path) -> None:
        """Write the whole record of a finished run, unless it is there; a stage that is added later changes it."""
        self._is_off = self._config.tracking == "none"
        self._try(lambda: self._complete(summary, run_dir))

    def _begin(self, rows: Iterable[tuple[Row, Row]]) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._writer = None
        values = flat(self._config.settings())
        texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()}
        lines = [f"| {name} | {text} |" for name, text in texts.items()]
        self._write(0, {}, {"settings": "\n".join(["| setting | value |", "| --- | --- |", *lines])})
        self._log(rows)

    def _log(self, rows: Iterable[tuple[Row, Row]]) -> None:
        for progress, evaluation in rows:
            self._write(int(progress["steps"]), _numbers(progress, "train/") | _numbers(evaluation, "selection/"))

    def _complete(self, summary: Mapping[str, Any], run_dir: Path) -> None:
        note, result = self._folder / "result.txt", digest(summary)
        if note.is_file() and note.read_text(encoding="utf-8") == result:
            return
        tables: list[list[dict[str, str]]] = [[], []]
        if (run_dir / "train").is_dir():  # not of what imitates or is written
            tables = [read_csv(run_dir / "train" / f"{name}.csv") for name in ("progress", "evaluations")]
        self._begin(zip(*tables, strict=True))
        files = {"program": run_dir / "prune" / "program.txt", "config.yaml": run_dir / "config.yaml"}
        texts = {name: path.read_text(encoding="utf-8") for name, path in files.items() if path.is_file()}
        step = int(tables[0][-1]["steps"]) if tables[0] else 0
        self._write(step, _numbers(flat(summary), "final/"), {name: f"```\n{text}```" for name, text in texts.items()})
        self._writer.close()
        write_text(note, result)

    def _write(self, step: int, numbers: Mapping[str, float], texts: Mapping[str, str] | None = None) -> None:
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter  # torch takes seconds to import

            self._writer = SummaryWriter(str(self._folder))
        for name, number in numbers.items():
            self._writer.add_scalar(name, number, step)
        for name, text in (texts or {}).items():
            self._writer.add_text(name, text, step)
        self._writer.flush()

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


def _numbers(row: Row, prefix: str) -> dict[str, float]:
    """Return the numbers of a row, of a CSV file's too, under prefixed names; what is no number is left out."""
    numbers = {}
    for name, value in row.items():
        try:
            numbers[f"{prefix}{name}"] = float(value == "True" if value in ("True", "False") else value)
        except (TypeError, ValueError):
            continue
    return numbers
