"""Stages: skip, redo, refuse, and never a half artefact."""

import json
import multiprocessing
import time

import pytest

from pipelines.engine.stage import Stage, run_stage, stage_status, verified_manifest
from pipelines.errors import MissingInputError, OtherSettingsError, PipelineError


def write_seed(inputs, config, out):
    (out / "value.txt").write_text(f"{config.seed}\n")


def append_input(inputs, config, out):
    (out / "value.txt").write_text((inputs["first"] / "value.txt").read_text() + "then\n")


def slow_count(inputs, config, out):
    """Leave one line a call outside the stage's folder, so that calls can be counted."""
    with (out.parent.parent / "calls").open("a") as file:
        file.write("call\n")
    time.sleep(0.5)
    (out / "value.txt").write_text("done\n")


FIRST = Stage("first", 1, (), lambda config: {"seed": config.seed}, write_seed)
SECOND = Stage("second", 1, ("first",), lambda config: {}, append_input)
SLOW = Stage("slow", 1, (), lambda config: {}, slow_count)


def run_slow(run_dir, config):
    run_stage(SLOW, run_dir, config, "")


def test_second_call_skips_and_keeps_the_files(tiny, tmp_path):
    folder = tmp_path / "run/first"
    assert stage_status(FIRST, folder, tiny()) == "missing"
    once = run_stage(FIRST, tmp_path / "run", tiny(), "")
    inode = (once.folder / "value.txt").stat().st_ino
    again = run_stage(FIRST, tmp_path / "run", tiny(), "")
    assert (once.skipped, again.skipped) == (False, True)
    assert (again.folder / "value.txt").stat().st_ino == inode
    assert stage_status(FIRST, folder, tiny()) == "done"
    assert stage_status(FIRST, folder, tiny(seed=1)) == "other settings"
    assert stage_status(Stage("first", 2, (), FIRST.keyed, write_seed), folder, tiny()) == "stale"


def test_changed_input_makes_the_stage_again(tiny, tmp_path):
    run_stage(FIRST, tmp_path / "run", tiny(), "")
    run_stage(SECOND, tmp_path / "run", tiny(), "")
    newer = Stage("first", 2, (), FIRST.keyed, lambda i, c, out: (out / "value.txt").write_text("new\n"))
    run_stage(newer, tmp_path / "run", tiny(), "")
    assert not run_stage(SECOND, tmp_path / "run", tiny(), "").skipped
    assert (tmp_path / "run/second/value.txt").read_text() == "new\nthen\n"
    with pytest.raises(OtherSettingsError, match="seed: there was 0, asked for 7"):
        run_stage(newer, tmp_path / "run", tiny(seed=7), "")
    assert (tmp_path / "run/first/value.txt").read_text() == "new\n"


def test_missing_inputs_tampered_outputs_and_truncated_manifests_are_clear_errors(tiny, tmp_path):
    with pytest.raises(MissingInputError, match="otr-run env=pendulum"):
        run_stage(SECOND, tmp_path / "run", tiny(), "otr-run env=pendulum")
    run_stage(FIRST, tmp_path / "run", tiny(), "")
    (tmp_path / "run/first/value.txt").write_text("1\n")
    for stage in (FIRST, SECOND):
        with pytest.raises(PipelineError, match=r"value\.txt is not what was written"):
            run_stage(stage, tmp_path / "run", tiny(), "")
    for text, message in (('{"stage": ', "delete the folder"), ("{}", "it has no key")):
        (tmp_path / "run/first/manifest.json").write_text(text)
        with pytest.raises(PipelineError, match=message):
            run_stage(FIRST, tmp_path / "run", tiny(), "")
    (tmp_path / "run2").mkdir()
    assert not run_stage(FIRST, tmp_path / "run2", tiny(), "").skipped  # a damaged sibling stops nobody else


def test_failing_stage_leaves_nothing(tiny, tmp_path):
    def fail(inputs, config, out):
        (out / "half.txt").write_text("half")
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        run_stage(Stage("bad", 1, (), lambda config: {}, fail), tmp_path / "run", tiny(), "")
    assert [path.name for path in (tmp_path / "run").iterdir() if path.is_dir()] == []


def test_sibling_with_the_same_key_is_taken_over(tiny, tmp_path):
    run_stage(SLOW, tmp_path / "seed-0", tiny(), "")
    result = run_stage(SLOW, tmp_path / "seed-0~1234", tiny(), "")
    assert result.skipped
    assert verified_manifest(tmp_path / "seed-0~1234/slow") == verified_manifest(tmp_path / "seed-0/slow")
    assert (tmp_path / "calls").read_text().count("call") == 1


def test_two_processes_do_a_job_once(tiny, tmp_path):
    config = tiny()
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=run_slow, args=(tmp_path / "run", config)) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    assert [worker.exitcode for worker in workers] == [0, 0, 0]
    assert (tmp_path / "calls").read_text().count("call") == 1


def test_manifest_records_origin_but_key_ignores_it(tiny, tmp_path, monkeypatch):
    run_stage(FIRST, tmp_path / "a/run", tiny(), "")
    monkeypatch.setattr("pipelines.engine.provenance.git_revision", lambda: "another")
    run_stage(FIRST, tmp_path / "b/run", tiny(), "")
    one, two = (json.loads((tmp_path / side / "run/first/manifest.json").read_text()) for side in "ab")
    assert two["git_revision"] == "another"
    assert one["key"] == two["key"]
    assert set(one["versions"]) >= {"python", "torch", "stable-baselines3", "gymnasium", "numpy"}


def test_checkpoints_go_once_the_result_is_in_its_place(tiny, tmp_path):
    checkpoints, n_calls = tmp_path / "checkpoints", 0

    def killed_at_first(inputs, config, out):
        nonlocal n_calls
        n_calls += 1
        checkpoints.mkdir(exist_ok=True)
        (out / "value.txt").write_text("done\n")
        if n_calls == 1:
            raise KeyboardInterrupt

    stage = Stage("third", 1, (), lambda config: {}, killed_at_first, checkpoints=lambda config, inputs: checkpoints)
    with pytest.raises(KeyboardInterrupt):
        run_stage(stage, tmp_path / "run", tiny(), "")
    assert checkpoints.exists()
    run_stage(stage, tmp_path / "run", tiny(), "")
    assert not checkpoints.exists()
    checkpoints.mkdir()  # as a kill between the two leaves it
    assert run_stage(stage, tmp_path / "run", tiny(), "").skipped and not checkpoints.exists()
