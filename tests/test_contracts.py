"""The import contracts of pyproject.toml hold, and hold for files that nobody has listed."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
NEW_FILES = {  # file: what it imports against the contracts
    "otr/core/new_file.py": "import sklearn",
    "otr/geometry/new_file.py": "import otr.programs.text",
    "otr/new_folder/__init__.py": "",
    "pipelines/engine/new_file.py": "import pipelines.stages.train",
    "pipelines/stages/new_file.py": "import hydra",
    "pipelines/play/new_file.py": "import pipelines.play.other_file",
    "pipelines/play/other_file.py": "import pipelines.play.new_file",
}
BROKEN = (  # a piece of what lint-imports says of each
    "otr.core.new_file -> sklearn",
    "otr.geometry.new_file -> otr.programs.text",
    "new_folder",
    "pipelines.engine.new_file -> pipelines.stages.train",
    "pipelines.stages.new_file -> hydra",
    "No cycles are allowed in pipelines.play",
)


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    command, environment = Path(sys.executable).with_name("lint-imports"), {"PYTHONPATH": str(folder), "PATH": ""}
    return subprocess.run([command, "--no-cache"], cwd=folder, env=environment, capture_output=True, text=True)


def test_new_files_are_under_the_contracts_without_being_listed(tmp_path):
    for name in ("otr", "pipelines"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    kept = lint_imports(tmp_path)
    assert kept.returncode == 0, kept.stdout + kept.stderr
    for name, text in NEW_FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"{text}\n")
    broken = lint_imports(tmp_path)
    assert broken.returncode == 1
    assert [piece for piece in BROKEN if piece not in broken.stdout] == [], broken.stdout
