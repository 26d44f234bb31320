"""Stage oracle: which network a run imitates.

The oracle of a run is the actor of another run: method=otr with depth=<the oracle's layers>, of the same environment,
budget, seed and settings of training; or that of a run with method=model, which imports it. Whichever run needs it
first trains or imports it; the others find it there. This stage
records where it is and its digest, so that what is made from it is keyed by its content.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from otr.core.smooth_network import Oracle
from pipelines.config.run import RunConfig
from pipelines.engine.archive import MANIFEST, verified_manifest
from pipelines.engine.stage import Inputs, Stage, part_of
from pipelines.engine.store import exists, read_csv, read_json, write_json
from pipelines.errors import PipelineError
from pipelines.play.actor_files import load_oracle_network
from pipelines.stages.import_model import ImportSettings, import_keys
from pipelines.training.settings import TrainSettings, train_keys

REFERENCE = "oracle.json"


@dataclass(frozen=True)
class OracleSettings:
    """What the stage reads of a run's configuration."""

    oracle_run: RunConfig
    oracle: list[int]
    results_dir: str


def oracle_keys(settings: OracleSettings) -> dict[str, Any]:
    """Return what decides the oracle: the settings of its training, or the file that it is imported from."""
    run = settings.oracle_run
    return train_keys(part_of(run, TrainSettings)) if run.is_trained else import_keys(part_of(run, ImportSettings))


def refer(inputs: Inputs, settings: OracleSettings, out: Path) -> None:
    """Write `oracle.json`: the trained oracle's folder below the results, its digest and its selection return."""
    run = settings.oracle_run
    folder = Path(run.folder) / run.method.actor_stage
    made = Path(settings.results_dir) / folder
    about: dict[str, Any] = {
        "folder": folder.as_posix(),
        "output_digest": verified_manifest(made)["output_digest"],
        "hidden_widths": list(settings.oracle),
    }
    if run.imported is not None:
        about["model"] = run.imported.name
    else:
        evaluations = read_csv(made / "evaluations.csv")
        about["selection_return"] = max(float(row["return_mean"]) for row in evaluations)
    write_json(out / REFERENCE, about)


def load_oracle(reference: Path, results_dir: Path) -> Oracle:
    """Return the network that the stage's folder names; PipelineError where it is gone or was replaced."""
    about = read_json(reference / REFERENCE)
    folder = results_dir / about["folder"]
    if not exists(folder / MANIFEST):
        raise PipelineError(f"the oracle {folder} is gone; delete {reference} and run the same command to train it")
    if verified_manifest(folder)["output_digest"] != about["output_digest"]:
        raise PipelineError(f"{folder} holds another oracle than the run's; delete {reference} to imitate that one")
    return load_oracle_network(folder)


ORACLE = Stage(
    "oracle", version=1, inputs=(), keyed=oracle_keys, run=refer, settings=OracleSettings, is_of_other_job=True
)
