"""Fleet training: runs that do not touch each other, what lies in the replay buffer, kills, divergence, groups."""

import dataclasses
import errno
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import otr
from otr.control.sac.autoreset import Autoreset
from otr.control.sac.random_streams import Streams
from pipelines.config.algo import SacConfig
from pipelines.config.hardened_methods import ExpertsConfig
from pipelines.config.stages import ActorConfig, TrainConfig
from pipelines.config.trainer import FleetConfig
from pipelines.engine.seeding import stream_seeds
from pipelines.errors import ConfigError, PipelineError
from pipelines.play.actor_files import load_actor
from pipelines.play.environments import make_env
from pipelines.runs.fleets import fleets, group_key
from pipelines.runs.run_job import RunJob, run_jobs
from pipelines.stages.train import checkpoint_folder, trained_steps
from pipelines.training.checkpoints import History
from pipelines.training.critics import load_critics
from pipelines.training.fleet import trainer as trainer_module
from pipelines.training.fleet.fleet_run import FleetRun
from pipelines.training.fleet.progress import FleetProgress
from pipelines.training.fleet.train_fleet import _segment, train_fleet
from pipelines.training.fleet.trainer import FleetTrainer, Task
from pipelines.training.settings import train_keys
from tests.pipelines.conftest import HOPPER, LANDER, PPO, SAC
from tests.pipelines.sweeps import do_until_killed

FLEET = FleetConfig("fleet", 1, 5)
WRAPPING_SAC = dataclasses.replace(SAC, buffer_size=150)  # wraps round within 300 steps
EVERYTHING = dataclasses.replace(
    WRAPPING_SAC, critic=[16, 8], learning_rate_end=0.2, actor_delay=3, train_freq=32, gradient_steps=20
)
EXPERTS = ExpertsConfig("experts", 0.01)


@pytest.fixture
def fleet_run(tiny):
    def make(**changes):
        return tiny(**{"trainer": FLEET, "algo": WRAPPING_SAC, **changes})

    return make


def train_all(configs, outs):
    return train_fleet(configs, [checkpoint_folder(config) for config in configs], outs)


def fresh(config, task):
    return FleetRun(config, checkpoint_folder(config), task.layout)


def folders(place, n):
    outs = [place / str(i) for i in range(n)]
    for out in outs:
        out.mkdir(parents=True)
    return outs


def trained(configs, folder):
    outs = folders(folder, len(configs))
    assert train_all(configs, outs) == [None] * len(configs)
    return outs


def same(one, other):
    """Whether two result folders hold the same files, byte for byte, but for the one of seconds."""
    found, expected = ({path.name: path.read_bytes() for path in each.glob("[!p]*")} for each in (one, other))
    return found == expected and len(found) > 2


@pytest.mark.parametrize(
    "changes",
    [{}, {"trainer": dataclasses.replace(FLEET, n_envs=4)}, {"algo": EVERYTHING}, {"method": EXPERTS, "depth": 3}],
    ids=["plain", "four environments", "every option", "experts"],
)
def test_a_run_in_company_is_the_run_alone(fleet_run, tmp_path, changes):
    configs = [fleet_run(seed=seed, env=HOPPER, **changes, results_dir=str(tmp_path / "r1")) for seed in (0, 1, 2)]
    together = trained(configs, tmp_path / "together")
    alone = trained([dataclasses.replace(configs[1], results_dir=str(tmp_path / "r2"))], tmp_path / "alone")
    assert same(together[1], alone[0])
    assert not same(together[0], together[1])


@pytest.mark.parametrize("depth", [0, [4, 3]], ids=str)
def test_a_dense_actor_has_a_linear_map_of_the_state(fleet_run, tmp_path, depth):
    (out,) = trained([fleet_run(actor=ActorConfig(0.05, dense="input"), depth=depth)], tmp_path)
    network = load_actor(out)  # the training has compared it with the trained policy on the selection episodes' states
    state_map = network.weights[-1][:, network.hidden_widths[-1] if depth else 0 :]
    assert network.dense == "input" and state_map.shape[1] == network.n_inputs and np.any(state_map)


def killed(configs):
    jobs = [RunJob(config, f"runs/seed-{config.seed}", "") for config in configs]
    do_until_killed(jobs, "pipelines.training.fleet.trainer.FleetReplay.add", 250)


def test_a_checkpoint_that_is_gone_or_changed_is_reported_and_the_others_go_on(fleet_run):
    configs = [fleet_run(seed=seed) for seed in range(4)]
    killed(configs)
    gone, changed = (checkpoint_folder(config) / "replay.bin" for config in configs[:2])
    gone.unlink()
    rows = np.memmap(changed, dtype=np.float32, mode="r+").reshape(-1, 2 * 3 + 1 + 2)  # of the pendulum
    rows[(trained_steps(configs[1]) - 1) % len(rows), -2] += 1.0  # the last transition's reward
    rows.flush()
    next(checkpoint_folder(configs[3]).glob("segment-*/history.json")).unlink()
    jobs = [RunJob(config, f"runs/seed-{config.seed}", "") for config in configs]
    errors = run_jobs(jobs)
    assert re.search(r"replay\.bin: the transitions of \d+ steps are gone; bring the file back", str(errors[0]))
    assert f"{changed} was changed; bring it back" in str(errors[1])
    assert errors[2] is None and (jobs[2].run_dir / "train/actor.json").is_file()
    assert "history.json is not there" in str(errors[3])


def test_every_transition_that_can_be_sampled_is_compared(fleet_run):
    config = fleet_run()  # 150 transitions are kept, and segments have 100 steps
    task = Task.of(config)
    run = fresh(config, task)
    for _ in range(2):
        _segment(FleetTrainer(task, [run]), FleetProgress([run]))

    def is_refused(transition: int) -> bool:
        row = run.rows[transition % len(run.rows)]
        row[0] += 1.0
        try:
            fresh(config, task)
        except PipelineError:
            return True
        finally:
            row[0] -= 1.0
        return False

    assert [is_refused(transition) for transition in (0, 49, 50, 99, 100, 199)] == [False] * 2 + [True] * 4


def test_what_one_run_s_environment_raises_ends_that_run_alone(fleet_run, tmp_path, monkeypatch, capsys):
    """In its selection episodes or in a segment, where all runs are stacked and each does that segment again alone."""
    evaluate, reset, step = FleetTrainer.evaluate, Autoreset.reset, Autoreset.step
    configs = [fleet_run(seed=seed) for seed in (0, 1, 2)]
    of_seed_0 = stream_seeds(2, 0, "train", 1)[1]  # of its second segment

    def failing_evaluate(trainer, r):
        if trainer.runs[r].config.seed == 1:
            raise ValueError("a fog")
        return evaluate(trainer, r)

    def noting_reset(envs, seeds):
        envs.has_wall = of_seed_0 in seeds
        return reset(envs, seeds)

    def failing_step(envs, actions):
        if envs.has_wall:
            raise FileNotFoundError(errno.ENOENT, "no such wall", "wall.csv")
        return step(envs, actions)

    monkeypatch.setattr(FleetTrainer, "evaluate", failing_evaluate)
    monkeypatch.setattr(Autoreset, "reset", noting_reset)
    monkeypatch.setattr(Autoreset, "step", failing_step)
    (alone,) = trained([dataclasses.replace(configs[2], results_dir=str(tmp_path / "r"))], tmp_path / "alone")
    outs = folders(tmp_path, 3)
    errors = train_all(configs, outs)
    assert isinstance(errors[0], FileNotFoundError) and str(errors[1]) == "a fog" and errors[2] is None
    assert same(outs[2], alone)
    said = capsys.readouterr().out
    assert "each run does this segment alone, as one run's environment fails: wall.csv: no such wall" in said
    assert "seed 0 abandoned, the others go on: wall.csv: no such wall" in said

    def fails_beside_others(envs, actions):
        if len(actions) > 1:
            raise ValueError("too many")
        return step(envs, actions)

    monkeypatch.undo()
    monkeypatch.setattr(Autoreset, "step", fails_beside_others)  # which costs no run
    others = [dataclasses.replace(config, results_dir=str(tmp_path / "r3")) for config in configs[:2]]
    assert train_all(others, folders(tmp_path / "beside", 2)) == [None, None]


def test_the_disk_of_all_steps_is_reserved_when_a_run_starts(fleet_run, monkeypatch):
    config = fleet_run(env=HOPPER, algo=SAC, train=TrainConfig(5_000, 5_000, 2, 100))
    task = Task.of(config)
    rows = fresh(config, task).rows
    taken = Path(rows.filename).stat().st_blocks * 512
    assert rows.shape == (10_000, 2 * 11 + 3 + 2) and 5_000 <= taken / (4 * rows.shape[1]) <= 5_300
    shutil.rmtree(checkpoint_folder(config))

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    jobs = [RunJob(dataclasses.replace(config, seed=seed), f"runs/seed-{seed}", "") for seed in (0, 1)]
    for error in run_jobs(jobs):
        assert isinstance(error, PipelineError) and "Make room there or choose another place" in str(error)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 9, 1))
    errors = run_jobs(jobs)  # what a fleet is refused for is each run's, and nothing is trained
    assert "training needs about" in str(errors[0]) and errors[1] is errors[0]
    assert [trained_steps(job.config) for job in jobs] == [0, 0]


@pytest.mark.parametrize("rescale_inputs", [False, True])
def test_critics_are_those_of_the_kept_actor(fleet_run, tmp_path, monkeypatch, rescale_inputs):
    config = fleet_run(actor=ActorConfig(0.0, rescale_inputs))
    done = History.segment_done

    def segment_done(history, row, files, returns):
        done(history, row, files, returns + 1000 * (row["steps"] == 200))  # the second segment's is the best

    monkeypatch.setattr(History, "segment_done", segment_done)
    learners = {}
    monkeypatch.setattr(FleetRun, "save", lambda run: learners.update({run.n_steps: run.tensors}))
    (out,) = trained([config], tmp_path)
    critics, learnt = load_critics(out), learners[200]
    assert critics.widths == (16,) and critics.gamma == np.float32(0.99)
    assert critics.log_temperature == pytest.approx(float(learnt["log_temperature"]))
    states = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [1, 1, 8]
    seen = states / [1, 1, 8] if rescale_inputs else states
    actions = np.random.default_rng(1).uniform(-1, 1, (50, 1))

    def values(layers, states):
        read = np.column_stack((states, actions))[None]
        for i, (weight, bias) in enumerate(layers):
            read = (np.maximum(read, 0) if i else read) @ weight + bias
        return read[..., 0]

    for name, layers in (("critics", critics.layers), ("targets", critics.targets)):
        theirs = [(learnt[f"{name}.weight{i}"].numpy(), learnt[f"{name}.bias{i}"].numpy()) for i in (0, 1)]
        np.testing.assert_allclose(values(layers, states), values(theirs, seen), atol=1e-4)
    # The deviations read the kept actor's neurons.
    actor = load_actor(out)
    neurons = np.maximum(states @ actor.weights[0].T + actor.biases[0], 0)
    log_std = neurons @ critics.log_std[:, :-1].T + critics.log_std[:, -1]
    theirs = np.maximum(seen @ learnt["actor.weight0"][0].numpy() + learnt["actor.bias0"][0].numpy(), 0)
    theirs = theirs @ learnt["actor.weight1"][0].numpy() + learnt["actor.bias1"][0].numpy()
    np.testing.assert_allclose(log_std[:, 0], theirs[:, 1], atol=1e-5)


def test_resumed_in_other_company_is_the_same(fleet_run, tmp_path):
    configs = [fleet_run(seed=seed, results_dir=str(tmp_path / "r1")) for seed in (0, 1)]
    expected = trained(configs, tmp_path / "expected")
    others = [dataclasses.replace(config, results_dir=str(tmp_path / "r2")) for config in configs]
    task = Task.of(others[0])
    run = fresh(others[0], task)  # seed 0 does a segment alone, then goes on beside a fresh seed 1
    _segment(FleetTrainer(task, [run]), FleetProgress([run]))
    assert [trained_steps(config) for config in others] == [100, 0]
    outs = trained(others, tmp_path / "outs")
    assert all(same(*pair) for pair in zip(expected, outs, strict=True))


def test_run_that_diverges_is_named_and_the_others_go_on(fleet_run, tmp_path, monkeypatch, capsys):
    configs = [fleet_run(seed=seed, env=HOPPER, results_dir=str(tmp_path / "r1")) for seed in (0, 1)]
    expected = trained(configs, tmp_path / "expected")
    initialise = trainer_module.FleetSac.initialise

    def initialise_badly(learner, run, generator):
        initialise(learner, run, generator)
        if len(learner.runs) == 2 and run == 0:
            learner.actor.layers.weights[0][0] = float("nan")

    monkeypatch.setattr(trainer_module.FleetSac, "initialise", initialise_badly)
    others = [dataclasses.replace(config, results_dir=str(tmp_path / "r2")) for config in configs]
    outs = folders(tmp_path, 2)
    errors = train_all(others, outs)
    assert "try a smaller algo.learning_rate" in str(errors[0])
    assert errors[1] is None and same(outs[1], expected[1])
    assert not list(outs[0].iterdir())
    assert "seed 0 abandoned, the others go on" in capsys.readouterr().out


def test_actor_that_is_not_what_was_trained_is_given_up_alone(fleet_run, tmp_path, monkeypatch):
    network = FleetTrainer.network

    def other_network(trainer, r):
        made = network(trainer, r)
        if r > 0 or len(trainer.runs) < 2:
            return made
        return otr.ReluNetwork(made.weights, [*made.biases[:-1], made.biases[-1] + 0.01], head=made.head)

    monkeypatch.setattr(FleetTrainer, "network", other_network)
    outs = folders(tmp_path, 2)
    errors = train_all([fleet_run(seed=seed) for seed in (0, 1)], outs)
    assert "is not the trained policy" in str(errors[0])
    assert errors[1] is None and (outs[1] / "actor.json").exists() and not (outs[0] / "actor.json").exists()


@pytest.mark.parametrize(("env", "n_envs"), [(HOPPER, 2), ("pendulum", 1)])
def test_replay_rows_are_what_the_environments_did(fleet_run, env, n_envs, monkeypatch):
    """Plays the recorded actions again in environments of gymnasium's own."""
    changes = {} if env == "pendulum" else {"env": env}
    fleet = dataclasses.replace(FLEET, n_envs=n_envs)
    config = fleet_run(algo=SAC, trainer=fleet, train=TrainConfig(460, 460, 1, 100), **changes)
    task = Task.of(config)
    run = fresh(config, task)
    seeds = run.seeds(1 + n_envs)[1:]
    trainer = FleetTrainer(task, [run])
    end, _, lengths = trainer.train_segment(FleetProgress([run]))
    d, a = task.layout.n_inputs, task.layout.n_actions
    n_ends = {True: 0, False: 0}
    for e, seed in enumerate(seeds):
        own = make_env(config.env)
        state, _ = own.reset(seed=seed)
        for row in run.rows[e:end:n_envs]:
            np.testing.assert_array_equal(row[:d], state.astype(np.float32))
            scaled = row[d : d + a]
            assert np.abs(scaled).max() <= 1
            state, reward, terminated, truncated, _ = own.step(task.low + 0.5 * (scaled + 1.0) * (task.high - task.low))
            np.testing.assert_array_equal(row[d + a : 2 * d + a], state.astype(np.float32))
            assert row[-2] == np.float32(reward)
            assert row[-1] == (0.0 if terminated else 1.0)
            if terminated or truncated:
                n_ends[bool(terminated)] += 1
                state, _ = own.reset()
        own.close()
    assert n_ends[env is HOPPER] > 1, "no episode ended, so nothing was shown about ends"
    assert sum(map(len, lengths)) == sum(n_ends.values())
    assert trainer.n_updates == end - 100


@pytest.mark.parametrize(("n_envs", "segment"), [(1, 100), (1, 50), (4, 100), (3, 50)])
def test_updates_come_in_bursts_wherever_segments_begin(fleet_run, tmp_path, monkeypatch, n_envs, segment):
    seen = []
    update, step = trainer_module.FleetSac.update, Autoreset.step
    monkeypatch.setattr(trainer_module.FleetSac, "update", lambda *own: (seen.append("update"), update(*own))[1])
    monkeypatch.setattr(Autoreset, "step", lambda *own: (seen.append("step"), step(*own))[1])
    algo = dataclasses.replace(SAC, train_freq=64, gradient_steps=20)
    changes = {"trainer": dataclasses.replace(FLEET, n_envs=n_envs), "train": TrainConfig(300, segment, 1, 100)}
    trained([fleet_run(algo=algo, **changes)], tmp_path)
    n_steps = np.cumsum([each == "step" for each in seen]) * n_envs
    at = [int(n) for n, each in zip(n_steps, seen, strict=True) if each == "update"]
    first = [-(-n // n_envs) * n_envs for n in (128, 192, 256)]  # the first step of all environments after so many
    assert at == [n for n in first for _ in range(20)]


def test_random_numbers_are_drawn_in_the_order_in_which_they_ever_were():
    """First those of the steps, then those of the updates: what a run drew before updates came in bursts, it draws."""
    draws, generator = Streams([7], 2, 5, 3).draw(32), torch.Generator().manual_seed(7)
    expected = {
        "policy": torch.empty(16, 2, 3).normal_(generator=generator),
        "exploration": torch.empty(16, 2, 3).normal_(generator=generator),
        "actions": torch.empty(16, 2, 3).uniform_(generator=generator) * 2 - 1,
        "updates": torch.empty(16, 2, 10, 3).normal_(generator=generator),
        "fractions": torch.empty(16, 2, 5, dtype=torch.float64).uniform_(generator=generator),
    }
    for name, numbers in expected.items():
        found = getattr(draws, name)[0]
        assert torch.equal(found.reshape(numbers.shape), numbers), name


def test_learning_rates_fall_linearly_over_all_steps_and_denormals_are_zero_in_segments_alone(
    fleet_run, tmp_path, monkeypatch
):
    shares, tiniest, seen = {}, torch.tensor([1e-40]), set()
    at_step = trainer_module.FleetSac.at_step

    def noting(learner, n_steps, share):
        at_step(learner, n_steps, share)
        shares[n_steps] = learner._rate_share
        seen.add((tiniest * 0.5).item())

    monkeypatch.setattr(trainer_module.FleetSac, "at_step", noting)
    trained([fleet_run(algo=EVERYTHING)], tmp_path)
    assert shares[150] == pytest.approx(0.6) and shares[299] == pytest.approx(0.2 + 0.8 / 300)
    assert list(shares) == list(range(100, 300)) and seen == {0.0} and (tiniest * 0.5).item() > 0


def test_first_actions_are_random_then_the_policys(fleet_run):
    quiet = dataclasses.replace(SAC, action_noise="none")
    config = fleet_run(algo=quiet, train=TrainConfig(200, 200, 1, 100))
    task = Task.of(config)
    run = fresh(config, task)
    trainer = FleetTrainer(task, [run])
    initial = trainer.tensors(0)
    trainer.train_segment(FleetProgress([run]))
    before = run.rows[:100, 3]
    assert abs(before.mean()) < 0.2 and before.std() == pytest.approx(1 / np.sqrt(3), abs=0.06)  # uniform in [-1, 1]
    # The first action of the policy comes before the first update: its distribution is the untrained actor's.
    state = torch.from_numpy(run.rows[100, :3].copy())
    x = (state @ initial["actor.weight0"][0] + initial["actor.bias0"][0, 0]).relu()
    mean, log_std = x @ initial["actor.weight1"][0] + initial["actor.bias1"][0, 0]
    assert abs(float(np.arctanh(run.rows[100, 3]) - mean)) < 4 * float(log_std.exp())


def test_what_can_train_together(fleet_run, tiny):
    def seeds(n, **changes):
        return [fleet_run(seed=seed, **changes) for seed in range(n)]

    faster = dataclasses.replace(WRAPPING_SAC, learning_rate=3e-3, gamma=0.9, ent_coef="0.1")
    assert group_key(fleet_run()) == group_key(fleet_run(seed=7, algo=faster))
    of_algo = {"batch_size": 16, "critic": [8], "tau": 0.01, "learning_rate_end": 0.5, "actor_delay": 2}
    changes = [{"algo": dataclasses.replace(WRAPPING_SAC, **{name: value})} for name, value in of_algo.items()]
    changes += [{"trainer": dataclasses.replace(FLEET, n_envs=2)}, {"train": TrainConfig(300, 50, 2, 100)}]
    for change in (*changes, {"depth": 5}, {"env": HOPPER}):
        assert group_key(fleet_run(**change)) != group_key(fleet_run()), change
    configs = [*seeds(3), tiny(), *seeds(4, depth=5), tiny(algo=PPO, env=LANDER, trainer=FLEET)]
    assert fleets(configs) == [[0, 1, 2], [3], [4, 5, 6, 7], [8]]
    assert [len(part) for part in fleets(seeds(12))] == [4, 4, 4]


def test_trainer_is_part_of_the_key_and_of_the_folder(fleet_run, tiny):
    assert train_keys(fleet_run()) != train_keys(tiny(algo=WRAPPING_SAC))
    assert "trainer" not in train_keys(tiny())
    assert checkpoint_folder(fleet_run()) != checkpoint_folder(tiny(algo=WRAPPING_SAC))
    larger = dataclasses.replace(FLEET, runs_per_process=7)
    assert train_keys(fleet_run(trainer=larger)) == train_keys(fleet_run())
    assert fleet_run().budget_level == "smoke-fleet"
    ppo = fleet_run(algo=PPO, env=LANDER)
    assert (ppo.trainer_name, ppo.budget_level, ppo.fleet) == ("sb3", "smoke", None)


def test_what_fleets_alone_have_is_keyed_where_it_is_set_and_refused_for_others(fleet_run, tiny):
    for name in SacConfig.of_fleets():
        value = getattr(EVERYTHING, name)
        algo = dataclasses.replace(SAC, **{name: value})
        assert fleet_run(algo=algo).settings()["algo"][name] == value
        assert name not in fleet_run(algo=SAC).settings()["algo"]
        with pytest.raises(ConfigError, match=rf"algo\.{name}={value}: trainer=sb3 has no such setting.*trainer=fleet"):
            tiny(algo=algo)


def test_what_a_fleet_cannot_do_is_refused_before_anything_runs(fleet_run, tmp_path):
    for changes, message in (
        ({"algo": dataclasses.replace(SAC, ent_coef="0")}, "give auto or a number above 0"),
        ({"algo": dataclasses.replace(SAC, action_noise="ornstein_uhlenbeck")}, "use algo.action_noise=normal"),
        ({"trainer": dataclasses.replace(FLEET, n_envs=0)}, "trainer.n_envs=0"),
        ({"env": LANDER}, "needs continuous actions"),
    ):
        with pytest.raises(ConfigError, match=message):
            trained([fleet_run(**changes)], tmp_path)
