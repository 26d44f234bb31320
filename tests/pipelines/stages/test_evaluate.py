"""Map, prune and evaluate on known networks: what they write, and that a wrong tree is caught."""

import json
import math

import numpy as np
import pytest

import otr
from pipelines.config.stages import MapConfig, PruneConfig
from pipelines.engine.store import read_csv, write_files
from pipelines.errors import PipelineError, PolicyMismatchError
from pipelines.play.actor_files import actor_files, load_actor
from pipelines.play.agreement import answers_agree
from pipelines.play.episodes import play_each
from pipelines.stages.evaluate import evaluate
from pipelines.stages.map import map_actor
from pipelines.stages.prune import prune
from tests.pipelines.play.test_episodes import PENDULUM, random_network


@pytest.fixture
def chain(tiny, tmp_path):
    """Return a function that saves a network, maps and prunes it, and gives the stages' folders."""

    def make(config, network=None):
        folders = {name: tmp_path / name for name in ("train", "map", "prune")}
        for folder in folders.values():
            folder.mkdir()
        write_files(actor_files(network or random_network(PENDULUM, seed=1, width=6)), folders["train"])
        map_actor({"train": folders["train"]}, config, folders["map"])
        prune(folders, config, folders["prune"])
        return folders

    return make


@pytest.mark.parametrize(("max_leaves", "kind"), [(1024, "oblique_tree"), (8, "pattern_tree")])
def test_three_forms_of_one_policy_play_alike(tiny, chain, tmp_path, max_leaves, kind):
    config = tiny(map=MapConfig(max_leaves), prune=PruneConfig(20, None))
    folders = chain(config)
    mapped, pruned = (json.loads((folders[name] / "report.json").read_text()) for name in ("map", "prune"))
    assert mapped == {"kind": kind, "n_leaves": 64, "depth": 6}
    assert (folders["map"] / "program.txt").exists() == (kind == "oblique_tree")
    assert pruned["n_leaves"] == pruned["patterns"] == round(2 ** pruned["pruned_depth"])
    assert pruned["n_states"] == 20 * 200
    out = tmp_path / "evaluate"
    out.mkdir()
    evaluate(folders, config, out)
    report = json.loads((out / "report.json").read_text())
    assert report["policies"]["network"] == report["policies"]["tree"]
    assert 0.9 < report["fidelity"] <= 1.0
    assert [row["seed"] for row in read_csv(out / "episodes_network.csv")] == ["1000", "1001", "1002"]


def test_states_outside_the_network_s_domain_are_counted(tiny, chain, tmp_path):
    network, domain = random_network(PENDULUM, seed=1, width=6), ([-1.0, -1.0, -2.0], [1.0, 1.0, 2.0])
    folders = chain(
        tiny(), otr.ReluNetwork(network.weights, network.biases, head=network.head, domain=otr.Domain(*domain))
    )
    assert load_actor(folders["train"]).domain == otr.Domain(*domain)
    out = tmp_path / "evaluate"
    out.mkdir()
    evaluate(folders, tiny(), out)
    report = json.loads((out / "report.json").read_text())
    played = play_each({"network": network}, tiny())["network"].states
    assert report["n_outside_domain"] == (np.abs(played[:, 2]) > 2).sum() > 0


def test_patterns_are_those_of_the_network(tiny, chain):
    config = tiny(prune=PruneConfig(3, None))
    folders = chain(config)
    from pipelines.engine.seeding import episode_seeds
    from pipelines.play.episodes import play_seeds

    network = load_actor(folders["train"])
    states = play_seeds(network.predict, PENDULUM, episode_seeds(0, "prune", 3), keep_states=True, n_workers=1).states
    n_patterns = len(np.unique(network.patterns(states), axis=0))
    report = json.loads((folders["prune"] / "report.json").read_text())
    assert report["patterns"] == n_patterns
    assert report["pruned_depth"] == pytest.approx(math.log2(n_patterns))


def test_k_keeps_the_k_most_frequent_paths(tiny, chain):
    folders = chain(tiny(prune=PruneConfig(5, 3)))
    report = json.loads((folders["prune"] / "report.json").read_text())
    assert report["n_leaves"] == 3 < report["patterns"]


def test_wrong_tree_is_caught_with_its_state(tiny, chain, tmp_path):
    config = tiny()
    folders = chain(config)
    tree = otr.load(folders["map"] / "tree")
    c = tree.c.copy()
    c += 1e-3
    wrong = otr.ObliqueTree(
        tree.children_left, tree.children_right, tree.P, tree.v, tree.M, c, labels=tree.labels, head=tree.head
    )
    otr.save(wrong, folders["map"] / "tree")
    out = tmp_path / "evaluate"
    out.mkdir()
    with pytest.raises(PolicyMismatchError, match=r"network and tree differ in \d+ of 600 states; the first is \["):
        evaluate(folders, config, out)


def test_agreement_is_relative_and_forgives_ties_of_labels():
    outputs = np.array([[0.5, 2500.0], [0.5, 2500.0]])
    ours, theirs = np.array([[0.5, 1000.0], [0.5, 1000.0]]), np.array([[0.5, 1000.0005], [0.502, 1000.0]])
    assert answers_agree(ours, theirs, outputs, 1e-6).tolist() == [True, False]
    logits = np.array([[1.0, 1.0 + 1e-9], [1.0, 2.0]])
    assert answers_agree(np.array([0, 0]), np.array([1, 1]), logits, 1e-6).tolist() == [True, False]
    signs = np.array([[0.0], [1e-9], [0.5], [-2.0]])  # of one output the sign decides
    assert answers_agree(np.array([0, 0, 0, 1]), np.array([1, 1, 1, 0]), signs, 1e-6).tolist() == [
        True, True, False, False,
    ]  # fmt: skip


def test_actor_round_trips_and_damage_is_told(tmp_path):
    network = random_network(PENDULUM)
    write_files(actor_files(network), tmp_path)
    again = load_actor(tmp_path)
    states = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_array_equal(again.predict(states), network.predict(states))
    path = tmp_path / "actor.safetensors"
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(PipelineError, match="delete the folder"):
        load_actor(tmp_path)
    path.unlink()
    with pytest.raises(PipelineError, match=r"actor\.safetensors"):
        load_actor(tmp_path)
