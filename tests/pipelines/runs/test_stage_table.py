"""What stages are given and keyed by: parts of a run's configuration, and what committed results were keyed by."""

import dataclasses
import json

import pytest

from pipelines.cli.runs import load_config
from pipelines.config.methods import METHODS
from pipelines.config.run import RunConfig
from pipelines.engine.archive import MANIFEST, read_manifest
from pipelines.engine.store import exists
from pipelines.runs.stage_table import STAGES, stages_of
from tests.committed import RESULTS

NOT_COMMITTED = {"distilled_experts", "experts", "model", "program"}  # methods


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
def test_a_stage_is_given_a_part_of_the_configuration_under_its_names(stage):
    assert stage.settings is not None and not issubclass(stage.settings, RunConfig)
    given = {field.name for field in dataclasses.fields(stage.settings)}
    assert given <= {*dir(RunConfig), *(field.name for field in dataclasses.fields(RunConfig))}
    assert not given & {"algo", "train"} or stage.name in ("train", "harden")  # who trained is no later stage's matter


@pytest.mark.parametrize("method", sorted(METHODS.keys() - NOT_COMMITTED))
def test_committed_stages_are_found_by_the_keys_of_today(method):
    """One run of a method; what its oracle was, and who polished by critics, only the command that made it tells."""
    folder = min((RESULTS / "runs").glob(f"*/{method}/depth-*/*/seed-0/summary.json")).parent
    config, found = load_config(folder, None), 0
    for name, stage in stages_of(method).items():
        if name not in ("oracle", "polish") and exists(folder / name / MANIFEST):
            recorded = read_manifest(folder / name)["settings"]
            assert json.loads(json.dumps(stage.keyed(stage.of(config)))) == recorded, name
            found += 1
    assert found >= 3
