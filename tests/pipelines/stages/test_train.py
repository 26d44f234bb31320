"""Training by Stable-Baselines3: what its checkpoints, its actor and its settings are."""

import dataclasses
import re

import numpy as np
import pytest

import otr
from pipelines.config.algo import DdpgConfig, DqnConfig, Td3Config
from pipelines.config.stages import ActorConfig, TrainConfig
from pipelines.engine.seeding import episode_seeds
from pipelines.engine.stage import run_stage
from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError, PolicyMismatchError
from pipelines.play.actor_files import load_actor
from pipelines.play.episodes import play_seeds
from pipelines.play.selection import compare_with_trained
from pipelines.runs.run_job import RunJob
from pipelines.runs.stage_table import STAGES
from pipelines.stages.train import TRAIN, checkpoint_folder, trained_steps
from pipelines.training.estimates import estimated_bytes, segment_steps
from pipelines.training.sb3 import saved_models as checkpoint_module
from pipelines.training.sb3 import training as sb3_training
from pipelines.training.sb3.actor_kinds import actor_of
from pipelines.training.sb3.models import build_model
from tests.pipelines.conftest import PPO, SAC
from tests.pipelines.sweeps import do_until_killed

DDPG = DdpgConfig("ddpg", 1e-3, 32, 0.99, [16], 0.0, 150, 50, 0.005, 1, 1, "ornstein_uhlenbeck", 0.5, 0.3)
TD3 = Td3Config("td3", 1e-3, 32, 0.99, [16], 0.0, 1000, 50, 0.005, 1, 1, "normal", 0.1, 0.01, 2, 0.2, 0.5)
SMALL_BUFFER_SAC = dataclasses.replace(SAC, buffer_size=150)  # wraps round within 300 steps
# Random for a while, with a target network that is replaced within a segment.
DQN = DqnConfig("dqn", 1e-3, 32, 0.99, [], 0.0, 1000, 20, 1.0, 4, 2, 70, 0.5, 0.1, 10.0)
ALGORITHMS = {"dqn": DQN, "sac": SMALL_BUFFER_SAC, "ddpg": DDPG, "td3": TD3, "ppo": PPO,
              "normalised ppo": dataclasses.replace(PPO, normalise=True)}  # fmt: skip


def killed(config):
    """Train until the second checkpoint is there, and no further."""
    job = RunJob(dataclasses.replace(config, stages=["train"]), "runs/killed", "")
    do_until_killed([job], "pipelines.training.sb3.training.save_checkpoint", 2, after=True)


def test_a_replay_buffer_that_is_gone_is_told(tiny, tmp_path):
    config, out = tiny(algo=SMALL_BUFFER_SAC), tmp_path / "out"
    out.mkdir()
    killed(config)
    logs = sorted(checkpoint_folder(config).glob("replay-*.npz"))
    logs[-1].unlink()
    with pytest.raises(PipelineError, match=r"100 of 150 transitions of the replay buffer are gone; bring the replay"):
        TRAIN.run({}, config, out)


@pytest.mark.parametrize(
    ("pattern", "told"),
    [
        ("segment-*/model.pt", "model.pt was changed"),
        ("segment-*/actor.safetensors", "actor.safetensors was changed"),
        ("replay-*.npz", r"npz cannot be read: \w"),
    ],
)
@pytest.mark.parametrize("share", [0.5, 0.0])
def test_a_damaged_checkpoint_is_told_before_anything_goes_on_from_it(tiny, tmp_path, pattern, told, share):
    config, out = tiny(algo=SMALL_BUFFER_SAC), tmp_path / "out"
    out.mkdir()
    killed(config)
    folder = checkpoint_folder(config)
    for path in folder.glob(pattern):
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    remedy = f"bring it back, or delete the folder {re.escape(str(folder))} to train from the beginning"
    with pytest.raises(PipelineError, match=f"(?s){told}.*; {remedy}"):
        TRAIN.run({}, config, out)
    if not share:
        for path in folder.glob(pattern):
            path.unlink()
        with pytest.raises(PipelineError, match=r"is gone; bring it back|are gone; bring the replay"):
            TRAIN.run({}, config, out)


def test_only_runs_side_by_side_share_checkpoints(tiny):
    one = tiny(folder="runs/pendulum/otr/depth-0/quick/seed-0")
    shorter = dataclasses.replace(one, folder="runs/pendulum/otr/depth-0/quick/seed-0~1234abcd")
    linear = dataclasses.replace(one, folder="runs/pendulum/linear/depth-0/quick/seed-0")
    assert checkpoint_folder(one) == checkpoint_folder(shorter) != checkpoint_folder(linear)


def test_seed_decides_the_actor(tiny, tmp_path):
    actors = []
    for i, seed in enumerate((0, 0, 1)):
        out = tmp_path / f"out-{i}"
        out.mkdir()
        TRAIN.run({}, tiny(algo=PPO, seed=seed, results_dir=str(tmp_path / f"r{i}")), out)
        actors.append((out / "actor.safetensors").read_bytes())
    assert actors[0] == actors[1] != actors[2]


def test_best_evaluation_s_actor_is_kept(tiny, tmp_path):
    config = tiny(algo=PPO, seed=5, train=TrainConfig(1500, 300, 2, 0))
    TRAIN.run({}, config, tmp_path)
    rows = read_csv(tmp_path / "evaluations.csv")
    returns = [float(row["return_mean"]) for row in rows]
    assert len(rows) == 4  # 384 steps a segment: whole rollouts of 2 x 64
    assert max(returns) > returns[-1] + 1.0  # or the test could not tell the best actor from the last
    assert [row["best"] for row in rows].count("True") == 1
    again = play_seeds(load_actor(tmp_path).predict, config.env, episode_seeds(5, "selection", 2), n_workers=1)
    assert again.returns.mean() == max(returns)


def test_an_actor_trained_on_normalised_states_reads_the_environments_own(tiny, tmp_path):
    """The stage itself compares the actor with the model; here the statistics are far from 0 and 1."""
    config = tiny(algo=dataclasses.replace(PPO, normalise=True), results_dir=str(tmp_path / "results"))
    TRAIN.run({}, config, tmp_path)
    model = build_model(config, 0)
    checkpoint_module.load_checkpoint(checkpoint_folder(config), model)
    env = model.get_vec_normalize_env()
    assert env.obs_rms.count > config.train.steps  # of all segments
    states = np.random.default_rng(0).uniform([-1, -1, -8], [1, 1, 8], (200, 3))
    seen = (states - env.obs_rms.mean) / np.sqrt(env.obs_rms.var + env.epsilon)
    assert np.abs(seen - states).max() > 3.0
    network = otr.from_sb3(model)
    np.testing.assert_allclose(network.predict(states), model.predict(seen, deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize(("depth", "slope"), [(0, 0.0), ([3, 2], 0.0), (4, 0.1)])
def test_actor_has_the_shape_asked_for(tiny, tmp_path, depth, slope):
    TRAIN.run({}, tiny(depth=depth, actor=ActorConfig(slope)), tmp_path)
    network = load_actor(tmp_path)
    assert network.hidden_widths == tuple([depth] if isinstance(depth, int) and depth else depth or ())
    assert network.negative_slope == slope


def assert_is_what_was_trained(network, model):
    """Check that a network is a model's actor, and that one with another last weight is caught."""
    states = np.random.default_rng(0).normal(size=(200, network.n_inputs))

    def trained(seen):
        return model.predict(seen, deterministic=True)[0]

    compare_with_trained(network, trained, states, units=None)
    weights = [weight.copy() for weight in network.weights]
    weights[-1][-1, 0] += 1e-3
    with pytest.raises(PolicyMismatchError, match="in state"):
        compare_with_trained(network.replace(weights=weights), trained, states, units=None)


def test_segments_of_ppo_are_whole_rollouts(tiny):
    assert segment_steps(tiny(algo=PPO, train=TrainConfig(10_000, 1000, 2, 0))) == 1024
    assert segment_steps(tiny(train=TrainConfig(10_000, 1000, 2, 0))) == 1000


def test_disk_estimate_counts_the_replay_buffer(tiny):
    # a Pendulum transition: two float32 states of 3, one float32 action, reward, done, timeout
    assert estimated_bytes(tiny(train=TrainConfig(1000, 100, 2, 0))) == 1000 * (2 * 12 + 4 + 12)


def test_rescaled_inputs_are_folded_into_the_program(tiny, tmp_path):
    config = tiny(actor=ActorConfig(0.0, rescale_inputs=True))
    TRAIN.run({}, config, tmp_path)
    network = load_actor(tmp_path)
    seeds = episode_seeds(0, "selection", 2)
    again = play_seeds(network.predict, config.env, seeds, n_workers=1)  # on the environment's own states
    returns = [float(row["return_mean"]) for row in read_csv(tmp_path / "evaluations.csv")]
    assert again.returns.mean() == max(returns)


def test_training_that_cannot_be_put_in_its_place_is_not_lost(tiny, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    config, stage = tiny(), STAGES["train"]
    with monkeypatch.context() as patch:
        patch.setattr("pipelines.engine.stage.file_digest", stop)
        with pytest.raises(KeyboardInterrupt):
            run_stage(stage, tmp_path / "run", config, "")
    assert trained_steps(config) == 300
    monkeypatch.setattr(sb3_training, "train_segment", stop)  # nothing is left to train
    assert not run_stage(stage, tmp_path / "run", config, "").skipped


def test_training_that_diverged_says_so(tiny):
    import torch

    model = build_model(tiny(), 0)
    with torch.no_grad():
        model.policy.actor.mu.weight.fill_(float("nan"))
    with pytest.raises(PipelineError, match=r"smaller algo\.learning_rate"):
        actor_of(tiny()).evaluate(model)
