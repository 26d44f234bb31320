"""The roads of a budget: overrides that stand before those given, as long as nobody goes a way of their own."""

import pytest

from pipelines.cli.runs import RUN
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.methods import METHODS
from pipelines.config.roads import roads
from pipelines.errors import ConfigError
from pipelines.runs.run_job import announce_return


def made(*overrides):
    (job,) = RUN.jobs([list(overrides)])
    return job.config


@pytest.mark.parametrize(
    ("overrides", "algo", "trainer", "folder"),
    [
        (["env=hopper"], "ars", "ars", "runs/hopper/otr/depth-6/standard-ars/seed-0"),
        (["env=hopper_v5"], "ars", "ars", "runs/hopper_v5/otr/depth-6/standard-ars/seed-0"),
        (["env=hopper", "method=linear", "depth=0"], "ars", "ars", "runs/hopper/linear/depth-0/standard-ars/seed-0"),
        (["env=reacher"], "sac", "fleet", "runs/reacher/otr/depth-6/standard-fleet/seed-0"),
        (["env=bipedalwalker"], "ppo", "sb3", "runs/bipedalwalker/otr/depth-6/standard/seed-0"),
        (
            ["env=bipedalwalker", "algo=sac", "trainer=fleet"],
            "sac",
            "fleet",
            "runs/bipedalwalker/otr/depth-6/standard-fleet/seed-0",
        ),
        (["env=hopper", "budget=thesis"], "sac", "sb3", "runs/hopper/otr/depth-6/thesis/seed-0"),
        (["env=hopper", "trainer=fleet"], "sac", "fleet", None),
        (["env=hopper", "algo=sac"], "sac", "sb3", None),
        (["env=reacher", "method=viper"], "sac", "fleet", None),
        (["env=hopper", "method=viper"], "ars", "ars", "runs/hopper/viper/depth-6/standard-ars/seed-0"),
        (["env=reacher", "method=pi_prl"], "sac", "fleet", "runs/reacher/pi_prl/depth-6/standard-fleet/seed-0"),
        (
            ["env=pendulum", "method=pi_prl", "algo=ppo_tree_pendulum"],
            "ppo",
            "sb3",
            "runs/pendulum/pi_prl/depth-6/standard/seed-0",
        ),
        (["env=bipedalwalker", "method=pi_prl", "algo=sac"], "sac", "sb3", None),
    ],
)
def test_the_cheapest_road_is_the_default(overrides, algo, trainer, folder):
    config = made(*overrides)
    assert (config.algo.name, config.trainer_name) == (algo, trainer)
    if folder:
        assert config.folder == folder


def test_what_is_given_stands():
    assert made("env=pendulum").polish and not made("env=pendulum", "polish=false").polish


def test_a_searched_oracle_is_the_run_of_otr_32():
    (job,) = RUN.jobs([["env=hopper", "method=viper"]])
    assert job.oracle is not None and job.oracle.folder == made("env=hopper", "depth=32").folder


def test_an_oracle_has_the_algorithm_of_the_road():
    """The biped's own algorithm is PPO, and its oracles' SAC in a fleet: spelt out or not."""
    for method in ("method=viper", "method=distilled_otr"):
        (job,) = RUN.jobs([["env=bipedalwalker", method]])
        assert job.oracle is not None and job.oracle.config.algo.name == "sac"
    spelt_out = made("env=bipedalwalker", "algo=sac", "trainer=fleet", "depth=[256,256]")
    assert spelt_out.folder == job.oracle.folder and not spelt_out.changes
    assert "~" in made("env=bipedalwalker", "algo=sac").folder  # of a trainer that the road has not


def test_who_names_another_algorithm_or_trainer_leaves_the_road_with_all_that_it_says_of_training():
    on_the_road = made("env=bipedalwalker")
    assert (on_the_road.algo.normalise, on_the_road.train.eval_interval_steps) == (True, 50_000)
    assert not on_the_road.changes
    own_way = made("env=bipedalwalker", "algo=ppo")
    assert (own_way.algo.normalise, own_way.train.eval_interval_steps) == (False, 10_000) and "~" in own_way.folder
    assert made("env=bipedalwalker", "trainer=sb3").settings() == on_the_road.settings()
    spelt_out = made("env=bipedalwalker", "algo=ppo_normalised", "train.steps=1_000_000",
                     "train.eval_interval_steps=50_000", "trainer=sb3")  # fmt: skip
    assert spelt_out.folder == on_the_road.folder
    assert made("env=bipedalwalker", "algo=sac", "trainer=fleet").train.eval_interval_steps == 10_000
    soft_tree = made("env=bipedalwalker", "method=pi_prl")
    assert soft_tree.algo.normalise and soft_tree.folder == "runs/bipedalwalker/pi_prl/depth-6/standard/seed-0"


def test_an_oracle_is_the_same_where_the_trainer_of_the_road_is_spelt_out():
    """So it is below one folder, as the imitating run's settings are the same."""
    words = ["env=bipedalwalker", "method=viper"]
    road, spelt_out = RUN.jobs([words, [*words, "trainer=fleet"]])
    assert road.folder == spelt_out.folder and road.oracle.folder == spelt_out.oracle.folder
    assert road.oracle.config.settings() == spelt_out.oracle.config.settings()


@pytest.mark.parametrize(
    ("road", "others"),
    [
        (["env=bipedalwalker"], ["trainer=fleet"]),
        (["env=bipedalwalker", "evaluate.n_episodes=5"], ["trainer=fleet"]),
        (["env=bipedalwalker", "method=pi_prl"], ["algo=ppo_normalised"]),
        (
            ["env=bipedalwalker", "method=viper", "trainer=sb3"],
            ["algo=ppo_normalised", "train.steps=1_000_000", "train.eval_interval_steps=50_000"],
        ),
    ],
)
def test_other_settings_have_another_folder(road, others):
    one, other = made(*road), made(*road, *others)
    assert one.settings() != other.settings() and one.folder != other.folder
    assert one.changes != other.changes


@pytest.mark.parametrize("words", [["env=swimmer"], ["env=bipedalwalker", "method=sdt"]])
def test_a_fleet_that_trains_no_such_run_changes_nothing(words):
    sb3, fleet = made(*words, "trainer=sb3"), made(*words, "trainer=fleet")
    assert sb3.settings() == fleet.settings() and sb3.folder == fleet.folder and "~" not in sb3.folder


def test_another_algorithm_beside_a_fleet_in_vain_tells_what_differs():
    config = made("env=hopper", "algo=ppo", "trainer=fleet")
    assert config.folder == made("env=hopper", "algo=ppo").folder and "algo.name=ppo" in config.changes


def test_small_actors_of_these_tasks_are_dense_and_nothing_else_of_them_is():
    env, otr = "env=halfcheetah", roads("standard").overrides["otr"]
    assert otr["ant"] == otr["halfcheetah"]
    on_the_road = made(env)
    assert on_the_road.actor.dense == "input"
    assert on_the_road.folder == f"runs/{on_the_road.env.name}/otr/depth-6/standard-fleet/seed-0"
    layered = made(env, "actor.dense=none")
    assert layered.changes == "actor.dense=none" and "~" in layered.folder
    assert made(env, "trainer=sb3").actor.dense == "none"  # which trains no dense actors
    assert made(env, "depth=[256,256]").actor.dense == made(env, "depth=256").actor.dense == "none"
    for method in ("method=viper", "method=distilled_otr", "method=linear"):
        (job,) = RUN.jobs([[env, method]])
        assert (job.oracle or job).config.actor.dense == "none"
        assert not job.config.changes


@pytest.mark.parametrize("env", ["env=hopper", pytest.param("env=pendulum", marks=pytest.mark.slow)])
def test_imitating_a_searched_oracle_takes_settings(env):
    plain = made(env, "method=viper", "algo=ars", "oracle=[32]")
    assert "~" not in plain.folder
    changed = made(env, "method=viper", "algo=ars", "oracle=[16]", "method.criterion=entropy")
    assert changed.changes == "method.criterion=entropy, oracle=[16]" and "~" in changed.folder


def test_an_oracle_of_ones_own_is_not_searched():
    config = made("env=hopper", "method=viper", "algo=sac")
    assert config.algo.name == "sac" and config.oracle == [256, 256]
    with pytest.raises(ConfigError, match=r"oracle=\[64\]: algo=ars searches small networks"):
        made("env=hopper", "method=viper", "oracle=[64]")
    assert made("env=hopper", "method=distilled_otr", "depth=64").depth == 64  # of the student, which is not searched


def test_roads_lead_somewhere():
    """Every road is of a budget, a method and a task that there are."""
    tasks = {path.stem for path in (CONF_DIR / "env").glob("*.yaml")}
    budgets = [path.stem for path in (CONF_DIR / "roads").glob("*.yaml")]
    assert "standard" in budgets
    for budget in budgets:
        assert (CONF_DIR / "budget" / f"{budget}.yaml").is_file()
        for by_method in (roads(budget).overrides, roads(budget).expected):
            assert by_method
            for method, by_task in by_method.items():
                assert method in METHODS and by_task.keys() <= tasks, (budget, method)


def test_the_search_has_an_environments_own_settings():
    hopper, ant = made("env=hopper", "algo=ars").algo, made("env=ant", "algo=ars").algo
    assert hopper.alive_bonus == ant.alive_bonus == 1.0 and hopper.n_directions != ant.n_directions


@pytest.mark.parametrize(
    ("overrides", "is_told"),
    [
        (["env=halfcheetah"], True),
        (["env=reacher", "depth=32"], True),
        (["env=hopper", "method=viper"], True),
        (["env=pendulum"], True),
        (["env=hopper", "method=viper", "algo=sac"], False),
        (["env=hopper", "method=viper", "method.criterion=entropy"], False),
        (["env=halfcheetah", "algo=sac", "trainer=fleet"], True),
        (["env=halfcheetah", "algo=ars"], False),
        (["env=halfcheetah", "trainer=fleet", "depth=[256,256]"], False),
        (["env=reacher", "depth=[256,256]"], False),
        (["env=reacher", "trainer=sb3"], False),
        (["env=walker2d", "algo.noise_end=0.1"], False),
        (["env=walker2d", "budget.search.walker2d.steps=1000"], False),
    ],
)
def test_only_a_run_as_measured_is_told_what_to_expect(overrides, is_told, capsys):
    announce_return(made(*overrides))
    assert ("expect a return" in capsys.readouterr().out) == is_told
