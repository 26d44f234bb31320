"""TensorBoard's event files of a run."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from pipelines.engine.store import read_json, write_json


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


class TensorBoard:
    """Event files under `results_dir/tensorboard`, with a note of how far they go.

    It goes on with the run's record where there is one: `result` is the digest that `complete` was called with, None
    for a run under way; `start` begins a new record.
    """

    def __init__(self, config: Tracked, parameters: Mapping[str, str]) -> None:
        self._folder = Path(config.results_dir) / "tensorboard" / config.folder.removeprefix("runs/")
        self._note = self._folder / "logged.json"
        self._writer: Any = None
        if not self._note.exists():
            self.start(parameters)

    def result(self) -> str | None:
        result: str | None = read_json(self._note)["result"]
        return result

    def last_step(self) -> int:
        return int(read_json(self._note)["steps"])

    def start(self, parameters: Mapping[str, str]) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        lines = [f"| {name} | {value} |" for name, value in parameters.items()]
        self._write(0, {}, {"settings": "\n".join(["| setting | value |", "| --- | --- |", *lines])})
        write_json(self._note, {"steps": 0, "result": None})

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        self._write(step, numbers)
        write_json(self._note, {"steps": step, "result": None})

    def complete(self, step: int, numbers: Mapping[str, float], run_dir: Path, result: str) -> None:
        files = {"program": run_dir / "prune" / "program.txt", "config.yaml": run_dir / "config.yaml"}
        texts = {name: path.read_text(encoding="utf-8") for name, path in files.items() if path.is_file()}
        self._write(step, numbers, {name: f"```\n{text}```" for name, text in texts.items()})
        self._writer.close()
        write_json(self._note, {"steps": step, "result": result})

    def _write(self, step: int, numbers: Mapping[str, float], texts: Mapping[str, str] | None = None) -> None:
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter  # torch takes seconds to import

            self._writer = SummaryWriter(str(self._folder))
        for name, number in numbers.items():
            self._writer.add_scalar(name, number, step)
        for name, text in (texts or {}).items():
            self._writer.add_text(name, text, step)
        self._writer.flush()
