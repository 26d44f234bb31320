"""Methods whose actor is a soft tree, and linear policies by random search: from the command line to the summary."""

import json

import numpy as np
import pytest

import otr
from pipelines.cli.runs import RUN, run_config
from pipelines.errors import ConfigError
from pipelines.training.settings import train_keys
from tests.pipelines.conftest import otr_command, otr_succeeds


@pytest.mark.parametrize(
    ("words", "forms"),
    [
        (("env=lunarlander", "method=sdt", "depth=2"), ["soft", "tree", "pruned_tree", "discretised"]),
        (("env=pendulum", "method=cdt", "depth=[1,2]"), ["soft", "tree", "pruned_tree", "discretised"]),
        (("env=pendulum", "method=pi_prl", "depth=2"), ["soft", "tree", "pruned_tree"]),
        (("env=pendulum", "method=pi_prl", "depth=2", "algo=sac"), ["soft", "tree", "pruned_tree"]),
        (("env=pendulum", "method=experts", "depth=3"), ["tree", "pruned_tree"]),
        (("env=pendulum", "method=linear", "depth=0", "algo=ars"), ["network", "tree", "pruned_tree"]),
    ],
    ids=["sdt", "cdt", "pi_prl", "pi_prl-sac", "experts", "ars"],
)
def test_every_form_is_played(tmp_path, words, forms):
    otr_succeeds("otr-run", *words, "budget=smoke", "n_workers=1", cwd=tmp_path)
    (path,) = tmp_path.glob("results/runs/*/*/*/*/*/summary.json")
    summary = json.loads(path.read_text())
    assert list(summary["policies"]) == forms
    assert summary["return_mean"] == summary["policies"]["tree"]["return_mean"]
    assert "ars" not in words[-1] or path.parent.parent.name == "smoke-ars"
    again = otr_command("otr-run", *words, "budget=smoke", "n_workers=1", cwd=tmp_path)
    assert again.stdout.count("done before") == 4
    replayed = otr_command("otr-tabulate", "table=4.1", "evaluate=true", cwd=tmp_path)
    assert replayed.stdout.count("as recorded") == len(forms), replayed.stdout + replayed.stderr


@pytest.mark.parametrize(
    ("words", "algo", "gamma", "steps", "interval"),
    [
        (("env=lunarlander", "method=sdt", "depth=5"), "ppo", 0.999, 1_000_000, 25_000),
        (("env=hopper_v5", "method=pi_prl", "depth=6"), "ppo", 0.99, 500_000, 25_000),
        (("env=pendulum", "method=cdt", "depth=[3,3]", "train.steps=7"), "ppo", 0.9, 7, 25_000),
        (("env=pendulum", "method=sdt", "depth=3", "algo=sac", "trainer=fleet"), "sac", 0.99, 30_000, 5_000),
        (("env=pendulum", "method=otr"), "sac", 0.99, 30_000, 5_000),
    ],
)
def test_soft_trees_bring_their_algorithm_and_steps(words, algo, gamma, steps, interval):
    config = run_config([*words, "budget=quick"])
    assert (config.algo.name, config.algo.gamma) == (algo, gamma)
    assert (config.train.steps, config.train.eval_interval_steps) == (steps, interval)
    assert config.trainer_name == ("fleet" if "trainer=fleet" in words else "sb3")


def test_an_algorithm_may_be_one_methods_and_one_environments():
    cdt, sdt = (run_config(["env=lunarlander", f"method={method}", f"depth={depth}"]).algo
                for method, depth in (("cdt", "[3,3]"), ("sdt", "5")))  # fmt: skip
    assert (cdt.learning_rate, sdt.learning_rate) == (3e-3, 1e-3)
    assert (cdt.gamma, cdt.ent_coef) == (sdt.gamma, sdt.ent_coef)


def test_random_search_lies_beside_the_gradient(tiny):
    config = run_config(["env=pendulum", "method=linear", "depth=0", "algo=ars", "budget=quick"])
    assert (config.budget_level, config.trainer_name) == ("quick-ars", "ars")
    assert config.train.steps == config.budget.search["pendulum"]["steps"]
    assert config.algo.environments == "numpy"  # the pendulum's own settings of the search
    with pytest.raises(ConfigError, match="algo=ars searches small networks"):
        run_config(["env=pendulum", "depth=[64]", "algo=ars", "budget=quick"])


@pytest.mark.parametrize(("budget", "steps"), [("standard", 1_000_000), ("thesis", 3_000_000), ("quick", 300_000)])
def test_experts_bring_soft_actor_critic_and_the_fleet(budget, steps):
    (job,) = RUN.jobs([["env=bipedalwalker", "method=experts", "depth=8", f"budget={budget}"]])
    config = job.config
    assert (config.algo.name, config.trainer_name, config.method.balance) == ("sac", "fleet", 0.01)
    assert config.train.steps == steps
    assert job.folder == f"runs/bipedalwalker/experts/depth-8/{budget}-fleet/seed-0"
    assert train_keys(config)["method"] == {"name": "experts", "balance": 0.01}
    (spelt_out,) = RUN.jobs([[*job.overrides, "algo=sac", "trainer=fleet"]])
    assert spelt_out.folder == job.folder


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("method=sdt", "depth=0"), "depth=0: method=sdt grows a tree"),
        (("method=sdt", "depth=2", "algo=td3"), "is trained by algo=ppo_tree or algo=sac, not td3"),
        (("method=cdt", "depth=3"), r"give both depths, as depth=\[3,3\]"),
        (("method=experts", "depth=1"), "depth=1: of method=experts it is the number of experts; give 2 to 16"),
        (("method=experts", "depth=17"), "depth=17: of method=experts"),
        (("method=experts", "depth=[3,3]"), "depth=.3, 3.: of method=experts"),
        (("method=experts", "algo=td3"), "method=experts is trained by algo=sac, not td3"),
        (("method=experts", "trainer=sb3"), "method=experts is trained by trainer=fleet, not trainer=sb3"),
    ],
)
def test_what_soft_trees_and_experts_are_refused_for(words, message):
    with pytest.raises(ConfigError, match=message):
        run_config(["env=pendulum", "budget=quick", *words])


@pytest.mark.parametrize("by", ["critic", "search"])
def test_experts_are_polished_as_what_they_are(tmp_path, by):
    """Four experts and six tests of four numbers each, however often the tree repeats them."""
    words = ("env=pendulum", "method=experts", "depth=4", "budget=smoke", "n_workers=1", "prune.n_episodes=20",
             "polish=true", f"polishing.by={by}", "polishing.n_selection_episodes=4", "polishing.n_directions=2",
             "polishing.n_top=2", "polishing.n_candidates=1", "polishing.critic.batch_size=32")  # fmt: skip
    otr_succeeds("otr-run", *words, cwd=tmp_path)
    (made,) = tmp_path.glob("results/runs/pendulum/experts/depth-4/smoke-fleet/seed-0~*")
    before, after = (otr.load(made / stage / "tree") for stage in ("prune", "polish"))
    n_kinds = [len(np.unique(tree.leaf_forms.reshape(tree.n_leaves, -1), axis=0)) for tree in (before, after)]
    n_tests = [len(np.unique(tree.test_forms, axis=0)) for tree in (before, after)]
    assert n_kinds[0] == n_kinds[1] <= 4 and n_tests[0] == n_tests[1] <= 6
    assert before.n_leaves > n_kinds[0]
    assert json.loads((made / "polish/report.json").read_text())["n_numbers"] == 4 * (n_kinds[0] + n_tests[0])


def test_experts_that_imitate_are_polished_by_their_oracle_s_critics(tmp_path):
    words = ("env=pendulum", "method=distilled_experts", "depth=3", "trainer=fleet", "algo.critic=[16]", "oracle=[16]",
             "budget=smoke", "n_workers=1", "method.n_updates=50", "polish=true", "polishing.n_selection_episodes=4",
             "polishing.n_candidates=1", "polishing.critic.batch_size=32")  # fmt: skip
    done = otr_succeeds("otr-run", *words, cwd=tmp_path)
    assert "numbers of the tree learnt by critics" in done.stdout
    (made,) = tmp_path.glob("results/runs/pendulum/distilled_experts/depth-3/smoke-fleet/seed-0~*")
    summary = json.loads((made / "summary.json").read_text())
    assert list(summary["policies"]) == ["oracle", "tree", "pruned_tree"]
    tree = otr.load(made / "imitate/tree")
    assert tree.head == otr.ClipBox([-2.0], [2.0]) and len(np.unique(tree.leaf_forms, axis=0)) == 3
    again = otr_command("otr-run", *words, cwd=tmp_path)
    assert again.stdout.count("done before") == 5


@pytest.mark.parametrize("method", ["experts", "distilled_experts"])
def test_experts_of_labels_are_refused_before_anything_is_trained(tmp_path, method):
    done = otr_command("otr-run", "env=lunarlander", f"method={method}", "depth=3", "budget=smoke", cwd=tmp_path)
    assert done.returncode == 2 and not list(tmp_path.glob("results/*"))
    assert f"method={method} has continuous actions, but those of LunarLander-v3 are labels" in done.stderr
