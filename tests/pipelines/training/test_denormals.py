"""Denormal numbers, which exact proofs compute with, are zero while networks train and at no other time."""

import torch
from stable_baselines3 import SAC

from pipelines.training.sb3 import training as sb3_training

TINIEST = torch.tensor([1e-40])


def test_denormals_are_zero_while_stable_baselines3_learns(tiny, tmp_path, monkeypatch):
    seen = []
    learn = SAC.learn

    def watched(model, *arguments, **options):
        seen.append((TINIEST * 0.5).item())
        return learn(model, *arguments, **options)

    monkeypatch.setattr(SAC, "learn", watched)
    out = tmp_path / "out"
    out.mkdir()
    sb3_training.train_by_sb3(tiny(), tmp_path / "checkpoints", out)
    assert set(seen) == {0.0}
    assert (TINIEST * 0.5).item() > 0.0
