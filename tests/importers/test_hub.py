"""Repositories of the Hugging Face Hub: what is asked for, which file is the policy, and its statistics."""

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import otr
from tests.pipelines.conftest import otr_command, otr_succeeds

NAME = "ppo-CartPole-v1"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder sb3/ppo-CartPole-v1 of a hub, as rl-baselines3-zoo fills it; a download copies what is asked for."""
    remote = tmp_path / "hub/sb3" / NAME
    envs = VecNormalize(make_vec_env("CartPole-v1", n_envs=2, seed=0))
    small = {"net_arch": [4], "activation_fn": torch.nn.ReLU}
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=64, seed=0, device="cpu", policy_kwargs=small).learn(64)
    model.save(remote / NAME)
    envs.save(str(remote / "vec_normalize.pkl"))
    for other in ("train_eval_metrics.zip", "replay.mp4"):
        (remote / other).write_text("not a policy")

    def snapshot_download(name: str, *, revision: str | None, allow_patterns: list[str], ignore_patterns: list[str]):
        source, cache = tmp_path / "hub" / name, tmp_path / "cache" / name / (revision or "main")
        wanted = [pattern.replace("*", "") for pattern in allow_patterns]
        for file in [path for path in source.iterdir() if path.name.endswith(tuple(wanted))]:
            cache.mkdir(parents=True, exist_ok=True)
            if file.name not in ignore_patterns:
                shutil.copy(file, cache)
        return str(cache)

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=snapshot_download))
    monkeypatch.chdir(tmp_path)
    return remote


def test_a_policy_is_read_with_its_statistics_and_nothing_else_is_downloaded(hub: Path, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="vec_normalize.pkl, which is next to it"):
        policy = otr.from_hub(f"sb3/{NAME}")
    with pytest.warns(UserWarning):
        local = otr.from_hub(hub)
    states = np.random.default_rng(0).normal(size=(50, 4))
    raw = otr.from_hub(f"hf://sb3/{NAME}@v1/{NAME}.zip", normalise=None)
    assert (policy.forward(states) == local.forward(states)).all()
    assert not np.allclose(policy.forward(states), raw.forward(states))
    loaded = [path.relative_to(tmp_path / "cache").as_posix() for path in (tmp_path / "cache").rglob("*.*")]
    files = (f"{NAME}.zip", "vec_normalize.pkl")
    assert sorted(loaded) == [f"sb3/{NAME}/{revision}/{file}" for revision in ("main", "v1") for file in files]


@pytest.mark.parametrize(
    ("repo", "message"),
    [
        ("sb3/none", r"sb3/none cannot be read from the Hugging Face Hub \(FileNotFoundError: .*\)"),
        ("ppo", "ppo is no folder, and no org/name"),
        (f"sb3/{NAME}/best.zip", rf"has no 'best.zip'; in it: best_model\.zip, {NAME}\.zip$"),
        (f"sb3/{NAME}", rf"2 files of policies, expected one; .*: best_model\.zip, {NAME}\.zip$"),
    ],
)
def test_what_cannot_be_read_says_why(hub: Path, repo: str, message: str) -> None:
    shutil.copy(hub / f"{NAME}.zip", hub / "best_model.zip")
    with pytest.raises(otr.ArtefactError, match=message):
        otr.from_hub(repo)


def test_a_run_takes_its_model_or_oracle_from_the_hub(hub: Path, tmp_path: Path) -> None:
    words = "env=CartPole-v1", "method=augtree", "depth=2", "budget=smoke", "n_workers=1", "stages=[oracle,imitate]"
    done = otr_succeeds("otr-run", *words, f"oracle=hf://sb3/{NAME}", cwd=tmp_path)
    assert "vec_normalize.pkl" in done.stderr
    done = otr_succeeds("otr-run", "env=CartPole-v1", "budget=smoke", f"model=hf://sb3/{NAME}", cwd=tmp_path)
    assert "vec_normalize.pkl" in done.stderr and "leaves" in done.stdout
    missing = otr_command("otr-run", "env=CartPole-v1", "model=hf://sb3/none", cwd=tmp_path)
    assert missing.returncode == 2 and "model=hf://sb3/none: sb3/none cannot be read" in " ".join(
        missing.stderr.split()
    )
