"""Methods that imitate an oracle: who trains it, what is left, what goes on after a kill, what is refused."""

import json
import shutil

import numpy as np
import pytest

from pipelines.config.methods import AugTreeConfig, ViperConfig
from pipelines.engine.seeding import FIRST_STREAM_SEED, STREAMS, episode_seeds
from pipelines.engine.store import read_csv
from pipelines.errors import ConfigError, PipelineError
from pipelines.stages import imitate as stage
from pipelines.stages.evaluate import likeness
from pipelines.stages.oracle import load_oracle
from tests.pipelines.conftest import otr_command, otr_succeeds

SWEEP = ("-m", "env=lunarlander", "method=viper,augtree", "depth=2", "oracle=[8]", "budget=smoke")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two methods with one oracle, and what the sweep printed."""
    folder = tmp_path_factory.mktemp("imitated")
    done = otr_succeeds("otr-run", *SWEEP, cwd=folder)
    return folder, done.stdout


def runs(folder):
    return {path.parents[2].name: path for path in folder.glob("results/runs/lunarlander/*/depth-2/smoke/*")}


def test_methods_share_one_oracle(finished):
    folder, printed = finished
    trained = folder / "results/runs/lunarlander/otr/depth-8/smoke/seed-0/train"
    digests = set()
    for run in runs(folder).values():
        about = json.loads((run / "oracle/oracle.json").read_text())
        assert folder / "results" / about["folder"] == trained
        digests.add(about["output_digest"])
    assert digests == {json.loads((trained / "manifest.json").read_text())["output_digest"]}
    assert printed.count("train: step") == 1
    assert sorted(runs(folder)) == ["augtree", "viper"]


def test_runs_leave_every_artefact_and_no_working_files(finished):
    folder, printed = finished
    for run in runs(folder).values():
        files = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
        assert files >= {
            "config.yaml", "summary.json", "oracle/oracle.json", "imitate/tree.npz", "imitate/program.txt",
            "imitate/iterates.csv", "imitate/report.json", "prune/tree.npz", "evaluate/episodes.csv",
            "evaluate/episodes_oracle.csv", "evaluate/episodes_pruned_tree.csv",
        }  # fmt: skip
        summary = json.loads((run / "summary.json").read_text())
        assert summary["oracle"]["hidden_widths"] == [8]
        assert 0.0 <= summary["oracle"]["equal_labels"] <= 1.0
        assert summary["n_leaves"] <= 4
        rows = read_csv(run / "imitate/iterates.csv")
        assert [row["chosen"] for row in rows].count("True") == 1 and len(rows) == 3
    assert not list((folder / "results/checkpoints").iterdir())
    assert "the tree chooses as the oracle does in" in printed


def test_recorded_episodes_come_back(finished):
    folder, _ = finished
    done = otr_succeeds("otr-tabulate", "table=4.1", "evaluate=true", cwd=folder)
    assert done.stdout.count("as recorded") == 6


def test_plan_trains_a_shared_oracle_once(tmp_path):
    done = otr_command("otr-plan", *SWEEP[:-1], "budget=quick", "seed=0,1", cwd=tmp_path, COLUMNS="200")
    oracle = "oracle lunarlander/otr/depth-8/quick/seed-"
    assert done.stdout.count(f"train {oracle}") == 2, done.stdout
    assert done.stdout.count("as above") == 2


def test_fleet_trains_several_oracles_at_once(tmp_path):
    words = ("-m", "env=pendulum", "method=viper", "depth=2", "oracle=[8]", "seed=0,1", "budget=smoke", "trainer=fleet")
    done = otr_succeeds("otr-run", *words, cwd=tmp_path)
    assert "pendulum, 2 runs" in done.stdout
    assert len(list(tmp_path.glob("results/runs/pendulum/otr/depth-8/smoke-fleet/seed-*/train/manifest.json"))) == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": 0}, "depth=0: method=viper grows a tree"),
        ({"depth": [2, 2]}, r"depth=\[2, 2\]: method=viper grows a tree"),
        ({"oracle": []}, r"oracle=\[\]"),
        (
            {"method": AugTreeConfig("augtree", features="deep", max_samples=10), "oracle": [8]},
            "features=deep",
        ),
    ],
)
def test_what_is_refused(tiny, changes, words):
    with pytest.raises(ConfigError, match=words):
        tiny(**{"method": ViperConfig("viper", max_samples=100), **changes})


def test_an_oracle_that_was_replaced_is_not_taken_for_the_old_one(finished, tmp_path):
    shutil.copytree(finished[0] / "results", tmp_path / "results")
    reference, results = runs(tmp_path)["viper"] / "oracle", tmp_path / "results"
    folder = results / "runs/lunarlander/otr/depth-8/smoke/seed-0/train"
    about = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**about, "output_digest": "other"}))
    with pytest.raises(PipelineError, match="another oracle"):
        load_oracle(reference, results)
    shutil.rmtree(folder)
    with pytest.raises(PipelineError, match="is gone"):
        load_oracle(reference, results)


def test_no_episode_serves_two_purposes():
    seeds = [
        seed
        for element in stage.STREAM_ELEMENTS.values()
        for index in range(60)
        for seed in episode_seeds(0, "imitate", 25, element, index)
    ] + [seed for name in ("selection", "prune") for seed in episode_seeds(0, name, 100)]
    assert len(set(seeds)) == len(seeds) and min(seeds) >= FIRST_STREAM_SEED
    assert sorted(STREAMS.values()) == list(range(len(STREAMS)))


def test_likeness_of_known_answers():
    assert likeness(np.array([0, 1, 2, 2]), np.array([0, 1, 2, 0])) == {"equal_labels": 0.75}
    assert likeness(np.array([[1.0], [2.0]]), np.array([[1.5], [1.0]])) == {"mean_difference": 0.75}
