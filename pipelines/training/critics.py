"""Critics on disk: `critics.safetensors` next to the actor whose play they judge.

What continues from an actor takes over its critics (`pipelines/stages/polish.py`). They are those of the segment whose
actor was kept: values are of one policy, and the critics of a later segment judge a policy that was found worse. Adam's
moments are not among them. The file is a megabyte and serves polishes alone, so archives of runs leave it out.
"""

from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as safetensors_bytes

from otr.importers.critics import Critics
from pipelines.engine.store import corrupt, exists, read_bytes
from pipelines.errors import PipelineError

CRITICS = "critics.safetensors"


def critics_file(critics: Critics) -> dict[str, bytes]:
    """Return the file of critics, in single precision, by its name."""
    tensors = {
        f"{name}.{kind}{i}": array
        for name, layers in (("critics", critics.layers), ("targets", critics.targets))
        for i, layer in enumerate(layers)
        for kind, array in zip(("weight", "bias"), layer, strict=True)
    }
    numbers = {name: getattr(critics, name) for name in ("gamma", "negative_slope", "log_temperature", "log_std")}
    tensors |= {name: np.array(value) for name, value in numbers.items() if value is not None}
    return {CRITICS: safetensors_bytes({name: np.asarray(each, np.float32, "C") for name, each in tensors.items()})}


def load_critics(folder: Path) -> Critics:
    """Return the critics in a stage's folder.

    Raises:
        PipelineError: there are none, as committed results keep none; names what makes them.
    """
    if not exists(folder / CRITICS):
        raise PipelineError(
            f"{folder / CRITICS} is not there: trainer=fleet with algo=sac makes critics, zips of Stable-Baselines3's "
            "SAC, TD3 and DDPG have some, and committed results are without\n"
            "Run the same command with results_dir=DIR, another folder: it trains or imports again there and keeps "
            "them. Or use polishing.by=search, which needs none."
        )
    try:
        found = load_tensors(read_bytes(folder / CRITICS))
        n_layers = sum(name.startswith("critics.weight") for name in found)
        layers, targets = (
            [(found[f"{name}.weight{i}"], found[f"{name}.bias{i}"]) for i in range(n_layers)]
            for name in ("critics", "targets")
        )
        gamma, slope = float(found["gamma"]), float(found["negative_slope"])
        temperature = float(found["log_temperature"]) if "log_temperature" in found else None
        return Critics(layers, targets, gamma, slope, temperature, found.get("log_std"))
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise corrupt(folder / CRITICS, error) from error
