"""Digests, differences and flat forms of settings, which are plain JSON-able data."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def digest(value: Any) -> str:
    """Return the sha256, in hex, of JSON-able data; key order does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def setting_differences(new: dict[str, Any], old: dict[str, Any], prefix: str = "") -> dict[str, list[Any]]:
    """Return {dotted key: [new, old]} for every leaf that differs; None stands for a missing key."""
    found: dict[str, list[Any]] = {}
    for key in sorted(new.keys() | old.keys()):
        mine, other = new.get(key), old.get(key)
        if isinstance(mine, dict) and isinstance(other, dict):
            found |= setting_differences(mine, other, f"{prefix}{key}.")
        elif mine != other:
            found[f"{prefix}{key}"] = [mine, other]
    return found


def differences_suffix(differences: Mapping[str, Any]) -> str:
    """Return what the name of a folder ends with where settings differ from the usual ones: `~<digest>`, or nothing."""
    return f"~{digest(differences)[:8]}" if differences else ""


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found
