"""What is killed by SIGKILL and resumed leaves the bytes of what was left alone, and does less than all of it again."""

import dataclasses
import pkgutil

import pytest

from otr.control.settings import DaggerSettings
from pipelines.config.env import EnvConfig, PidTerms
from pipelines.config.methods import MappedConfig, NdpsConfig, PidConfig
from pipelines.config.stages import ActorConfig, PolishingConfig, TrainConfig
from pipelines.runs.run_job import RunJob, run_jobs
from tests.pipelines.conftest import ARS, HOPPER, LANDER, PENDULUM, PI_PRL, PPO, SAC
from tests.pipelines.stages.test_train import DDPG, DQN, SMALL_BUFFER_SAC, TD3
from tests.pipelines.sweeps import digests, do_until_killed
from tests.pipelines.training.fleet.test_train import EVERYTHING, EXPERTS, FLEET, WRAPPING_SAC

SAVE, SEGMENT = "pipelines.training.sb3.training.save_checkpoint", "pipelines.training.sb3.saved_models.write_segment"
OF_FLEETS, ADD = "pipelines.training.fleet.fleet_run.write_segment", "pipelines.training.fleet.trainer.FleetReplay.add"
SEARCHED, PUT = "pipelines.training.search.train_by_search.write_segment", "pipelines.engine.stage._put"
PLAYED, TIMED = "pipelines.stages.imitate.play_seeds", ("oracle.json", "iterates.csv", "candidates.csv")

PID = {
    "algo": DDPG, "depth": 1, "method": PidConfig("pid", [1.0, 0.0, 0.0], 3, 2.5, 4.0, 0.01),
    "env": dataclasses.replace(PENDULUM, pid=PidTerms((1.0, 0.0, 0.0), 3)),
}  # fmt: skip
TOGETHER = {"trainer": FLEET, "algo": WRAPPING_SAC}
SEARCH = {
    "env": EnvConfig("cartpole", "cartpole", "CartPole-v1"), "actor": ActorConfig(0.0, dense="input"),
    "algo": dataclasses.replace(ARS, n_starts=2, start_steps=800), "train": TrainConfig(3_000, 700, 3, 0),
}  # fmt: skip
POLISHED = SEARCH | {
    "algo": ARS, "polish": True, "stages": None,
    "polishing": PolishingConfig(steps=2_000, n_directions=2, n_top=2, n_selection_episodes=2, n_candidates=2),
}  # fmt: skip
IMITATED = {
    "method": NdpsConfig("ndps", max_samples=500, n_updates=30, n_updates_next=10, batch_size=64, beta_last=20.0),
    "depth": 2, "oracle": [6], "imitate": DaggerSettings(3, 2, 2, 4), "stages": ["oracle", "imitate"],
}  # fmt: skip
# What is run; the call, and the how manyeth, before or after which the process dies
KILLS = {
    "sac, before saving": (SMALL_BUFFER_SAC, SAVE, 2, False),
    "sac, after saving": (SMALL_BUFFER_SAC, SAVE, 2, True),
    "sac, between replay and model": (SMALL_BUFFER_SAC, SEGMENT, 2, False),
    "ddpg": (DDPG, SAVE, 2, True),
    "td3": (TD3, SEGMENT, 2, False),
    "dqn": ({"algo": DQN, "env": LANDER}, SAVE, 2, True),
    "ppo, before saving": (PPO, SAVE, 2, False),
    "ppo, after saving": (PPO, SAVE, 2, True),
    "normalised ppo": (dataclasses.replace(PPO, normalise=True), SAVE, 2, True),
    "pid": (PID, SAVE, 2, True),
    "soft trees": ({"algo": PPO, "method": PI_PRL, "depth": 2}, SAVE, 2, True),
    "fleet, in a segment": (TOGETHER, ADD, 250, True),
    "fleet, between the checkpoints of two runs": (TOGETHER, OF_FLEETS, 3, True),
    "fleet with every option": (TOGETHER | {"algo": EVERYTHING}, ADD, 250, True),
    "fleet of soft trees": (TOGETHER | {"method": PI_PRL, "depth": 2}, ADD, 250, True),
    "fleet of experts": (
        TOGETHER | {"method": EXPERTS, "depth": 3, "env": HOPPER}, ADD, 250, True,
    ),
    "search": (SEARCH, SEARCHED, 2, True),
    "imitation": (IMITATED, PLAYED, 4, False),
    **{f"{stage}, made and not yet in its place": (POLISHED, PUT, n, False)
       for n, stage in enumerate(("map", "prune", "evaluate", "polish"), start=2)},
}  # fmt: skip


def jobs_of(tiny, changes, results_dir):
    """Return the jobs of a case: of a fleet two, of a method that imitates one with its oracle's."""
    place = {"results_dir": str(results_dir)}
    config = tiny(**{"stages": ["train"], **(changes if isinstance(changes, dict) else {"algo": changes}), **place})
    if config.method.imitates:
        trained = tiny(algo=SAC, method=MappedConfig("otr"), depth=[6], folder="runs/oracle", stages=["train"], **place)
        config = dataclasses.replace(config, oracle_run=trained)
        return [RunJob(config, "runs/seed-0", "", oracle=RunJob(trained, trained.folder, ""))]
    seeds = (0, 1) if config.fleet else (0,)
    return [RunJob(dataclasses.replace(config, seed=seed), f"runs/seed-{seed}", "") for seed in seeds]


def left_by(results_dir):
    """Return the digests of what runs left, but of files that hold seconds, or a digest of such a file."""
    return {path: found for path, found in digests(results_dir).items() if not path.endswith(TIMED)}


def n_calls(jobs, where):
    """Do jobs and return how often they call a function."""
    calls, (place, name) = [], where.rsplit(".", 1)
    owner = pkgutil.resolve_name(place)
    function = getattr(owner, name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, lambda *args, **options: (calls.append(1), function(*args, **options))[1])
        assert run_jobs(jobs) == [None] * len(jobs)
    return len(calls)


@pytest.fixture(scope="module")
def left_alone(tmp_path_factory):
    """Return what does the jobs of a case once for all its kills: what they leave, and how often they call what."""
    known = {}

    def do(tiny, changes, where):
        if (id(changes), where) not in known:
            folder = tmp_path_factory.mktemp("alone")
            known[id(changes), where] = n_calls(jobs_of(tiny, changes, folder), where), left_by(folder)
        return known[id(changes), where]

    return do


@pytest.mark.parametrize(("changes", "where", "n", "after"), KILLS.values(), ids=KILLS)
def test_killed_and_resumed_equals_uninterrupted(tiny, tmp_path, left_alone, changes, where, n, after):
    whole, expected = left_alone(tiny, changes, where)
    killed = jobs_of(tiny, changes, tmp_path)
    do_until_killed(killed, where, n, after)
    left = n_calls(killed, where)
    assert left < whole  # what was done is not done again
    assert left_by(tmp_path) == expected != {}
