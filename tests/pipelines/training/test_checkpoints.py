"""Checkpoints as they are read while a training goes on."""

import json
from pathlib import Path

import pytest

from pipelines.errors import PipelineError
from pipelines.training import checkpoints
from pipelines.training.checkpoints import evaluations_so_far


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_no_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert evaluations_so_far(tmp_path) == ([], 0)
    for n in (1, 2):
        (tmp_path / f"segment-{n:06d}").mkdir()
    about = {"evaluations": [{"steps": 20}], "counters": {"num_timesteps": 20}}
    (tmp_path / "segment-000002/history.json").write_text(json.dumps(about))
    seen = iter(["segment-000001", "segment-000002", "segment-000002"])
    monkeypatch.setattr(checkpoints, "last_segment", lambda folder: folder / next(seen))
    assert evaluations_so_far(tmp_path) == ([{"steps": 20}], 20)
    monkeypatch.setattr(checkpoints, "last_segment", lambda folder: folder / "segment-000001")
    with pytest.raises(PipelineError, match=r"history\.json is not there"):  # it stays, and is broken
        evaluations_so_far(tmp_path)
