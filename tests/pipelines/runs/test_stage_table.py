"""What stages are given and keyed by: parts of a run's configuration, and what committed results were keyed by."""

import dataclasses
import json

import pytest

from pipelines.cli.runs import load_config
from pipelines.config.run import RunConfig
from pipelines.engine.archive import MANIFEST, read_manifest
from pipelines.engine.store import exists
from pipelines.runs.stage_table import STAGES, stages_of
from tests.committed import RESULTS


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
def test_a_stage_is_given_a_part_of_the_configuration_under_its_names(stage):
    assert stage.settings is not None and not issubclass(stage.settings, RunConfig)
    given = {field.name for field in dataclasses.fields(stage.settings)}
    assert given <= {*dir(RunConfig), *(field.name for field in dataclasses.fields(RunConfig))}
    assert not given & {"algo", "train"} or stage.name in ("train", "harden")  # who trained is no later stage's matter


def committed_runs():
    """Return a run of each method and trainer."""
    found = {}
    for summary in sorted((RESULTS / "runs").glob("*/*/depth-*/*/seed-0/summary.json")):
        _, method, _, level, _ = summary.relative_to(RESULTS / "runs").parts[:5]
        found.setdefault(f"{method} {level.partition('-')[2]}".strip(), summary.parent)
    return found


@pytest.mark.parametrize("folder", committed_runs().values(), ids=committed_runs())
def test_committed_stages_are_found_by_the_keys_of_today(folder):
    """Also where settings are younger; of an oracle, and of who polished by critics, only the command tells."""
    config, found = load_config(folder, None), 0
    for name, stage in stages_of(config.method.name).items():
        if name not in ("oracle", "polish") and exists(folder / name / MANIFEST):
            recorded = read_manifest(folder / name)["settings"]
            assert json.loads(json.dumps(stage.keyed(stage.of(config)))) == recorded, name
            found += 1
    assert found >= 3
