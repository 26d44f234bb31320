"""Where a tracker writes to: TensorBoard's event files, MLflow's server. Both are imported when they are used only."""

import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.config.run import RunConfig
from pipelines.engine.store import read_json, write_json

MLFLOW_DEFAULTS = {  # for what the environment does not say
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # a server that is down costs seconds and not MLflow's own minutes
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_DISABLE_TELEMETRY": "true",
}
RUN_TAG, RESULT_TAG = "otr.run", "otr.result"  # which run it is; the digest of what it came to, once it is complete
STEPS = "train/steps"  # every row has it, so its latest value tells how far the record goes
MAX_PARAMETERS = 100  # in one request to MLflow


class TensorBoard:
    """Event files under `results_dir/tensorboard`, with a note of how far they go.

    `Mlflow` has the same methods. Either takes up the run's latest record again: `result` is the digest that `complete`
    was called with, None for a run under way; `start` begins a new record.
    """

    def __init__(self, config: RunConfig, parameters: Mapping[str, str]) -> None:
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


class Mlflow:
    """A run of MLflow's server, found again by a tag that holds the run's folder."""

    def __init__(self, config: RunConfig, parameters: Mapping[str, str]) -> None:
        for variable, value in MLFLOW_DEFAULTS.items():
            os.environ.setdefault(variable, value)
        from mlflow import MlflowClient  # takes seconds to import

        self._client = MlflowClient()
        self._run_dir = str((Path(config.results_dir) / config.folder).resolve())
        self._name = config.folder.removeprefix("runs/")
        self._experiment = self._experiment_id(os.environ.get("MLFLOW_EXPERIMENT_NAME", "otr"))
        quoted = self._run_dir.replace("'", "\\'")
        found = self._client.search_runs(
            [self._experiment], f"tags.`{RUN_TAG}` = '{quoted}'", order_by=["attributes.start_time DESC"], max_results=1
        )
        if found:
            self._run = found[0]
        else:
            self.start(parameters)

    def result(self) -> str | None:
        result: str | None = self._run.data.tags.get(RESULT_TAG)
        return result

    def last_step(self) -> int:
        return int(self._run.data.metrics.get(STEPS, 0))

    def start(self, parameters: Mapping[str, str]) -> None:
        from mlflow.entities import Param

        self._run = self._client.create_run(self._experiment, run_name=self._name, tags={RUN_TAG: self._run_dir})
        values = [Param(name, value) for name, value in parameters.items()]
        for i in range(0, len(values), MAX_PARAMETERS):
            self._client.log_batch(self._run.info.run_id, params=values[i : i + MAX_PARAMETERS])

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        from mlflow.entities import Metric

        now = int(1000 * time.time())
        metrics = [Metric(name, number, now, step) for name, number in numbers.items()]
        self._client.log_batch(self._run.info.run_id, metrics=metrics)

    def complete(self, step: int, numbers: Mapping[str, float], run_dir: Path, result: str) -> None:
        run_id = self._run.info.run_id
        self.log(step, numbers)
        for path in sorted(run_dir.rglob("*")):
            relative = path.relative_to(run_dir)
            if path.is_file() and not any(part.startswith(".") for part in relative.parts):
                folder = relative.parent.as_posix()
                self._client.log_artifact(run_id, str(path), None if folder == "." else folder)
        self._client.set_tag(run_id, RESULT_TAG, result)
        self._client.set_terminated(run_id)

    def _experiment_id(self, name: str) -> str:
        from mlflow.exceptions import MlflowException

        experiment = self._client.get_experiment_by_name(name)
        if experiment is None:
            try:
                return str(self._client.create_experiment(name))
            except MlflowException:  # another job was quicker
                experiment = self._client.get_experiment_by_name(name)
                if experiment is None:
                    raise
        return str(experiment.experiment_id)
