"""Training by direct search: it learns, keeps the best, chooses among its first searches, and survives a kill."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from pipelines.config.env import EnvConfig
from pipelines.config.stages import ActorConfig, TrainConfig
from pipelines.engine.store import read_csv
from pipelines.errors import ConfigError
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import play_seeds
from pipelines.stages.train import checkpoint_folder
from pipelines.training.search import train_by_search as train_module
from pipelines.training.search.train_by_search import SearchRun, train_by_search
from tests.pipelines.conftest import ARS

CARTPOLE = EnvConfig("cartpole", "cartpole", "CartPole-v1")
RESULTS = ("actor.safetensors", "actor.json", "evaluations.csv")


@pytest.fixture
def search_run(tiny):
    def make(**changes):
        actor = ActorConfig(0.0, dense="input")
        return tiny(**{"env": CARTPOLE, "algo": ARS, "actor": actor, "train": TrainConfig(3_000, 700, 3, 0), **changes})

    return make


def train(config, out):
    out.mkdir(parents=True)
    train_by_search(config, checkpoint_folder(config), out)
    return out


def test_learns_and_keeps_the_best_evaluation(search_run, tmp_path):
    out = train(search_run(train=TrainConfig(20_000, 2_000, 5, 0)), tmp_path / "out")
    evaluations = read_csv(out / "evaluations.csv")
    assert max(float(row["return_mean"]) for row in evaluations) > 300  # one that does nothing stands for ten steps
    network = load_actor(out)
    assert play_seeds(network.predict, CARTPOLE, range(20)).returns.mean() > 250
    assert network.dense == "input" and network.n_hidden == 4


@pytest.mark.parametrize("start_steps", [600, 50_000])  # the second: more than the run's 20,000 have room for
def test_the_best_of_the_first_searches_goes_on(search_run, tmp_path, start_steps):
    algo = dataclasses.replace(ARS, n_starts=3, start_steps=start_steps)
    config = search_run(algo=algo, train=TrainConfig(20_000, 2_000, 5, 0))
    checkpoints = checkpoint_folder(config)
    checkpoints.mkdir(parents=True)
    run, scores, first_networks = SearchRun(config, checkpoints), [], []

    silent = SimpleNamespace(at_step=lambda step: None)
    with_episodes = train_module.Player(CARTPOLE, "gymnasium")
    while run._start < 3:
        if run._search.n_steps == 0:
            first_networks.append(run._search.network.weights[0])
        before = run._start, run._search
        run.evaluate(with_episodes, run.segment(with_episodes, silent))
        if run._start != before[0]:
            scores.append((run.history.evaluations[-1]["return_mean"], before[1].state()))
    assert len(scores) == 3
    assert run.n_steps < config.train.steps
    best = max(scores, key=lambda each: each[0])[1]
    assert np.array_equal(run._search.state()["centre"], best["centre"])
    assert not np.array_equal(first_networks[0], first_networks[1])


def test_what_is_refused(search_run, tiny):
    for make, changes, message in (
        (search_run, {"depth": 33}, "depth=33: algo=ars searches small networks"),
        (search_run, {"depth": [4, 4, 4]}, "up to 2 layers"),
        (search_run, {"algo": dataclasses.replace(ARS, n_top=5)}, r"algo\.n_top=5 is more than algo.n_directions=4"),
        (search_run, {"actor": ActorConfig(0.0, rescale_inputs=True)}, "normalises states itself"),
        (tiny, {"actor": ActorConfig(0.0, dense="input")}, r"actor\.dense=input: trainer=sb3 trains layered actors"),
    ):
        with pytest.raises(ConfigError, match=message):
            make(**changes)
