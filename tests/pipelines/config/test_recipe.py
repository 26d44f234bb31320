"""Recipes of a budget: overrides that stand before those given, as long as nobody names another way to train."""

import pytest

from pipelines.cli.runs import RUN
from pipelines.config.conf_dir import CONF_DIR
from pipelines.config.methods import METHODS
from pipelines.config.recipe import TRAINED_BY, recipes
from pipelines.errors import ConfigError


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
        (["env=halfcheetah", "method=otr"], "sac", "fleet", "runs/halfcheetah/otr/depth-6/standard-fleet/seed-0"),
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
            None,
        ),
        (["env=bipedalwalker", "method=pi_prl", "algo=sac"], "sac", "sb3", None),
    ],
)
def test_a_recipe_stands_before_what_is_given(overrides, algo, trainer, folder):
    config = made(*overrides)
    assert (config.algo.name, config.trainer_name) == (algo, trainer)
    if folder:
        assert config.folder == folder


def test_what_is_given_stands():
    assert made("env=pendulum").polish and not made("env=pendulum", "polish=false").polish


def test_a_searched_oracle_is_the_run_of_otr_32():
    (job,) = RUN.jobs([["env=hopper", "method=viper"]])
    assert job.oracle is not None and job.oracle.folder == made("env=hopper", "depth=32").folder


def test_a_recipe_may_be_of_one_depth():
    """The hopper's small policies are searched for longer than OTR (32), which imitators' oracles are."""
    for overrides in (["depth=32"], ["depth=[32]"]):
        assert made("env=hopper", *overrides).train.steps == 4_000_000
    for overrides in (["depth=6"], [], ["method=linear"]):
        assert made("env=hopper", *overrides).train.steps == 20_000_000


def test_an_oracle_has_the_algorithm_of_the_recipe():
    """The biped's own algorithm is PPO, and its oracles' SAC in a fleet: spelt out or not."""
    for method in ("method=viper", "method=distilled_otr"):
        (job,) = RUN.jobs([["env=bipedalwalker", method]])
        assert job.oracle is not None and job.oracle.config.algo.name == "sac"
    spelt_out = made("env=bipedalwalker", "algo=sac", "trainer=fleet", "depth=[256,256]")
    assert spelt_out.folder == job.oracle.folder and not spelt_out.changes
    assert "~" in made("env=bipedalwalker", "algo=sac").folder  # of a trainer that the recipe has not


def test_who_names_another_algorithm_or_trainer_has_nothing_of_what_the_recipe_says_of_training():
    by_recipe = made("env=bipedalwalker")
    assert (by_recipe.algo.normalise, by_recipe.train.eval_interval_steps) == (True, 50_000)
    assert not by_recipe.changes
    own_way = made("env=bipedalwalker", "algo=ppo")
    assert (own_way.algo.normalise, own_way.train.eval_interval_steps) == (False, 10_000) and "~" in own_way.folder
    assert made("env=bipedalwalker", "trainer=sb3").settings() == by_recipe.settings()
    spelt_out = made("env=bipedalwalker", "algo=ppo_normalised", "train.steps=1_000_000",
                     "train.eval_interval_steps=50_000", "trainer=sb3")  # fmt: skip
    assert spelt_out.folder == by_recipe.folder
    assert made("env=bipedalwalker", "algo=sac", "trainer=fleet").train.eval_interval_steps == 10_000
    soft_tree = made("env=bipedalwalker", "method=pi_prl")
    assert soft_tree.method.beta_last == 50.0 and made("env=reacher", "method=pi_prl").method.beta_last == 500.0
    assert soft_tree.algo.normalise and soft_tree.folder == "runs/bipedalwalker/pi_prl/depth-6/standard/seed-0"


def test_an_oracle_is_the_same_where_the_trainer_of_the_recipe_is_spelt_out():
    """So it is below one folder, as the imitating run's settings are the same."""
    words = ["env=bipedalwalker", "method=viper"]
    recipe, spelt_out = RUN.jobs([words, [*words, "trainer=fleet"]])
    assert recipe.folder == spelt_out.folder and recipe.oracle.folder == spelt_out.oracle.folder
    assert recipe.oracle.config.settings() == spelt_out.oracle.config.settings()


@pytest.mark.parametrize(
    ("recipe", "others"),
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
def test_other_settings_have_another_folder(recipe, others):
    one, other = made(*recipe), made(*recipe, *others)
    assert one.settings() != other.settings() and one.folder != other.folder
    assert one.changes != other.changes


@pytest.mark.parametrize("words", [["env=swimmer"], ["env=bipedalwalker", "method=sdt"]])
def test_a_fleet_that_trains_no_such_run_changes_nothing(words):
    sb3, fleet = made(*words, "trainer=sb3"), made(*words, "trainer=fleet")
    assert sb3.settings() == fleet.settings() and sb3.folder == fleet.folder and "~" not in sb3.folder


def test_another_algorithm_beside_a_fleet_in_vain_tells_what_differs():
    config = made("env=hopper", "algo=ppo", "trainer=fleet")
    assert config.folder == made("env=hopper", "algo=ppo").folder and config.changes == "algo=ppo"


def test_small_actors_of_these_tasks_are_dense_and_nothing_else_of_them_is():
    env, otr = "env=halfcheetah", recipes("standard")["otr"]
    assert otr["ant"] == otr["halfcheetah"]
    by_recipe = made(env)
    assert by_recipe.actor.dense == "input"
    assert by_recipe.folder == f"runs/{by_recipe.env.name}/otr/depth-6/standard-fleet/seed-0"
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


def test_a_recipe_may_be_of_a_depth():
    (job,) = RUN.jobs(RUN.expand(["env=halfcheetah"], multirun=False))
    assert job.folder == "runs/halfcheetah/distilled_otr/depth-6/standard-shrink/seed-0"
    (linear,) = RUN.jobs(RUN.expand(["env=halfcheetah", "depth=0"], multirun=False))
    assert linear.folder == "runs/halfcheetah/otr/depth-0/standard-fleet/seed-0"
    assert job.oracle.folder == "runs/halfcheetah/otr/depth-256-256/standard-fleet/seed-0"


def test_recipes_are_of_what_there_is():
    """Every recipe is of a budget, a method and a task that there are."""
    tasks = {path.stem for path in (CONF_DIR / "env").glob("*.yaml")}
    budgets = [path.stem for path in (CONF_DIR / "recipe").glob("*.yaml")]
    assert "standard" in budgets
    for budget in budgets:
        assert (CONF_DIR / "budget" / f"{budget}.yaml").is_file()
        for method, by_task in recipes(budget).items():
            assert method in (*METHODS, "default") and {task.split("/")[0] for task in by_task} <= tasks, (
                budget,
                method,
            )


@pytest.mark.parametrize("budget", [path.stem for path in (CONF_DIR / "recipe").glob("*.yaml")])
def test_a_recipe_that_says_how_to_train_says_who_trains(budget):
    """So a folder that names another algorithm or trainer, and no digest, never holds what the recipe trains."""
    for by_task in recipes(budget).values():
        for words in by_task.values():
            keys = {word.partition("=")[0] for word in words}
            says_how = any(key.partition(".")[0] in ("train", "actor") or key.startswith("algo.") for key in keys)
            is_by_sb3 = "algo" in keys and not {"algo=ars", "trainer=fleet", "trainer=shrink"} & {*words}
            if says_how or is_by_sb3:
                assert keys >= {*TRAINED_BY} or "algo=ars" in words, (budget, words)


@pytest.fixture
def small_recipe(monkeypatch):
    """Make a budget whose recipe names another method where none is given."""
    by_method = {
        "default": {"halfcheetah": ["method=distilled_otr", "trainer=shrink"]},
        "otr": {"halfcheetah": ["algo=ppo"], "hopper": ["depth=5"]},
    }
    monkeypatch.setattr("pipelines.config.recipe.recipes", lambda budget: by_method if budget == "smoke" else {})
    monkeypatch.setattr(RUN, "_composed", {})


@pytest.mark.parametrize(
    ("overrides", "folder"),
    [
        (["env=halfcheetah"], "halfcheetah/distilled_otr/depth-6/smoke-shrink/seed-0"),
        (["env=halfcheetah_v5", "seed=2"], "halfcheetah_v5/distilled_otr/depth-6/smoke-shrink/seed-2"),
        (["env=halfcheetah", "method=distilled_otr"], "halfcheetah/distilled_otr/depth-6/smoke/seed-0"),
        (["env=halfcheetah", "method=otr"], "halfcheetah/otr/depth-6/smoke/seed-0"),
        (["env=halfcheetah", "trainer=fleet"], "halfcheetah/otr/depth-6/smoke-fleet/seed-0"),
        (["env=halfcheetah", "algo=sac", "trainer=fleet"], "halfcheetah/otr/depth-6/smoke-fleet/seed-0"),
        (["env=hopper"], "hopper/otr/depth-5/smoke/seed-0"),
        (["env=hopper", "depth=3"], "hopper/otr/depth-3/smoke/seed-0"),
    ],
)
def test_a_recipe_may_name_the_method_where_none_is_given(small_recipe, overrides, folder):
    words = [*overrides, "budget=smoke"]
    (job,) = RUN.jobs(RUN.expand(words, multirun=False))
    assert (job.folder, job.config.changes) == (f"runs/{folder}", "")


def test_an_oracle_may_be_named_where_the_recipe_s_method_imitates_one(small_recipe):
    (job,) = RUN.jobs(RUN.expand(["env=halfcheetah", "budget=smoke", "oracle=[64]"], multirun=False))
    assert job.config.changes == "oracle=[64]" and job.oracle.folder.startswith("runs/halfcheetah/otr/depth-64/")
    with pytest.raises(ConfigError, match=r"oracle=\[64\]: nothing is imitated"):
        RUN.expand(["env=hopper", "budget=smoke", "oracle=[64]"], multirun=False)


@pytest.mark.parametrize(
    ("overrides", "changes"),
    [
        (["algo.gamma=0.9", "train.steps=1_000"], "algo.gamma=0.9, train.steps=1000"),
        (["budget.steps.hopper=1_000"], "train.steps=1000"),  # by what it comes to
        (["algo=td3"], "algo=td3"),  # by the word: the settings of two algorithms are all different
        (["algo=td3", "algo.gamma=0.9"], "algo=td3, algo.gamma=0.9"),
        (["algo=sac", "trainer=fleet"], ""),  # which the level of the folder names
        (["algo=ars"], ""),
        (["+env.kwargs.healthy_reward=0.5"], "env.kwargs.healthy_reward=0.5"),
        (["polish=true", "n_workers=1", "results_dir=elsewhere"], ""),
        (
            ["method=distilled_otr", "trainer=shrink", "algo=td3", "polishing.by=search"],
            "algo=td3, polishing.by=search",
        ),
    ],
)
def test_a_folder_says_what_is_changed(overrides, changes):
    config = made("env=hopper", "budget=quick", *overrides)
    assert sorted(config.changes.split(", ")) == sorted(changes.split(", "))
    assert ("~" in config.folder) == bool(changes)


def test_a_job_is_composed_once(monkeypatch):
    """Whatever it changes; its oracle is a job of its own."""
    composed = []
    monkeypatch.setattr(RUN, "_composed", {})
    original = RUN._compose_exactly
    monkeypatch.setattr(RUN, "_compose_exactly", lambda own: composed.append(own) or original(own))
    made("env=halfcheetah", "algo=ars", "algo.noise=0.1", "depth=3", "seed=1")
    assert len(composed) == 1
    made("env=bipedalwalker", "method=viper", "trainer=sb3", "method.criterion=entropy", "oracle=[8]", "seed=1")
    assert len(composed) == 3


def test_the_search_has_an_environments_own_settings():
    hopper, ant = made("env=hopper", "algo=ars").algo, made("env=ant", "algo=ars").algo
    assert hopper.alive_bonus == ant.alive_bonus == 1.0 and hopper.n_directions != ant.n_directions
