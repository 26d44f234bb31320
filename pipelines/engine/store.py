"""Reading and writing artefacts: text, JSON and CSV files that appear whole or not at all. No pickle anywhere."""

import csv
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipelines.errors import PipelineError

REWRITTEN = ("summary.json", "config.yaml")  # made anew by the run's command, from the finished stages


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


def write_files(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files of these names and contents."""
    for name, content in files.items():
        (folder / name).write_bytes(content)


def corrupt(path: Path, error: Exception) -> PipelineError:
    """Return the error for an artefact that cannot be read, with the way out."""
    if path.name in REWRITTEN:
        remedy = f"Delete {path} and run the run's command again to make it; nothing is trained anew."
    else:
        remedy = f"Restore it, or delete the folder {path.parent} and run the same command again to make it."
    what = "is not there" if isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
    return PipelineError(f"{path} {what}\n{remedy}")
