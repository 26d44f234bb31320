"""The time left of a training is measured, from the first step that learns on."""

import pytest

from pipelines.engine.time_left import Pace
from pipelines.training import progress
from pipelines.training.progress import TrainingProgress


def test_random_steps_and_the_first_moments_tell_nothing():
    pace = Pace(first_step=100, rollout_steps=1)
    for step in range(101):
        pace.at_step(step, step / 1_000)  # a thousand random steps a second
    assert pace.seconds(500) is None
    pace.at_step(103, 0.1 + 2)  # a step a second, for two seconds
    assert pace.seconds(500) is None
    pace.at_step(111, 0.1 + 10)  # of the last one the update is to come
    assert pace.seconds(500) == pytest.approx(500)
    pace.at_step(111, 0.1 + 22)  # after its update and an evaluation, which takes its time, too
    assert pace.seconds(500) == pytest.approx(1_000)


def test_a_rollout_counts_with_its_update():
    pace = Pace(first_step=0, rollout_steps=8)
    pace.at_step(0, 0.0)
    for step in range(1, 9):
        pace.at_step(step, 0.5 * step)
    pace.at_step(9, 0.5 * 9 + 20)  # the update lies between the two rollouts
    assert pace.seconds(80) == pytest.approx(10 * 24.5)
    pace.at_step(15, 28.0)  # half a rollout more tells nothing
    assert pace.seconds(80) == pytest.approx(10 * 24.5)


def test_lines_say_that_the_time_left_is_being_measured(tiny, monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with TrainingProgress(tiny(), 0) as shown:  # 100 of 300 steps are random
        for step, seconds, said in ((100, 0.1, "measuring"), (200, 50.1, "50 s left"), (300, 99.0, "0.0 s")):
            now = seconds
            shown.at_step(step)
            shown.segment_done({"steps": step, "steps_per_s": 2.0}, {"best": False, "return_mean": 1.0})
            assert said in capsys.readouterr().out
