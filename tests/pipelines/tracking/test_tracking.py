"""The tracker: what it is given, what a resumed or finished run adds, and what one that fails costs (nothing)."""

import dataclasses
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils import tensorboard

from pipelines.config.run import run_folder
from pipelines.engine.store import read_csv, read_json
from pipelines.errors import ConfigError
from pipelines.runs.run_job import RunJob, run_job
from pipelines.tracking import tracker as tracking
from pipelines.tracking.tracker import Tracker, check_tracking

FOLDER = "runs/pendulum/otr/depth-4/smoke/seed-0"


@pytest.fixture
def tracked(tiny):
    tracking._warn_once.cache_clear()
    return RunJob(tiny(tracking="tensorboard", folder=FOLDER), FOLDER, "")


def place(job):
    return Path(job.config.results_dir) / "tensorboard" / FOLDER.removeprefix("runs/")


def curve(job, name):
    """Return the steps and the numbers of a curve that TensorBoard reads."""
    events = EventAccumulator(str(place(job)))
    events.Reload()
    points = events.Scalars(name) if name in events.Tags()["scalars"] else []
    return [(point.step, pytest.approx(point.value, rel=1e-6)) for point in points]


def evaluated(job):
    rows = read_csv(job.run_dir / "train" / "evaluations.csv")
    return [(int(row["steps"]), float(row["return_mean"])) for row in rows]


def test_run_is_logged_as_it_goes_and_once_with_the_stages_added_later(tracked, monkeypatch):
    steps, log = [], Tracker._log
    monkeypatch.setattr(Tracker, "_log", lambda self, rows: log(self, [steps.append(r[0]["steps"]) or r for r in rows]))
    summary = run_job(tracked)
    assert [int(step) for step in steps] == [100, 200, 300] * 2  # and the whole record at the end
    assert evaluated(tracked) == curve(tracked, "selection/return_mean")
    assert [step for step, _ in curve(tracked, "train/steps_per_s")] == [100, 200, 300]
    assert curve(tracked, "final/return_mean") == [(300, summary["return_mean"])]
    pruned = summary["policies"]["pruned_tree"]["return_mean"]
    assert curve(tracked, "final/policies.pruned_tree.return_mean") == [(300, pruned)]
    run_job(tracked)  # finished and logged: nothing anew
    assert len(steps) == 6
    certified = dataclasses.replace(tracked, config=dataclasses.replace(tracked.config, certify=True))
    for _ in range(2):
        run_job(certified)
        assert len(steps) == 9 and curve(tracked, "final/certify.certified") == [(300, 1.0)]


def test_a_training_that_resumes_has_its_record_once(tracked):
    for done in ([], [100], [100, 200]):
        rows = [{"steps": step, "seconds": 1.5, "best": True} for step in done]
        tracker = Tracker(tracked.config)
        tracker.catch_up(rows, rows)
        tracker.segment_done({"steps": len(done) * 100 + 100}, {"steps": 0})
    assert [step for step, _ in curve(tracked, "train/steps")] == [100, 200, 300]
    assert curve(tracked, "selection/best") == [(100, 1.0), (200, 1.0)]


@pytest.mark.parametrize("n_written", [0, 12])  # from the beginning, and after the first segment
def test_tracker_that_fails_warns_once_and_catches_up_at_the_end(tracked, monkeypatch, capsys, n_written):
    writer, left = tensorboard.SummaryWriter, [n_written]

    class Failing(writer):
        def add_scalar(self, *arguments):
            left[0] -= 1
            if left[0] < 0:
                raise ConnectionError("no server there")
            super().add_scalar(*arguments)

    monkeypatch.setattr(tensorboard, "SummaryWriter", Failing)
    assert run_job(tracked)["n_episodes"] == 3
    printed = capsys.readouterr().out
    assert printed.count("does not work and is left out") == 1 and "ConnectionError: no server there" in printed
    monkeypatch.setattr(tensorboard, "SummaryWriter", writer)
    run_job(tracked)
    assert curve(tracked, "selection/return_mean") == evaluated(tracked)


def test_a_finished_run_without_a_printed_program_is_logged_whole(tracked, capsys):
    run_job(dataclasses.replace(tracked, config=dataclasses.replace(tracked.config, tracking="none")))
    (tracked.run_dir / "prune" / "program.txt").unlink()  # as of a tree that is too large to be printed
    summary = read_json(tracked.run_dir / "summary.json")
    Tracker(tracked.config).finish(summary, tracked.run_dir)
    assert "does not work" not in capsys.readouterr().out
    assert curve(tracked, "selection/return_mean") == evaluated(tracked)
    events = EventAccumulator(str(place(tracked)))
    events.Reload()
    (text,) = events.Tensors("settings/text_summary")
    assert "| algo.learning_rate | 0.001 |" in text.tensor_proto.string_val[0].decode()
    before = sorted(path.name for path in place(tracked).iterdir())
    Tracker(tracked.config).finish(summary, tracked.run_dir)
    assert sorted(path.name for path in place(tracked).iterdir()) == before


def test_tracking_is_no_part_of_a_run_and_what_there_is_not_is_named(tiny, monkeypatch):
    tracked = tiny(tracking="tensorboard", folder=FOLDER)
    assert tracked.settings() == tiny().settings() and run_folder(tracked, {}) == FOLDER
    with pytest.raises(ConfigError, match="tracking=wandb: use one of none, tensorboard"):
        tiny(tracking="wandb")
    check_tracking(tiny())
    monkeypatch.setattr(tracking, "find_spec", lambda module: None)
    with pytest.raises(ConfigError, match=r"pip install 'otr\[tensorboard\]'"):
        check_tracking(tracked)
