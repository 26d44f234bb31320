"""Configurations of finished runs that name settings which no longer exist."""

import pytest

from pipelines.cli.runs import CONFIG, load_config
from pipelines.engine.store import read_bytes
from pipelines.errors import PipelineError
from tests.committed import RESULTS


@pytest.mark.parametrize(("key", "now", "other"), [("critic_norm", "none", "layer"), ("actor_value", "min", "mean")])
def test_a_removed_setting_is_read_where_it_means_what_is_done_now_and_refused_elsewhere(tmp_path, key, now, other):
    run = RESULTS / "runs/halfcheetah/distilled_experts/depth-8/standard-shrink/seed-3"
    text = read_bytes(run / CONFIG).decode()
    assert f"{key}: {now}" in text
    (tmp_path / CONFIG).write_text(text)
    assert load_config(tmp_path, 1).algo.name == "sac"
    (tmp_path / CONFIG).write_text(text.replace(f"{key}: {now}", f"{key}: {other}"))
    with pytest.raises(PipelineError, match=key):
        load_config(tmp_path, 1)
