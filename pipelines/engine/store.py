"""Reading and writing artefacts: atomic text and JSON, actors as safetensors beside JSON. No pickle anywhere."""

import csv
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file
from safetensors.numpy import save as safetensors_bytes

import otr
from otr.core.head import head_from_dict
from pipelines.errors import PipelineError

ACTOR_SCHEMA = "otr/actor/1"


def write_text(path: Path, text: str) -> None:
    """Write `text` so that a reader sees the old file or the new one, never a part."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def write_json(path: Path, value: Any) -> None:
    """Write JSON-able data, indented and with its keys in the order given, atomically."""
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """Return JSON-able data as the text of a file."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def read_json(path: Path) -> Any:
    """Return what a JSON file holds; a missing or broken file is an error that names it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise corrupt(path, error) from error


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str]) -> None:
    """Write rows under the named columns, atomically; floats keep every digit (shortest exact form)."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    temporary.replace(path)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return a CSV file's rows as text; a missing file is an error that names it."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        raise corrupt(path, error) from error


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


def save_actor(network: otr.ReluNetwork, folder: Path) -> None:
    """Write the actor's files (`actor_files`)."""
    write_files(actor_files(network), folder)


def write_files(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files of these names and contents."""
    for name, content in files.items():
        (folder / name).write_bytes(content)


def load_actor(folder: Path) -> otr.ReluNetwork:
    """Return the network that `save_actor` wrote; a truncated or foreign file is an error that names it."""
    about = read_json(folder / "actor.json")
    try:
        if about["schema"] != ACTOR_SCHEMA:
            raise ValueError(f"schema {about['schema']!r} where {ACTOR_SCHEMA!r} was expected")
        tensors = load_file(folder / "actor.safetensors")
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


REWRITTEN = ("summary.json", "config.yaml")  # made anew by the run's command, from the finished stages


def corrupt(path: Path, error: Exception) -> PipelineError:
    """Return the error for an artefact that cannot be read, with the way out."""
    if path.name in REWRITTEN:
        remedy = f"Delete {path} and run the run's command again to make it; nothing is trained anew."
    else:
        remedy = f"Restore it, or delete the folder {path.parent} and run the same command again to make it."
    what = "is not there" if isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
    return PipelineError(f"{path} {what}\n{remedy}")
