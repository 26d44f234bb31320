"""Sweeps of fleets: grouped by themselves, under launchers, killed, and diverging."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from pipelines.engine.stage import run_stage_together
from pipelines.engine.store import read_json
from pipelines.runs.run_job import RunJob, run_jobs
from pipelines.stages.train import TRAIN
from tests.pipelines.conftest import otr_command, otr_succeeds
from tests.pipelines.sweeps import digests
from tests.pipelines.training.fleet.test_train import FLEET, WRAPPING_SAC

WORDS = ("-m", "env=pendulum", "depth=2,3", "seed=0,1,2", "budget=smoke", "trainer=fleet")


@pytest.fixture(scope="module")
def in_one_process(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleets")
    done = otr_succeeds("otr-run", *WORDS, cwd=folder)
    return folder / "results", done.stdout


def test_a_sweep_groups_what_can_train_together(in_one_process):
    results, printed = in_one_process
    assert len(re.findall(r"^train: pendulum, 3 runs: step 300/300", printed, re.MULTILINE)) == 2
    assert "6 jobs: 6 done, 0 failed" in printed
    runs = sorted(path.parent for path in results.glob("runs/**/summary.json"))
    names = [f"depth-{depth}/smoke-fleet/seed-{seed}" for depth in (2, 3) for seed in range(3)]
    assert [run.relative_to(results / "runs/pendulum/otr").as_posix() for run in runs] == names
    files = {f"{each}.safetensors" for each in ("actor", "critics")} | {"evaluations.csv", "progress.csv"}
    for run in runs:
        summary = read_json(run / "summary.json")
        assert (summary["trainer"], summary["budget"]) == ("fleet", "smoke")
        assert {path.name for path in (run / "train").iterdir()} == files | {"actor.json", "manifest.json"}
    assert not any((results / "checkpoints").iterdir())


def test_one_run_alone_and_other_company_leave_the_same_bytes(in_one_process, tmp_path):
    results, _ = in_one_process
    otr_succeeds("otr-run", *WORDS[1:2], "depth=3", "seed=1", *WORDS[4:], cwd=tmp_path)
    pairs = otr_command("otr-run", *WORDS[:2], "depth=2", *WORDS[3:], "trainer.runs_per_process=2", cwd=tmp_path)
    assert "pendulum, 2 runs" in pairs.stdout, pairs.stderr
    expected, found = digests(results), digests(tmp_path / "results")
    assert len(found) == len(expected) // 6 * 4
    assert found.items() <= expected.items()


def test_finished_and_busy_runs_are_left_out_of_a_fleet(tiny, tmp_path):
    configs = [tiny(seed=seed, trainer=FLEET, algo=WRAPPING_SAC) for seed in range(3)]
    jobs = [RunJob(config, f"runs/pendulum/otr/depth-4/smoke-fleet/seed-{config.seed}", "") for config in configs]
    assert run_jobs(jobs[:1]) == [None]
    before = (jobs[0].run_dir / "train" / "manifest.json").read_bytes()
    trained: list[list[int]] = []

    def recording(inputs, chosen, outs):
        trained.append([config.seed for config in chosen])
        for out in outs:
            (out / "actor.json").write_text("{}")
        return [None, ValueError("no")]

    stage = dataclasses.replace(TRAIN, together=recording)
    errors = run_stage_together(stage, [(job.run_dir, job.config) for job in jobs])
    assert trained == [[1, 2]]
    assert [str(error) for error in errors] == ["None", "None", "no"]
    assert (jobs[0].run_dir / "train" / "manifest.json").read_bytes() == before
    assert json.loads((jobs[1].run_dir / "train" / "manifest.json").read_text())["settings"]["seed"] == 1
    assert not (jobs[2].run_dir / "train").exists()
    assert not list(Path(configs[0].results_dir).glob("runs/**/.train.tmp"))
