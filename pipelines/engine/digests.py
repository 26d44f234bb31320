"""Digests and differences of settings, which are plain JSON-able data."""

import hashlib
import json
from typing import Any


def digest(value: Any) -> str:
    """Return the sha256, in hex, of JSON-able data; key order does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def folder_suffix(differences: dict[str, list[Any]]) -> str:
    """Return `~<digest>` of a folder whose settings differ from the usual ones, as `setting_differences` tells."""
    return f"~{digest(differences)[:8]}" if differences else ""


def setting_differences(new: dict[str, Any], old: dict[str, Any], prefix: str = "") -> dict[str, list[Any]]:
    """Return {dotted key: [new, old]} for every leaf that differs; None stands for a key that is not there."""
    found: dict[str, list[Any]] = {}
    for key in sorted(new.keys() | old.keys()):
        mine, other = new.get(key), old.get(key)
        if isinstance(mine, dict) and isinstance(other, dict):
            found |= setting_differences(mine, other, f"{prefix}{key}.")
        elif mine != other:
            found[f"{prefix}{key}"] = [mine, other]
    return found
