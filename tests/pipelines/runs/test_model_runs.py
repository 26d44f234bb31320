"""Policies from elsewhere, from a file of Stable-Baselines3, ONNX, torch, scikit-learn or otr to a run's summary."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import skops.io
import torch
from onnx import TensorProto, helper, numpy_helper
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import otr
from otr.importers import read_policy
from pipelines.cli.overrides import with_path_quoted
from pipelines.cli.runs import RUN
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError
from pipelines.play.actor_files import load_actor, load_oracle_network
from pipelines.runs.below_random import warning_below_random
from pipelines.stages.import_model import read_model
from tests.pipelines.conftest import otr_command, otr_succeeds
from tests.programs.test_c import compiled, runner

CART_POLE = EnvConfig("CartPole-v1", "discrete", "CartPole-v1")
SMOKE = ("env=CartPole-v1", "budget=smoke", "n_workers=1")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A folder with a ReLU policy and a tanh one for the cart pole, and one for the pendulum under VecNormalize."""
    folder = tmp_path_factory.mktemp("models")
    torch.set_num_threads(1)
    relu = {"net_arch": [3], "activation_fn": torch.nn.ReLU}
    PPO("MlpPolicy", "CartPole-v1", policy_kwargs=relu, n_steps=64, seed=0).learn(64).save(folder / "relu.zip")
    tanh = PPO("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [5, 5]}, n_steps=256, seed=0).learn(512)
    tanh.save(folder / "tanh.zip")
    envs = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    PPO("MlpPolicy", envs, policy_kwargs=relu, n_steps=64, seed=0).learn(64).save(folder / "pendulum.zip")
    envs.save(folder / "statistics.pkl")
    network = otr.from_sb3(folder / "relu.zip").replace(head=otr.Identity())
    otr.save(otr.PatternTree(network), folder / "network.json")
    _write_onnx(network, folder / "network.onnx")
    otr.save(otr.PatternTree(otr.ReluNetwork([np.ones((2, 4))], [np.zeros(2)])), folder / "linear.json")
    return folder


def _write_onnx(network, path, *others):
    arrays = {name: numpy_helper.from_array(array, name) for name, array in zip(
        "WbVc", (network.weights[0], network.biases[0], network.weights[1], network.biases[1]), strict=True
    )}  # fmt: skip
    nodes = [
        helper.make_node("Gemm", ["x", "W", "b"], ["z"], transB=1),
        helper.make_node("Relu", ["z"], ["h"]),
        helper.make_node("Gemm", ["h", "V", "c"], ["y"], transB=1),
    ]
    x, y = (helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["n", d]) for name, d in (("x", 4), ("y", 2)))
    others = [helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["n", 3]) for name in others]
    graph = helper.make_graph(nodes, "policy", [x], [y, *others], list(arrays.values()))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())


def jobs(*words):
    multirun = "-m" in words
    return RUN.jobs(RUN.expand([with_path_quoted(word) for word in words if word != "-m"], multirun))


def test_an_oracle_from_a_file_takes_the_place_of_one_that_a_fleet_trains(models):
    (job,) = jobs("env=pendulum", "method=viper", f"oracle={models / 'pendulum.zip'}")  # the standard recipe's trainer
    assert job.folder.startswith("runs/pendulum/viper/depth-6/standard/seed-0~") and "trainer" not in job.config.changes
    assert job.config.trainer_name == "none"


def test_a_zip_is_a_run_like_others(models):
    names = ("env.feature_names=[x,v,angle,rate]", "env.action_names=[left,right]")
    words = (*SMOKE, "model=relu.zip", "certify=true", "polish=true", *names)
    done = otr_succeeds("otr-run", *words, cwd=models)
    (run,) = models.glob("results/runs/CartPole-v1/model/depth-3/smoke/seed-0~*")
    summary = json.loads((run / "summary.json").read_text())
    told = [summary[name] for name in ("model", "algorithm", "trainer", "steps")]
    assert told == ["relu.zip", "none", "none", 0]
    assert summary["certify"]["certified"] and list(summary["seconds"])[:2] == ["import", "map"]
    assert "model relu.zip, seed 0" in done.stdout
    assert " rate" in (run / "prune/program.txt").read_text()
    states = np.random.default_rng(0).normal(size=(500, 4))
    theirs = PPO.load(models / "relu.zip").predict(states, deterministic=True)[0]
    np.testing.assert_array_equal(load_actor(run / "import").predict(states), theirs)
    np.testing.assert_array_equal(otr.load(run / "map/tree").predict(states), theirs)
    assert otr_command("otr-run", *words, cwd=models).stdout.count("done before") == 6
    verified = otr_command("otr-verify", f"run={run}", cwd=models)
    assert verified.returncode == 0 and verified.stdout.startswith("verified:"), verified.stderr
    exported = otr_command("otr-export", f"run={run}", "format=c", "tree=compact", cwd=models)
    assert "A network of 3 hidden neurons" in exported.stdout, exported.stderr


def test_the_file_decides_the_run(models, tmp_path):
    (tmp_path / "same one.zip").write_bytes((models / "relu.zip").read_bytes())
    network = otr.from_sb3(models / "relu.zip")
    otr.save(otr.PatternTree(network.replace(biases=[2 * bias for bias in network.biases])), tmp_path / "other")
    paths = (models / "relu.zip", models / "relu", tmp_path / "same one.zip", tmp_path / "other.json")
    one, without_suffix, same, other = (jobs(*SMOKE, f"model={path}")[0].folder for path in paths)
    assert one == same == without_suffix != other
    assert one.startswith("runs/CartPole-v1/model/depth-3/smoke/seed-0~")


def test_arrays_alone_do_not_tell_one_saved_policy_from_another(models, tmp_path):
    network, keys = otr.from_sb3(models / "relu.zip"), []
    for slope in (0.0, 0.5):  # which the JSON beside the arrays has
        otr.save(otr.PatternTree(network.replace(negative_slope=slope)), tmp_path / "one")
        keys.append([jobs(*SMOKE, f"model={tmp_path / name}")[0].folder for name in ("one.npz", "one.json")])
    assert keys[0] != keys[1] and keys[0][0] != keys[1][0]


@pytest.fixture
def normalised_pendulum(models, tmp_path):
    """A folder with a zip and its statistics, as rl-baselines3-zoo saves them."""
    (tmp_path / "pendulum").mkdir()
    (tmp_path / "pendulum.zip").write_bytes((models / "pendulum.zip").read_bytes())
    (tmp_path / "pendulum/vecnormalize.pkl").write_bytes((models / "statistics.pkl").read_bytes())
    return tmp_path


def test_statistics_beside_a_zip_are_used_and_the_command_says_so(normalised_pendulum, capsys):
    def asked(*words):
        (job,) = jobs("env=Pendulum-v1", "budget=smoke", f"model={normalised_pendulum / 'pendulum.zip'}", *words)
        return job, capsys.readouterr().err

    statistics = normalised_pendulum / "pendulum/vecnormalize.pkl"
    (found, told), (given, silent) = asked(), asked(f"normalise={statistics}")
    assert found.folder == given.folder and found.config.imported.sha256 == given.config.imported.sha256
    assert f"is read with the statistics of {statistics}" in told and silent == ""
    for word in ("normalise=none", "normalise=null", "normalise=None"):
        raw, silent = asked(word)
        assert raw.folder != found.folder and raw.config.imported.policy.domain is None and silent == ""
    oracle, told = asked("method=viper", "depth=3")
    assert oracle.oracle.config.imported.sha256 == found.config.imported.sha256 and told.count("statistics of") == 1
    statistics.unlink()
    missing, told = asked()
    assert missing.folder == raw.folder and "was trained under VecNormalize, so the network may expect" in told


def test_a_policy_that_is_worse_than_random_actions(normalised_pendulum):
    words = ("env=Pendulum-v1", f"model={normalised_pendulum / 'pendulum.zip'}", "normalise=none")
    (job,), (imitating,) = jobs(*words), jobs(*words, "method=viper")
    for name, config in (("network", job.config), ("oracle", imitating.config)):
        worse, better = ({"policies": {name: {"return_mean": mean}}} for mean in (-1500.0, -900.0))
        told = warning_below_random(config, worse)
        assert told.startswith("pendulum.zip returns -1,500.0, less than random actions do in Pendulum-v1 (-1,268.5): ")
        assert told.endswith("normalise=FILE names the file of its statistics")
        assert warning_below_random(config, better) is None
        with_statistics = replace(config, imported=replace(config.imported, is_normalised=True))
        assert warning_below_random(with_statistics, worse).endswith("or with wrappers that this one lacks?")
        assert warning_below_random(replace(config, imported=None), worse) is None


def test_the_output_of_an_onnx_model_with_several(models, tmp_path):
    network = otr.from_sb3(models / "relu.zip").replace(head=otr.Identity())
    path = tmp_path / "several.onnx"
    _write_onnx(network, path, "h")
    asked = "the model has several outputs; give output= one of 'y', 'h'"
    for words in ((f"model={path}",), ("method=viper", f"oracle={path}")):
        with pytest.raises(ConfigError, match=f"{words[-1]}: {asked}"):
            jobs(*SMOKE, *words)
        with pytest.raises(ConfigError, match=r"the model has no output 'x'; give output= one of 'y', 'h'"):
            jobs(*SMOKE, *words, "output=x")
        (job,) = jobs(*SMOKE, *words, "output=y")
        np.testing.assert_array_equal(job.config.imported.policy.weights[1], network.weights[1])
    with pytest.raises(ConfigError, match=r"the policy has 3 actions, CartPole-v1 has 2"):
        jobs(*SMOKE, f"model={path}", "output=h")
    with pytest.raises(otr.InvalidNetworkError, match=asked):
        read_policy(path)
    assert read_policy(path, output="h").n_outputs == 3
    shas = {read_model(str(path), None, CART_POLE, output="y").sha256, job.oracle.config.imported.sha256}
    assert len(shas) == 1
    with pytest.raises(otr.InvalidNetworkError, match=r"output='y' is one of several outputs of an ONNX model; .*zip"):
        read_policy(models / "relu.zip", output="y")
    with pytest.raises(ConfigError, match=r"output=y: of which model. Add model=FILE"):
        jobs(*SMOKE, "output=y")


def test_torch_exports_and_skops_files(models):
    states = np.random.default_rng(1).normal(size=(200, 4)).astype(np.float32)
    labels = (states[:, 2] > 0).astype(int)
    fitted = make_pipeline(StandardScaler(), MLPClassifier((3,), max_iter=5, random_state=0)).fit(states, labels)
    skops.io.dump(fitted, models / "classifier.skops")
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(4, 3), torch.nn.Tanh(), torch.nn.Linear(3, 2), torch.nn.Softmax(dim=1))
    torch.export.save(torch.export.export(module, (torch.zeros(1, 4),)), models / "probabilities.pt2")
    likelier = module(torch.from_numpy(states)).argmax(dim=1).numpy()
    for name, expected in (("classifier.skops", fitted.predict(states)), ("probabilities.pt2", likelier)):
        policy = read_model(str(models / name), None, CART_POLE).policy
        assert policy.head.gives_labels and 0 < expected.mean() < 1
        np.testing.assert_array_equal(policy.predict(states), expected)
    (job,) = jobs(*SMOKE, f"model={models / 'classifier.skops'}")
    assert job.folder.startswith("runs/CartPole-v1/model/depth-3/smoke/seed-0~")
    (job,) = jobs(*SMOKE, "method=augtree", "depth=3", f"oracle={models / 'probabilities.pt2'}")
    assert job.config.oracle == [3] and job.folder.startswith("runs/CartPole-v1/augtree/depth-3/smoke/seed-0~")
    with pytest.raises(
        ConfigError,
        match=r"\(tanh\) is not affine, .* no tree is equal to it. Of the methods that",
    ):
        jobs(*SMOKE, f"model={models / 'probabilities.pt2'}")


def test_a_saved_tree_is_a_program(models):
    tree = otr.map_network(otr.from_sb3(models / "relu.zip"))
    otr.save(tree, models / "tree.json")
    otr_succeeds("otr-run", *SMOKE, "model=tree.json", cwd=models)
    (run,) = models.glob("results/runs/CartPole-v1/program/*/smoke/seed-0~*")
    states = np.random.default_rng(2).normal(size=(500, 4))
    np.testing.assert_array_equal(otr.load(run / "parse/tree").predict(states), tree.predict(states))
    with pytest.raises(ConfigError, match=r"the tree reads 4 numbers and has 2 actions, Acrobot-v1 has 6 and 3"):
        jobs("env=Acrobot-v1", f"model={models / 'tree.json'}")


def test_a_tanh_policy_is_an_oracle(models):
    words = ("method=augtree", "oracle=tanh.zip", "depth=3")
    refused = otr_command("otr-run", *SMOKE, "model=tanh.zip", cwd=models)
    assert refused.returncode == 2 and refused.stdout == ""
    assert refused.stderr.endswith("  otr-run env=CartPole-v1 method=augtree oracle=tanh.zip depth=3\n")
    otr_succeeds("otr-run", *SMOKE, *words, cwd=models)
    (run,) = models.glob("results/runs/CartPole-v1/augtree/depth-3/smoke/seed-0~*")
    (imported,) = models.glob("results/runs/CartPole-v1/model/depth-5-5/smoke/seed-0~*")
    states = np.random.default_rng(3).normal(size=(500, 4))
    theirs = PPO.load(models / "tanh.zip").predict(states, deterministic=True)[0]
    np.testing.assert_array_equal(load_oracle_network(imported / "import").predict(states), theirs)
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["model"], summary["trainer"]) == ("tanh.zip", "none")
    assert summary["oracle"]["hidden_widths"] == [5, 5] and "oracle" in summary["policies"]
    plan = otr_command("otr-plan", "-m", *SMOKE, "method=viper,ndps", *words[1:], cwd=models, COLUMNS="200")
    assert plan.stdout.count("is there") == 2, plan.stderr


def test_a_tanh_policy_is_exported_as_c(models, tmp_path):
    done = otr_command("otr-export", "env=CartPole-v1", "model=tanh.zip", "format=c", f"out={tmp_path}", cwd=models)
    assert done.returncode == 0, done.stderr
    source = (tmp_path / "policy.c").read_text()
    states = np.random.default_rng(0).normal(size=(10_000, 4))
    theirs = PPO.load(models / "tanh.zip").predict(states, deterministic=True)[0]
    answers = runner(compiled({"policy": source}, tmp_path), "policy", source)(states)
    assert (answers != theirs).sum() <= 2  # ties within the rounding of torch's single precision
    refused = otr_command("otr-export", "env=CartPole-v1", "model=tanh.zip", "format=text", cwd=models)
    assert refused.returncode == 2 and "is written as the network that it is, by format=c" in refused.stderr


def test_a_model_with_any_units_and_statistics_is_an_oracle(models):
    torch.manual_seed(0)
    layers = (torch.nn.Linear(4, 8), torch.nn.SiLU(), torch.nn.LayerNorm(8), torch.nn.Linear(8, 2))
    module, file = torch.nn.Sequential(*layers), models / "silu.onnx"
    torch.onnx.export(module, (torch.zeros(1, 4),), file, dynamo=False, input_names=["x"], dynamic_axes={"x": [0]})
    statistics = {"mean": [0.1, 0, 0, 0], "var": [4, 1, 1, 0.25], "epsilon": 0.0, "clip": 1.5}
    (models / "statistics.json").write_text(json.dumps(statistics))
    words = ("method=augtree", "oracle=silu.onnx", "normalise=statistics.json", "depth=2")
    refused = otr_command("otr-run", *SMOKE, "model=silu.onnx", "normalise=statistics.json", cwd=models)
    assert refused.returncode == 2 and "no tree is equal to it" in refused.stderr
    told = "  otr-run env=CartPole-v1 method=augtree oracle=silu.onnx depth=3 normalise=statistics.json\n"
    assert refused.stderr.endswith(told)
    otr_succeeds("otr-run", *SMOKE, *words, cwd=models)
    (run,) = models.glob("results/runs/CartPole-v1/augtree/depth-2/smoke/seed-0~*")
    summary = json.loads((run / "summary.json").read_text())
    assert summary["oracle"]["hidden_widths"] == [8] and summary["model"] == "silu.onnx"
    (imported,) = models.glob("results/runs/CartPole-v1/model/depth-8/smoke/seed-0~*")
    X = np.random.default_rng(3).normal(size=(500, 4))
    seen = np.clip((X - statistics["mean"]) / np.sqrt(statistics["var"]), -1.5, 1.5)
    outputs = module(torch.tensor(seen, dtype=torch.float32)).detach().numpy()
    policy = load_oracle_network(imported / "import")
    np.testing.assert_allclose(policy.forward(X), outputs, atol=1e-5)
    assert policy.head == otr.Argmax()


def test_a_network_distilled_from_an_oracle_is_mapped_proved_and_polished(models):
    words = ("method=distilled_otr", "oracle=tanh.zip", "depth=2", "method.n_updates=20", "certify=true", "polish=true")
    done = otr_succeeds("otr-run", *SMOKE, *words, cwd=models)
    (run,) = models.glob("results/runs/CartPole-v1/distilled_otr/depth-2/smoke/seed-0~*")
    network = load_actor(run / "imitate")
    assert network.hidden_widths == (2,) and network.dense == "input" and isinstance(network.head, otr.Argmax)
    states = np.random.default_rng(3).normal(size=(500, 4))
    np.testing.assert_array_equal(otr.load(run / "map/tree").predict(states), network.predict(states))
    summary = json.loads((run / "summary.json").read_text())
    assert list(summary["policies"]) == ["oracle", "network", "tree", "pruned_tree"]
    assert 0.0 <= summary["oracle"]["equal_labels"] <= 1.0 and summary["imitate"]["n_rows"] > 0
    assert summary["certify"]["certified"] and summary["polish"]["numbers"] == "network"
    assert "distilled" in done.stdout and "chooses as the oracle does in" in done.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("model=nosuch.zip",), "model=nosuch.zip: there is no such file"),
        (("method=model",), "method=model: which model"),
        (("model={}/statistics.pkl",), "read are .zip, .onnx, .pt2, .skops, .nnet, .pth, .pt, .json, .npz, not .pkl"),
        (("model={}/pendulum.zip",), "the policy reads 3 numbers, the observations of CartPole-v1 have 4"),
        (("model={}/relu.zip", "normalise={}/gone.pkl"), "normalise=.*gone.pkl: there is no such file"),
        (("model={}/relu.zip", "normalise={}/statistics.pkl"), "3 means and 3 variances, the network has 4"),
        (("model={}/relu.zip", "method=otr"), "is imported by method=model, not by method=otr"),
        (("model={}/relu.zip", "depth=3"), "depth is the model's own; leave depth=3 out"),
        (("model={}/relu.zip", "train.steps=9"), "train.steps=9: nothing is trained, as model=.*relu.zip is there"),
        (("oracle={}/tanh.zip", "method=viper", "algo=ppo"), "algo=ppo: nothing is trained, as model=.*tanh.zip is"),
        (("model={}/relu.zip", "stages=[train]"), "no stage 'train'; it has import, map"),
        (("oracle=nosuch.zip", "method=viper"), "oracle=nosuch.zip: there is no such file"),
        (("oracle={}/linear.json", "method=viper"), "linear.json is linear, which is a tree of one leaf as it is; add"),
        (("oracle={}/tanh.zip",), "who is to imitate it. Add method=viper or"),
        (("oracle={}/tanh.zip", "method=sdt"), "who is to imitate it"),
        (("model={}/tanh.zip", "method=viper", "oracle=[8]"), "leave oracle=.8. out"),
        (
            ("oracle={}/tanh.zip", "method=augtree", "method.features=deep"),
            "has none of .the units are tanh",
        ),
        (("model={}/network.onnx", "normalise={}/statistics.pkl"), "3 means and 3 variances, the network has 4"),
        (
            ("method=viper", "normalise={}/statistics.pkl"),
            "statistics.pkl: of which model. Add model=FILE or oracle",
        ),
        (("model={}",), "that is a folder, expected a file"),
    ],
)
def test_words_that_are_refused(models, words, told):
    with pytest.raises(ConfigError, match=told):
        jobs("env=CartPole-v1", *(word.format(models) for word in words))


def test_a_model_of_other_actions(models):
    network = otr.ReluNetwork([np.ones((1, 2))], [np.zeros(1)], head=otr.ClipBox(-1, 1))
    otr.save(otr.PatternTree(network), models / "force.json")
    labels = EnvConfig("p", "discrete", "tests.pipelines.own_envs:PushOrPull-v0")
    with pytest.raises(ConfigError, match=r"the policy answers with real numbers, the actions of .* are labels"):
        read_model(str(models / "force.json"), None, labels)
    otr.save(otr.PatternTree(network.replace(head=otr.Sign())), models / "sign.json")
    assert read_model(str(models / "sign.json"), None, labels).policy.predict([[1.0, 0.0]]).tolist() == [1]
    with pytest.raises(ConfigError, match=r"the policy answers with labels, the actions of .* are real numbers"):
        read_model(str(models / "sign.json"), None, EnvConfig("c", "continuous", "tests.pipelines.own_envs:Cart-v0"))


def test_a_binary_classifier_of_scikit_learn_has_both_labels_names(tmp_path):
    X = np.random.default_rng(0).normal(size=(300, 4))
    mlp = MLPClassifier([3], max_iter=300, random_state=0).fit(X, (X @ [0.3, 0.5, 8, 2] > 0).astype(int))
    skops.io.dump(mlp, tmp_path / "cart.skops")
    done = otr_succeeds(
        "otr-run", *SMOKE, "model=cart.skops", "certify=true", "env.action_names=[left,right]", cwd=tmp_path
    )
    (run,) = tmp_path.glob("results/runs/CartPole-v1/model/depth-3/smoke/seed-0~*")
    whole = (run / "map/program.txt").read_text()
    assert "return left" in whole and "return right" in whole and "certificate: " in done.stdout


def test_a_proof_that_is_too_long_is_told_and_all_else_is_kept(models, monkeypatch):
    monkeypatch.setattr("pipelines.stages.certify.otr.certify", lambda *given, **limits: too_long())

    def too_long():
        raise otr.TreeTooLargeError("the limit of 65,536 regions was met")

    done = otr_succeeds("otr-run", *SMOKE, "model=relu.zip", "certify=true", cwd=models)
    assert "no certificate on the box" in done.stdout and "the limit of 65,536 regions was met" in done.stdout
