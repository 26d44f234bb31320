"""The files of a trained actor: float64 weights and biases as safetensors, the rest as JSON next to them."""

from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as safetensors_bytes

import otr
from otr.core.black_box import BlackBox
from otr.core.heads import head_from_dict
from otr.core.smooth_network import Layered, Oracle, SmoothNetwork
from otr.importers import read_black_box
from pipelines.engine.store import corrupt, json_text, read_bytes, read_json

ACTOR_SCHEMA = "otr/actor/1"


def actor_files(network: Oracle) -> dict[str, bytes]:
    """Return `actor.safetensors` (float64 weights and biases) and `actor.json` (units, head, domain).

    Units are ReLU with a slope and dense links, or of a smooth activation, which only an oracle has.
    """
    if isinstance(network, BlackBox):
        return _black_box_files(network)
    tensors: dict[str, np.ndarray] = {}
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"weight_{layer}"] = np.ascontiguousarray(weight)
        tensors[f"bias_{layer}"] = np.ascontiguousarray(bias)
    about = {
        "schema": ACTOR_SCHEMA,
        "n_layers": len(network.weights),
        "hidden_widths": [int(width) for width in network.hidden_widths],
        "head": network.head.to_dict(),
        **_units(network),
    }
    if network.domain is not None:
        about["domain"] = network.domain.to_dict()
    return {"actor.safetensors": safetensors_bytes(tensors), "actor.json": json_text(about).encode()}


def _black_box_files(policy: BlackBox) -> dict[str, bytes]:
    """Return the model's own file, and `actor.json`, which says how it is read."""
    about = {
        "schema": ACTOR_SCHEMA,
        "file": f"policy{policy.suffix}",
        "output": policy.output,
        "hidden_widths": [int(width) for width in policy.hidden_widths],
        "head": policy.head.to_dict(),
        "middle": policy.middle.tolist(),
        "scale": policy.scale.tolist(),
        "clip": policy.clip if np.isfinite(policy.clip) else None,
    }
    return {about["file"]: policy.content, "actor.json": json_text(about).encode()}


def _load_black_box(folder: Path, about: dict[str, Any]) -> BlackBox:
    content = read_bytes(folder / about["file"])
    policy = read_black_box(content, Path(about["file"]).suffix, about["output"])
    if not isinstance(policy, BlackBox):
        raise ValueError(f"{about['file']} is a ReLU network")
    clip = np.inf if about["clip"] is None else about["clip"]
    policy = policy.replace(head=head_from_dict(about["head"]))
    return policy.fold_input_normalisation(np.array(about["middle"]), np.array(about["scale"]), clip)


def _units(network: Layered) -> dict[str, Any]:
    if isinstance(network, otr.ReluNetwork):
        return {"negative_slope": network.negative_slope, "dense": network.dense}
    return {"activation": network.activation}


def load_actor(folder: Path) -> otr.ReluNetwork:
    """Return the network of `actor_files`; a truncated or foreign file, or smooth units, is an error that names it."""
    network = load_oracle_network(folder)
    if not isinstance(network, otr.ReluNetwork):
        raise corrupt(folder / "actor.json", ValueError(f"{network.reason}, which no tree is equal to"))
    return network


def load_oracle_network(folder: Path) -> Oracle:
    """Return the network of `actor_files`, of whatever units; a truncated or foreign file is an error that names it."""
    about = read_json(folder / "actor.json")
    try:
        if about["schema"] != ACTOR_SCHEMA:
            raise ValueError(f"schema {about['schema']!r} where {ACTOR_SCHEMA!r} was expected")
        if "file" in about:
            return _load_black_box(folder, about)
        tensors = load_tensors(read_bytes(folder / "actor.safetensors"))
        layers = range(about["n_layers"])
        weights, biases = ([tensors[f"{kind}_{layer}"] for layer in layers] for kind in ("weight", "bias"))
        head = head_from_dict(about["head"])
        domain = otr.Domain.from_dict(about["domain"]) if "domain" in about else None
        if "activation" in about:
            return SmoothNetwork(weights, biases, activation=about["activation"], head=head, domain=domain)
        slope, dense = about["negative_slope"], about["dense"]
        return otr.ReluNetwork(weights, biases, negative_slope=slope, dense=dense, head=head, domain=domain)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, otr.OtrError) as error:
        raise corrupt(folder / "actor.safetensors", error) from error
