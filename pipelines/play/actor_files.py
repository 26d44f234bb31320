"""The files of a trained actor: float64 weights and biases as safetensors, the rest as JSON beside them."""

from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as safetensors_bytes

import otr
from otr.core.heads import head_from_dict
from otr.core.smooth_network import Oracle, SmoothNetwork
from pipelines.engine.store import corrupt, json_text, read_bytes, read_json

ACTOR_SCHEMA = "otr/actor/1"


def actor_files(network: Oracle) -> dict[str, bytes]:
    """Return `actor.safetensors` (float64 weights and biases) and `actor.json` (units, head, domain).

    Units are ReLU with a slope and dense links, or of a smooth activation, which only an oracle has.
    """
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


def _units(network: Oracle) -> dict[str, Any]:
    if isinstance(network, otr.ReluNetwork):
        return {"negative_slope": network.negative_slope, "dense": network.dense}
    return {"activation": network.activation}


def load_actor(folder: Path) -> otr.ReluNetwork:
    """Return the network of `actor_files`; a truncated or foreign file, or smooth units, is an error that names it."""
    network = load_oracle_network(folder)
    if not isinstance(network, otr.ReluNetwork):
        raise corrupt(folder / "actor.json", ValueError(f"units are {network.activation}, which no tree is equal to"))
    return network


def load_oracle_network(folder: Path) -> Oracle:
    """Return the network of `actor_files`, of whatever units; a truncated or foreign file is an error that names it."""
    about = read_json(folder / "actor.json")
    try:
        if about["schema"] != ACTOR_SCHEMA:
            raise ValueError(f"schema {about['schema']!r} where {ACTOR_SCHEMA!r} was expected")
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
