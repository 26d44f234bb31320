"""The git revision that is recorded beside an artefact."""

import shutil
import subprocess
from pathlib import Path

import pytest

from pipelines.engine import provenance

SOURCE = "pipelines/engine/provenance.py"


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with a source and a result, as whose file the module takes itself; its revision is not cached."""
    for name in (SOURCE, "results/summary.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("{}\n", encoding="utf-8")
    who = ["-c", "user.name=x", "-c", "user.email=x@x"]
    for command in (["init", "-q"], ["add", "-A"], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / SOURCE))
    monkeypatch.setattr(provenance, "git_revision", provenance.git_revision.__wrapped__)
    return tmp_path


def test_a_changed_source_is_told_and_a_changed_result_is_not(checkout: Path) -> None:
    revision = provenance.git_revision()
    assert revision is not None and len(revision) == 12
    (checkout / "results/summary.json").write_text("[]\n", encoding="utf-8")
    (checkout / "new.py").write_text("\n", encoding="utf-8")
    assert provenance.git_revision() == revision
    (checkout / SOURCE).write_text("[]\n", encoding="utf-8")
    assert provenance.git_revision() == f"{revision}+changes"
    shutil.rmtree(checkout / ".git")
    assert provenance.git_revision() is None
