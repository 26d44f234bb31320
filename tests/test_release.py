"""Slower checks of what people take away: committed policies play again as recorded, the wheel works on its own."""

import json
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.slow


def test_committed_policies_play_the_recorded_episodes(tmp_path):
    """Of every method the first seeds on the pendulum and the car; `make reproduce-table EVALUATE=1` plays all."""
    runs = ROOT / "results" / "runs"
    for env in ("pendulum", "mountaincar"):
        for run in runs.glob(f"{env}/*/depth-*/quick/seed-0"):
            shutil.copytree(run, tmp_path / "runs" / run.relative_to(runs))
    program = Path(sys.executable).with_name("otr-tabulate")
    command = [str(program), "table=4.1", "evaluate=true", f"results_dir={tmp_path}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=1200)
    summaries = [json.loads(path.read_text()) for path in tmp_path.glob("runs/*/*/*/*/*/summary.json")]
    n_recorded = sum(len(summary["policies"]) for summary in summaries)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("episodes played again, as recorded") == n_recorded > 30


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, from which the tests below install."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(pip, check=True, timeout=600)
    return next(folder.glob("otr-*.whl"))


def test_a_wheel_has_one_package_and_names_no_other(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    names = archive.namelist()
    texts = [archive.read(name).decode() for name in names if name.endswith(".py") and name != "otr/commands.py"]
    assert {name.partition("/")[0].removesuffix(".dist-info") for name in names} == {"otr", wheel.name[:9]}
    imports = re.compile(r"^\s*(?:from|import) ([\w.]+)|\"(pipelines\b[.\w]*)\"", re.MULTILINE)
    named = {name for text in texts for found in imports.findall(text) for name in found}
    assert not [name for name in named if name.partition(".")[0] in ("pipelines", "hydra_plugins")]
    assert "otr.pipelines.engine.store" in named


def test_commands_of_a_wheel_ignore_a_pipelines_of_yours(wheel: Path, tmp_path: Path) -> None:
    """In one process and in joblib's, from a folder with another `pipelines`, which is on the path as well."""
    (tmp_path / "pipelines.py").write_text("raise ImportError('yours')")
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True, timeout=600)
    bin_dir = tmp_path / "venv/bin"
    subprocess.run([bin_dir / "python", "-m", "pip", "-q", "install", "--no-deps", wheel], check=True, timeout=600)
    site = next(tmp_path.glob("venv/lib/*/site-packages"))
    # What a path file names is searched for packages, and its own path files, such as this checkout's, are not read.
    (site / "shared.pth").write_text(sysconfig.get_path("purelib"))
    environment = {"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"}
    for words in ("otr-run --help", "otr-run env=pendulum depth=2 budget=smoke n_workers=1", "otr-data --list",
                  "otr-run -m env=mountaincar program=mountaincar,mountaincar_simplified budget=smoke n_workers=1 "
                  "launcher=joblib", "otr-tabulate runs", "otr-report out=page.html"):  # fmt: skip
        program, *others = words.split()
        done = subprocess.run([bin_dir / program, *others], cwd=tmp_path, env=environment, capture_output=True,
                              text=True, timeout=300)  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
    assert len(list(tmp_path.glob("results/runs/**/summary.json"))) == 3 and (tmp_path / "page.html").exists()
