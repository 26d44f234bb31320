"""Files that hold layers but not how they are connected: `.nnet`, and the state_dict of a torch module."""

from __future__ import annotations

import re
import warnings
import zipfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.smooth_network import ACTIVATIONS, Oracle, SmoothNetwork
from otr.errors import ArtefactError, InvalidNetworkError
from otr.importers.sb3_archive import load_tensors
from otr.importers.sb3_layers import Tensors
from otr.importers.torch_modules import real_values

_LIMIT_BYTES = 2**26
_SLOPES = {"relu": 0.0, "leaky_relu": 0.01}
_REMEDY = (
    "save module.state_dict(), or what torch.export.save writes of torch.export.export(module, (states,)) with the "
    "module as Python has it, as policy.pt2"
)


def network_of_nnet(path: Path) -> ReluNetwork:
    """Return the network in a file of the format `.nnet` (ACAS Xu), from raw states to raw outputs.

    The file's minima and maxima, to which such a network's inputs are clipped, are the network's domain.
    """
    lines = [line for line in _text(path).splitlines() if line.strip() and not line.lstrip().startswith("//")]
    try:
        rows = [[float(number) for number in line.replace(",", " ").split()] for line in lines]
        n_layers, d, o = (int(number) for number in rows[0][:3])
        sizes = [int(number) for number in rows[1]]
        low, high, mean, scale = (np.array(row) for row in rows[3:7])
    except (ValueError, IndexError) as error:
        raise ArtefactError(f"{path} is no .nnet file ({error}); write it again") from error
    stored = np.array([number for row in rows[7:] for number in row])
    n_numbers = sum((n_in + 1) * n_out for n_in, n_out in pairwise(sizes))
    shapes = (len(low), len(high), len(mean), len(scale))
    if len(sizes) != n_layers + 1 or (sizes[0], sizes[-1]) != (d, o) or shapes != (d, d, d + 1, d + 1):
        raise ArtefactError(
            f"{path} declares {n_layers} layers of {d} inputs and {o} outputs, of sizes {sizes} and with {shapes} "
            f"limits, means and ranges, expected {(d, d, d + 1, d + 1)}; write it again"
        )
    if min(sizes) < 1 or len(stored) != n_numbers:
        raise ArtefactError(f"{path} holds {len(stored)} weights and biases, its sizes {sizes} need {n_numbers}")
    weights, biases = [], []
    for n_in, n_out in pairwise(sizes):
        weights.append(stored[: n_in * n_out].reshape(n_out, n_in))
        biases.append(stored[n_in * n_out : (n_in + 1) * n_out])
        stored = stored[(n_in + 1) * n_out :]
    weights[-1], biases[-1] = weights[-1] * scale[-1], biases[-1] * scale[-1] + mean[-1]
    network = ReluNetwork(weights, biases).fold_input_normalisation(mean[:-1], scale[:-1])
    return network.replace(domain=Domain(low, high))


def policy_of_state_dict(path: Path, layers: str | Sequence[str] | None, activation: str | None) -> Oracle:
    """Return the network of the linear layers in a file of tensors; `otr.importers.read_policy` documents it."""
    content = path.read_bytes()
    if zipfile.is_zipfile(path) and any("/code/" in name for name in zipfile.ZipFile(path).namelist()):
        raise InvalidNetworkError(f"{path} is TorchScript, which holds code; {_REMEDY}")
    try:
        tensors = load_tensors(content, str(path), is_nested=True)
    except ArtefactError as error:
        raise ArtefactError(f"{error}; {_REMEDY}") from error
    names = _layers(tensors, layers)
    weights = [real_values(tensors[f"{name}.weight"], f"{name}.weight") for name in names]
    biases = [
        real_values(tensors[f"{name}.bias"], f"{name}.bias") if f"{name}.bias" in tensors else np.zeros(len(W))
        for name, W in zip(names, weights, strict=True)
    ]
    known = {*_SLOPES, *ACTIVATIONS}
    if len(weights) > 1 and activation not in known:
        raise InvalidNetworkError(
            f"the layers {', '.join(names)} are stored without what is between them; give activation= one of "
            f"{', '.join(sorted(known))}" + ("" if activation is None else f", not {activation!r}")
        )
    read = {f"{name}.{kind}" for name in names for kind in ("weight", "bias")}
    others = [name for name in tensors if name not in read]
    if others:
        warnings.warn(f"{path}: read are {', '.join(names)}, not {_shown(tensors, others)}", stacklevel=4)
    if len(weights) == 1 or activation in _SLOPES:
        return ReluNetwork(weights, biases, negative_slope=_SLOPES.get(str(activation), 0.0))
    return SmoothNetwork(weights, biases, activation=str(activation))


def _text(path: Path) -> str:
    try:
        n_bytes = path.stat().st_size
        if n_bytes > _LIMIT_BYTES:
            raise ArtefactError(f"{path} has {n_bytes:,} bytes, the limit is {_LIMIT_BYTES:,}; is it the right file?")
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ArtefactError(f"{path} cannot be read ({error}); give the path of a .nnet file") from error


def _layers(tensors: Tensors, given: str | Sequence[str] | None) -> list[str]:
    """Return the names of the layers in order: those given, or all of them where they are one module's and chain."""
    names = [name.removesuffix(".weight") for name in tensors if re.search(r"(^|\.)weight$", name)]
    if given is not None and not isinstance(given, str):
        found = list(given)
    else:
        found = [name for name in names if given is None or name == given or name.startswith(f"{given}.")]
        if not _chain(tensors, found):  # in the order in which modules have them, or else of their numbers
            found.sort(key=lambda name: [int(part) if part.isdigit() else 0 for part in name.split(".")])
    is_of_one = given is not None or len({name.rpartition(".")[0] for name in found}) == 1
    if not (is_of_one and _chain(tensors, found)):
        parts = {name.partition(".")[0] for name in names} | {name.rpartition(".")[0] for name in names} - {""}
        chains = [part for part in sorted(parts) if _chain(tensors, [n for n in names if n.startswith(f"{part}.")])]
        such = f", such as {' or '.join(f'layers={part!r}' for part in chains[:4])}," if chains else ""
        raise InvalidNetworkError(
            f"the layers {', '.join(found) or 'none'} do not chain; give layers= their names in order, or what their "
            f"names begin with{such} of {_shown(tensors, list(tensors))}"
        )
    return found


def _chain(tensors: Tensors, names: list[str]) -> bool:
    """Return whether layers are matrices, of which each reads what the one before it makes."""
    shapes = [tuple(tensors[f"{name}.weight"].shape) for name in names if f"{name}.weight" in tensors]
    is_linear = len(shapes) == len(names) > 0 and all(len(shape) == 2 for shape in shapes)
    return is_linear and all(before[0] == after[1] for before, after in pairwise(shapes))


def _shown(tensors: dict[str, Any], names: list[str]) -> str:
    shown = [f"{name} {tuple(tensors[name].shape)}" for name in names[:40]]
    return ", ".join(shown) + (f" and {len(names) - 40} more" if len(names) > 40 else "")
