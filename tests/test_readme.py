"""README does what it says: its Python is run, in one folder with a saved model, and its table is that of the runs."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO, SAC

import otr
from pipelines.report.headline import headline_table
from pipelines.report.verdicts import verdicts
from tests.committed import RESULTS

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `policy.zip`: a PPO of three ReLU neurons that balances CartPole by the angle and its speed."""
    made = tmp_path_factory.mktemp("readme")
    settings = {"net_arch": {"pi": [3], "vf": [3]}, "activation_fn": torch.nn.ReLU}
    model = PPO("MlpPolicy", "CartPole-v1", policy_kwargs=settings, seed=0, device="cpu")
    layers = model.policy.mlp_extractor.policy_net[0], model.policy.action_net
    falling = [0.05, 0.2, 1.0, 0.5]  # position, its speed, angle, its speed
    with torch.no_grad():
        layers[0].weight.copy_(torch.tensor([falling, [-w for w in falling], [1.0, 0.0, 0.0, 0.0]]))
        layers[0].bias.copy_(torch.tensor([0.1, 0.1, -2.0]))
        layers[1].weight.copy_(torch.tensor([[-1.0, 1.0, 0.0], [1.0, -1.0, 0.01]]))
        layers[1].bias.zero_()
    model.save(made / "policy.zip")
    return made


def test_the_example_runs(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    names: dict = {}
    (block,) = BLOCKS
    exec(compile(block, str(README), "exec"), names)
    shown, program = capsys.readouterr().out.split("\n", 1)
    assert shown == "Rollout(return 500 ± 0 over 100 episodes, 50,000 steps)"
    read = otr.parse_program(program, ["x", "v", "angle", "spin"], output_names=["left", "right"], labels=True)
    states = otr.rollout("CartPole-v1", names["policy"], n_episodes=5).states  # its numbers have four digits
    assert (read.predict(states) == names["tree"].predict(states)).mean() > 0.99
    assert "double" in names["c_code"]


def test_tables_are_those_of_the_committed_runs() -> None:
    assert headline_table(RESULTS) in README.read_text(encoding="utf-8"), "run python -m pipelines.report.headline"
    findings = (RESULTS.parent / "docs/findings.md").read_text(encoding="utf-8")
    for task, verdict in verdicts(RESULTS).items():
        assert f"<!-- {task} -->\n{verdict}\n<!-- end -->" in findings, "run python -m pipelines.report.verdicts"


MODELS = {
    "PPO of [8, 8] ReLU": (PPO, "CartPole-v1", {"net_arch": [8, 8], "activation_fn": torch.nn.ReLU}),
    "PPO as it is, tanh [64, 64]": (PPO, "CartPole-v1", {}),
    "DQN as it is": (DQN, "CartPole-v1", {}),
    "SAC as it is, [256, 256]": (SAC, "Pendulum-v1", {}),
}


@pytest.mark.parametrize("name", MODELS)
def test_the_first_lines_work_for_what_people_train(name: str, tmp_path: Path) -> None:
    algorithm, env, settings = MODELS[name]
    options = {"buffer_size": 10} if algorithm is not PPO else {}
    model = algorithm("MlpPolicy", env, policy_kwargs=settings, seed=0, device="cpu", **options)
    model.save(tmp_path / "model.zip")
    net = otr.read_policy(tmp_path / "model.zip")
    played = otr.rollout(env, net, n_episodes=2)
    theirs = model.predict(played.states.astype(np.float32), deterministic=True)[0]
    np.testing.assert_allclose(played.actions, theirs.reshape(played.actions.shape), atol=1e-5)
    if "tanh" in name:
        with pytest.raises(TypeError, match=r"no tree equals .* a tree can imitate it: otr\.imitate\(policy, env\)"):
            otr.tree(net, played.states)
    else:
        tree = otr.tree(net, played.states)
        np.testing.assert_allclose(tree.predict(played.states), net.predict(played.states), atol=1e-9)
        with pytest.raises(otr.TreeTooLargeError, match=r"use otr\.tree\(network, states\)"):
            otr.map_network(net, max_leaves=2**10)
    few = {"n_rounds": 1, "n_episodes": 1, "n_choice_episodes": 1}
    short = otr.imitate(net, env, method="augtree", depth=3, progress=False, **few)
    assert short.n_leaves <= 8 and len(otr.evaluate(env, short, n_episodes=2).returns) == 2
    assert "return" in otr.to_text(short) and "double" in otr.to_c(short)
