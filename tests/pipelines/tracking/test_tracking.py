"""The tracker: what it is given, what a resumed or finished run adds, and what one that fails costs (nothing)."""

import dataclasses
from pathlib import Path

import pytest

from pipelines.config.run import run_folder
from pipelines.engine.store import read_csv, read_json
from pipelines.errors import ConfigError
from pipelines.runs.run_job import RunJob, run_job
from pipelines.tracking import tracker as tracking
from pipelines.tracking.tracker import Tracker, check_tracking

FOLDER = "runs/pendulum/otr/depth-4/smoke/seed-0"


class FakeBackend:
    def __init__(self):
        self.started, self.rows, self.final, self.known_result, self.fails = 0, [], [], None, False

    def __call__(self, config, parameters):
        if self.fails:
            raise ConnectionError("no server there")
        return self

    def result(self):
        return self.known_result

    def last_step(self):
        return self.rows[-1][0] if self.rows else 0

    def start(self, parameters):
        self.started += 1
        self.rows, self.known_result = [], None

    def log(self, step, numbers):
        if self.fails:
            raise ConnectionError("the server has gone")
        self.rows.append((step, numbers))

    def complete(self, step, numbers, run_dir, result):
        self.final.append((step, numbers))
        self.known_result = result


@pytest.fixture
def backend(monkeypatch):
    fake = FakeBackend()
    monkeypatch.setattr(tracking, "TensorBoard", fake)
    tracking._warn_once.cache_clear()
    return fake


@pytest.fixture
def tracked(tiny):
    return RunJob(tiny(tracking="tensorboard", folder=FOLDER), FOLDER, "")


def test_run_is_logged_as_it_goes_and_once_with_the_stages_added_later(backend, tracked):
    summary = run_job(tracked)
    written = read_csv(tracked.run_dir / "train" / "evaluations.csv")
    assert [(step, numbers["selection/return_mean"]) for step, numbers in backend.rows] == [
        (step, float(row["return_mean"])) for step, row in zip((100, 200, 300), written, strict=True)
    ]
    assert set(backend.rows[1][1]) >= {"train/steps", "train/steps_per_s", "selection/return_mean", "selection/best"}
    ((step, final),) = backend.final
    assert (step, final["final/return_mean"]) == (300, summary["return_mean"])
    assert final["final/policies.pruned_tree.return_mean"] == summary["policies"]["pruned_tree"]["return_mean"]
    run_job(tracked)  # finished and logged: nothing anew
    assert len(backend.rows) == 3 and len(backend.final) == 1
    certified = dataclasses.replace(tracked, config=dataclasses.replace(tracked.config, certify=True))
    for _ in range(2):
        run_job(certified)
        assert len(backend.rows) == 3 and len(backend.final) == 2
    assert backend.final[1][1]["final/certify.certified"] == 1.0


def test_rows_that_were_logged_are_skipped_and_a_run_made_anew_gets_a_new_record(backend, tracked):
    backend.rows = [(100, {}), (200, {})]
    tracker = Tracker(tracked.config)
    for steps in (100, 200, 300):
        tracker.segment_done({"steps": steps, "seconds": 1.5}, {"steps": steps, "best": True})
    assert [step for step, _ in backend.rows] == [100, 200, 300]
    assert backend.rows[2][1] == {
        "train/steps": 300, "train/seconds": 1.5, "selection/steps": 300, "selection/best": 1.0}  # fmt: skip
    backend.rows, backend.known_result = [(300, {})], "of the run that was deleted"  # and is made anew
    Tracker(tracked.config).segment_done({"steps": 100}, {"steps": 100})
    assert backend.started == 1 and [step for step, _ in backend.rows] == [100]


def test_tracker_that_fails_warns_once_and_costs_nothing(backend, tracked, capsys):
    backend.fails = True
    assert run_job(tracked)["n_episodes"] == 3
    printed = capsys.readouterr().out
    assert printed.count("does not work and is left out") == 1
    assert "ConnectionError: no server there" in printed
    backend.fails = False
    run_job(tracked)
    assert [step for step, _ in backend.rows] == [100, 200, 300]


def test_tracker_that_fails_midway_catches_up_at_the_end(backend, tracked):
    class Once(list):
        def append(self, row):
            if len(self) == 1 and not backend.started:
                backend.started = 1
                raise ConnectionError("a moment's trouble")
            super().append(row)

    backend.rows = Once()
    run_job(tracked)
    assert [step for step, _ in backend.rows] == [100, 200, 300]


def test_tensorboard_reads_the_curves_of_a_finished_run_without_a_printed_program(tracked, capsys):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run_job(dataclasses.replace(tracked, config=dataclasses.replace(tracked.config, tracking="none")))
    (tracked.run_dir / "prune" / "program.txt").unlink()  # as of a tree that is too large to be printed
    summary = read_json(tracked.run_dir / "summary.json")
    Tracker(tracked.config).finish(summary, tracked.run_dir)
    assert "does not work" not in capsys.readouterr().out
    folder = Path(tracked.config.results_dir) / "tensorboard" / FOLDER.removeprefix("runs/")
    events = EventAccumulator(str(folder))
    events.Reload()
    rows = read_csv(tracked.run_dir / "train" / "evaluations.csv")
    curve = [(point.step, point.value) for point in events.Scalars("selection/return_mean")]
    assert curve == [(int(row["steps"]), pytest.approx(float(row["return_mean"]), rel=1e-6)) for row in rows]
    (final,) = events.Scalars("final/return_mean")
    assert (final.step, final.value) == (300, pytest.approx(summary["return_mean"], rel=1e-6))
    (text,) = events.Tensors("settings/text_summary")
    assert "| algo.learning_rate | 0.001 |" in text.tensor_proto.string_val[0].decode()
    assert read_json(folder / "logged.json")["result"] is not None
    before = sorted(path.name for path in folder.iterdir())
    Tracker(tracked.config).finish(summary, tracked.run_dir)
    assert sorted(path.name for path in folder.iterdir()) == before


def test_tracking_is_no_part_of_a_run_and_what_there_is_not_is_named(tiny, monkeypatch):
    tracked = tiny(tracking="tensorboard", folder=FOLDER)
    assert tracked.settings() == tiny().settings() and run_folder(tracked, {}) == FOLDER
    with pytest.raises(ConfigError, match="tracking=wandb: use one of none, tensorboard"):
        tiny(tracking="wandb")
    check_tracking(tiny())
    monkeypatch.setattr(tracking, "find_spec", lambda module: None)
    with pytest.raises(ConfigError, match=r"pip install 'otr\[tensorboard\]'"):
        check_tracking(tracked)
