"""Trees on disk: `<name>.npz` for the arrays, `<name>.json` for the rest and a digest of both. No pickle anywhere."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import tokenize
import uuid
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from reprlib import repr as shortened
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from otr.core.domain import Domain
from otr.core.fixed_point.tanh_table import TanhTable
from otr.core.fixed_point.tree import FixedPointTree
from otr.core.heads import head_from_dict
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.tree import ObliqueTree
from otr.errors import ArtefactError
from otr.files.zip_members import read_members

SCHEMA = "otr/tree/1"
SCHEMA_OF_BASIS = "otr/tree/2"  # with P and M as they are held, those of `basis @ x`

Arrays = dict[str, NDArray[Any]]
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_TREE_NAMES = ("feature_names", "output_names")
_TREE_ARRAYS = ("children_left", "children_right", "P", "v", "M", "c")
_FIXED_ARRAYS = (*_TREE_ARRAYS, "shifts", "input_low", "input_high")
_SCALES, _BITS, _TABLE_BITS = (
    ("input_scales", "output_scales"),
    ("bits", "accumulator_bits"),
    ("unit_bits", "step_bits"),
)

Saved = ObliqueTree | PatternTree | FixedPointTree


def save(tree: Saved, path: str | os.PathLike[str]) -> Path:
    """Write `tree` as two adjacent files; the same tree always gives the same bytes.

    Each file is written under a temporary name and renamed. A `PatternTree` is saved as its network, its paths and
    their counts.

    Args:
        tree: what to save.
        path: a name with or without ".npz" or ".json", or an existing folder, where the name is "tree".

    Returns:
        The path of the JSON file.

    Raises:
        TypeError: `tree` is something else.
        ArtefactError: there is no such folder.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> print(otr.save(tree, "policy"))
        policy.json
    """
    if not isinstance(tree, Saved):
        raise TypeError(
            f"tree is a {type(tree).__name__}, expected an ObliqueTree, a PatternTree or a FixedPointTree; "
            "otr.PatternTree(network) holds a network"
        )
    npz_path, json_path = _paths_of(path)
    if not npz_path.parent.is_dir():
        raise ArtefactError(f"there is no folder {npz_path.parent} to save {npz_path.name} in; make it first")
    if isinstance(tree, PatternTree):
        description, arrays = _describe_pattern_tree(tree)
    elif isinstance(tree, FixedPointTree):
        description, arrays = _describe_fixed_point_tree(tree)
    else:
        description, arrays = _describe_tree(tree)
    description["schema"] = SCHEMA_OF_BASIS if "basis" in arrays else SCHEMA
    description["shapes"] = {name: list(array.shape) for name, array in sorted(arrays.items())}
    description["sha256"] = _digest(description, arrays)
    text = json.dumps(description, indent=2, sort_keys=True) + "\n"
    # np.savez stamps every member with the same date, so its bytes depend on the arrays alone. It gets nothing else:
    # numpy 2.0 takes allow_pickle=False, which 2.1 brought, for one more array.
    write_atomically(npz_path, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]
    write_atomically(json_path, lambda file: file.write(text.encode()))
    return json_path


def load(path: str | os.PathLike[str]) -> Saved:
    """Read what `save` wrote, and check it.

    Args:
        path: as given to `save`, or either of the two files.

    Raises:
        ArtefactError: a file is missing, cut off, changed since it was written, or of another schema.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> saved = otr.save(tree, "policy")
        >>> otr.load("policy").predict([-3])
        array([3.])
    """
    npz_path, json_path = _paths_of(path)
    description = _read_description(json_path)
    arrays = _read_arrays(npz_path)
    if _digest(description, arrays) != description.get("sha256"):
        raise ArtefactError(
            f"{npz_path} and {json_path} do not belong together, or one was changed: the digest over both is not the "
            "one recorded; restore the two files or save the tree again"
        )
    readers: dict[str, Callable[[dict[str, Any], Arrays], Saved]] = {
        "fixed_point_tree": _restore_fixed_point_tree,
        "oblique_tree": _restore_tree,
        "pattern_tree": _restore_pattern_tree,
    }
    kind = description.get("kind")
    if not isinstance(kind, str) or kind not in readers:
        raise ArtefactError(f"{json_path} holds the kind {shortened(kind)}, expected one of {sorted(readers)}")
    try:
        return readers[kind](description, arrays)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ArtefactError(f"{npz_path} does not hold a valid {kind}: {error}; save the tree again") from error


def _describe_tree(tree: ObliqueTree) -> tuple[dict[str, Any], Arrays]:
    arrays: Arrays = {name: getattr(tree, name) for name in _TREE_ARRAYS}
    if tree.basis is not None:
        arrays |= {"P": tree.P_of_basis, "M": tree.M_of_basis, "basis": tree.basis}
    if tree.labels is not None:
        arrays["labels"] = tree.labels
    return {"kind": "oblique_tree", "head": tree.head.to_dict(), **_names(tree)}, arrays


def _names(tree: ObliqueTree | FixedPointTree) -> dict[str, list[str]]:
    return {name: list(getattr(tree, name)) for name in _TREE_NAMES if getattr(tree, name) is not None}


def _restore_tree(description: dict[str, Any], arrays: Arrays) -> ObliqueTree:
    core = (arrays[name] for name in _TREE_ARRAYS)
    return ObliqueTree(*core, labels=arrays.get("labels"), basis=arrays.get("basis"), **_head_and_names(description))


def _head_and_names(description: dict[str, Any]) -> dict[str, Any]:
    names = {name: _field(description, name, list) for name in _TREE_NAMES if name in description}
    return {"head": head_from_dict(_field(description, "head", dict)), **names}


def _describe_fixed_point_tree(tree: FixedPointTree) -> tuple[dict[str, Any], Arrays]:
    arrays: Arrays = {name: getattr(tree, name) for name in _FIXED_ARRAYS}
    description: dict[str, Any] = {"kind": "fixed_point_tree", "head": tree.head.to_dict(), **_names(tree)}
    description |= {name: [str(scale) for scale in getattr(tree, name)] for name in _SCALES}
    description |= {name: getattr(tree, name) for name in _BITS}
    if tree.labels is not None:
        arrays["labels"] = tree.labels
    if tree.table is not None:
        arrays["table"] = tree.table.values
        description |= {name: getattr(tree.table, name) for name in _TABLE_BITS}
    return description, arrays


def _restore_fixed_point_tree(description: dict[str, Any], arrays: Arrays) -> FixedPointTree:
    held: dict[str, Any] = {name: arrays[name] for name in _FIXED_ARRAYS} | {"labels": arrays.get("labels")}
    held |= {name: tuple(map(Fraction, _field(description, name, list))) for name in _SCALES}
    held |= {name: _field(description, name, int) for name in _BITS}
    if "table" in arrays:
        held["table"] = TanhTable(arrays["table"], *(_field(description, name, int) for name in _TABLE_BITS))
    return FixedPointTree(**held, **_head_and_names(description))


def _describe_pattern_tree(tree: PatternTree) -> tuple[dict[str, Any], Arrays]:
    network = tree.network
    description: dict[str, Any] = {
        "kind": "pattern_tree",
        "head": network.head.to_dict(),
        "n_layers": len(network.weights),
        "negative_slope": network.negative_slope,
        "dense": network.dense,
        "is_restricted": tree.is_restricted,
    }
    if network.domain is not None:
        description["domain"] = network.domain.to_dict()
    arrays: Arrays = {"patterns": np.packbits(tree.patterns, axis=1), "counts": tree.counts}
    for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        arrays[f"weight_{layer}"], arrays[f"bias_{layer}"] = W, b
    return description, arrays


def _restore_pattern_tree(description: dict[str, Any], arrays: Arrays) -> PatternTree:
    layers = range(_field(description, "n_layers", int))
    network = ReluNetwork(
        [arrays[f"weight_{layer}"] for layer in layers],
        [arrays[f"bias_{layer}"] for layer in layers],
        negative_slope=_field(description, "negative_slope", float, int),
        dense=_field(description, "dense", bool, str),
        head=head_from_dict(_field(description, "head", dict)),
        domain=Domain.from_dict(description["domain"]) if "domain" in description else None,
    )
    full = PatternTree(network)
    patterns = np.unpackbits(arrays["patterns"], axis=1, count=full.n_bits).view(np.bool_)
    counts = arrays["counts"]
    if counts.shape != patterns.shape[:1]:
        raise ValueError(f"counts have shape {counts.shape}, expected {patterns.shape[:1]}: one for each path")
    if _field(description, "is_restricted", bool):
        return PatternTree(network, patterns, counts)
    return full.observe_paths(patterns, counts)


def _field(description: dict[str, Any], name: str, *types: type) -> Any:
    """Return an entry of the JSON file; raise ValueError if it is missing or of another type."""
    value = description.get(name)
    if type(value) not in types:
        expected = " or ".join(kind.__name__ for kind in types)
        raise ValueError(f"{name} is {shortened(value)} in the JSON file, expected {expected}")
    return value


def _paths_of(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Return the paths of the npz and the JSON file."""
    base = Path(path)
    if base.is_dir():
        base = base / "tree"
    elif base.suffix in (".npz", ".json"):
        base = base.with_suffix("")
    return base.with_name(base.name + ".npz"), base.with_name(base.name + ".json")


def _digest(description: dict[str, Any], arrays: Arrays) -> str:
    """Return the SHA-256 over the description, without its own digest, and over every array's type, shape and bytes."""
    covered = {key: value for key, value in description.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(covered, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _read_description(path: Path) -> dict[str, Any]:
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ArtefactError(f"{path} does not exist; save a tree there first") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ArtefactError(f"{path} cannot be read as JSON ({error}); restore it or save the tree again") from error
    schema = description.get("schema") if isinstance(description, dict) else None
    if not isinstance(description, dict) or schema not in (SCHEMA, SCHEMA_OF_BASIS):
        raise ArtefactError(
            f"{path} has the schema {shortened(schema)}, expected {SCHEMA!r} or {SCHEMA_OF_BASIS!r}; "
            "save the tree with this version"
        )
    return description


def _read_arrays(path: Path) -> Arrays:
    try:
        return {name.removesuffix(".npy"): _array_of(content) for name, content in read_members(path, str(path))}
    except FileNotFoundError as error:
        raise ArtefactError(f"{path} does not exist, though its JSON file does; restore it or save again") from error
    except ValueError as error:
        raise ArtefactError(
            f"{path} cannot be read ({error}); it is cut off or changed: save the tree again"
        ) from error


def _array_of(content: bytes) -> NDArray[Any]:
    """Return the array in a file of numpy's format; raise ValueError before anything is allocated if there is none."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"an array has the format {version}, expected one of {sorted(_HEADERS)}")
    try:
        shape, is_fortran, dtype = _HEADERS[version](stream)
    except (SyntaxError, TypeError, AttributeError, tokenize.TokenError, RecursionError, MemoryError) as error:
        raise ValueError(f"an array's header is broken: {error}") from error
    if dtype.kind not in "biuf" or any(type(n) is not int or n < 0 for n in shape):
        raise ValueError(f"an array has the type {dtype} and the shape {shape}, expected numbers")
    n_bytes, start = math.prod(shape) * dtype.itemsize, stream.tell()
    if n_bytes != len(content) - start:
        raise ValueError(f"an array of shape {shape} takes {n_bytes} bytes, the file has {len(content) - start}")
    flat = np.frombuffer(content, dtype, offset=start)
    return flat.reshape(shape, order="F" if is_fortran else "C").copy()  # a copy is aligned


def write_atomically(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write a file under a temporary name in the same folder, which is removed where that fails, then rename it."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("xb") as file:
            write(file)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
