"""The files of a trained actor: float64 weights and biases as safetensors, the rest as JSON beside them."""

from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as safetensors_bytes

import otr
from otr.core.heads import head_from_dict
from pipelines.engine.store import corrupt, json_text, read_bytes, read_json

ACTOR_SCHEMA = "otr/actor/1"


def actor_files(network: otr.ReluNetwork) -> dict[str, bytes]:
    """Return `actor.safetensors` (float64 weights and biases) and `actor.json` (slope, dense links, head, domain)."""
    tensors: dict[str, np.ndarray] = {}
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"weight_{layer}"] = np.ascontiguousarray(weight)
        tensors[f"bias_{layer}"] = np.ascontiguousarray(bias)
    about = {
        "schema": ACTOR_SCHEMA,
        "n_layers": len(network.weights),
        "hidden_widths": [int(width) for width in network.hidden_widths],
        "negative_slope": network.negative_slope,
        "dense": network.dense,
        "head": network.head.to_dict(),
    }
    if network.domain is not None:
        about["domain"] = network.domain.to_dict()
    return {"actor.safetensors": safetensors_bytes(tensors), "actor.json": json_text(about).encode()}


def load_actor(folder: Path) -> otr.ReluNetwork:
    """Return the network of `actor_files`; a truncated or foreign file is an error that names it."""
    about = read_json(folder / "actor.json")
    try:
        if about["schema"] != ACTOR_SCHEMA:
            raise ValueError(f"schema {about['schema']!r} where {ACTOR_SCHEMA!r} was expected")
        tensors = load_tensors(read_bytes(folder / "actor.safetensors"))
        layers = range(about["n_layers"])
        return otr.ReluNetwork(
            [tensors[f"weight_{layer}"] for layer in layers],
            [tensors[f"bias_{layer}"] for layer in layers],
            negative_slope=about["negative_slope"],
            dense=about["dense"],
            head=head_from_dict(about["head"]),
            domain=otr.Domain.from_dict(about["domain"]) if "domain" in about else None,
        )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, otr.OtrError) as error:
        raise corrupt(folder / "actor.safetensors", error) from error
