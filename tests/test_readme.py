"""README's Python does what it says: every block is run, in one folder with a saved model."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

import otr

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `model.zip`: a PPO of three ReLU neurons that balances CartPole by the angle and its speed."""
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
    model.save(made / "model.zip")
    return made


def test_the_examples_run(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    names: dict = {}
    for block in BLOCKS:
        exec(compile(block, str(README), "exec"), names)
    shown, text = capsys.readouterr().out.split("\n", 1)
    program, why = text.split("\nleaf ")
    assert shown == "Rollout(return 500 ± 0 over 100 episodes, 50,000 steps)"
    tree, net, played = names["tree"], names["net"], names["played"]
    assert 1 < tree.n_leaves < otr.map_network(net).n_leaves
    np.testing.assert_array_equal(tree.predict(played.states), net.predict(played.states))
    read = otr.parse_program(program, ["x", "v", "angle", "spin"], output_names=["left", "right"], labels=True)
    assert (read.predict(played.states) == played.actions).mean() > 0.99  # its numbers have four digits
    assert "\nnearest state of another label, " in why and "  decisions\n" in why
    assert names["proof"].max_error < 1e-9 and "double" in names["c_code"]
