"""Every page's Python runs, in turn and in one folder, and every command is understood; most are given in test-all."""

import contextlib
import io
import re
import shlex
import shutil
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import otr
from pipelines.cli.fits import FIT
from pipelines.cli.overrides import asked
from pipelines.cli.runs import RUN
from pipelines.config import env as env_config
from tests.committed import RESULTS
from tests.pipelines.conftest import otr_command
from tests.pipelines.own_envs import Cart

ROOT = Path(__file__).parents[1]
PAGES = [path.relative_to(ROOT).as_posix() for path in (ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md")))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMPOSED = {"otr-run": RUN, "otr-plan": RUN, "otr-fit": FIT}
# What pages name and readers put something else for.
PROGRAMS = {"mountaincar": "if velocity <= 0: -1 else: 1", "CartPole-v1": "if angle <= 0: left else: right",
            "pendulum": "2 tanh(0.3 sin_angle + 0.1 angle_rate)"}  # fmt: skip
RUNS = ("hopper/otr/depth-6/quick/seed-0", "pendulum/otr/depth-6/quick/seed-0", "lunarlander/otr/depth-2/thesis/seed-0")
NAMES = {"run=FOLDER": RUNS[1], "run=A": RUNS[0], "run=B": RUNS[1], "run=RUN": RUNS[1]}
NOT_GIVEN = re.compile("bace|[+]experiment|certificate=")  # data from the network, hours, what is made above
TUTORIALS = ("docs/tutorial.md", "docs/tutorial-data.md")
RECORD = "docs/results.md"  # the commands of all committed runs, which tests/test_results.py compares with these

torch.set_num_threads(1)


def blocks(page: str) -> list[tuple[str, str]]:
    return BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))


def commands(page: str) -> list[list[str]]:
    """Return a page's commands, those in the text among them where they are whole, each as its words."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"```(?:python|bibtex)\n.*?```", "", text.replace("\\\n", ""), flags=re.DOTALL)
    lines = [line for _, block in BLOCK.findall(text) for line in block.splitlines()]
    lines += [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", BLOCK.sub("", text)) if "..." not in code]
    return [shlex.split(line, comments=True) for line in lines if re.match(r"otr-\w+ \S", line)]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what pages take as given: policies, statistics, programs, tables, an environment, some runs."""
    folder = tmp_path_factory.mktemp("given")
    relu = {"policy_kwargs": {"net_arch": [4], "activation_fn": torch.nn.ReLU}, "device": "cpu", "seed": 0}
    zips = {"CartPole-v1": PPO, "my_module:Maze-v0": PPO, "pendulum": PPO, "LunarLander-v3": A2C, "HalfCheetah-v5": SAC,
            "reacher": SAC}  # fmt: skip
    for env, kind in zips.items():
        made = {"my_module:Maze-v0": Cart(), "pendulum": "Pendulum-v1", "reacher": "Reacher-v4"}.get(env, env)
        kind("MlpPolicy", made, **relu).save(folder / f"of {env}.zip")
    VecNormalize(DummyVecEnv([Cart])).save(str(folder / "statistics.pkl"))
    for env_name, program in PROGRAMS.items():
        (folder / f"{env_name}.txt").write_text(program)
    (folder / "upright.txt").write_text("velocity in -3..3\nangle_rate in -3..3\n")
    (folder / "my_module.py").write_text(
        "import gymnasium, tests.pipelines.own_envs as own\n"
        "gymnasium.register('Maze-v0', lambda size: own.Cart(), max_episode_steps=50, kwargs={'size': 3})\n"
    )
    rng = np.random.default_rng(0)
    rows = ["id,area,colour,price", *(f"{i % 7},{a:.2f},red,{3 * a:.2f}" for i, a in enumerate(rng.uniform(1, 2, 100)))]
    (folder / "my.csv").write_text("\n".join(rows))
    (folder / "prune").mkdir()
    otr.save(otr.parse_program(PROGRAMS["pendulum"], ["cos_angle", "sin_angle", "angle_rate"]), folder / "prune/tree")
    for run in RUNS:
        shutil.copytree(RESULTS / "runs" / run, folder / "results/runs" / run)
    return folder


def spelt_out(words: list[str], files: Path) -> list[str]:
    """Return a command's words with this folder's files in place of the page's."""
    env = next((word.partition("=")[2] for word in words if word.startswith("env=")), "pendulum")
    for name in {word.partition("=")[2] for word in words if word.endswith(("policy.zip", "reacher.zip"))}:
        shutil.copy(files / f"of {env}.zip", files / name)
    words = [word.replace("=FILE", f"={env}.txt") if word == "program=FILE" else word for word in words]
    return [f"run={NAMES[word]}" if word in NAMES else word for word in words]


def give(words: list[str], folder: Path) -> None:
    """Give a command, which is done; what is to be verified may be false."""
    done = otr_command(words[0], *words[1:], cwd=folder)
    is_false = words[0] == "otr-verify" and done.returncode == 1 and not done.stderr
    assert done.returncode == 0 or is_false, (words, done)


WITH_COMMANDS = [page for page in PAGES if commands(page) and page not in (*TUTORIALS, RECORD)]


@pytest.mark.parametrize("page", [*WITH_COMMANDS, pytest.param(RECORD, marks=pytest.mark.slow)])
def test_commands_are_understood(page: str, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a sweep, the first and the last job are composed."""
    monkeypatch.chdir(files)
    monkeypatch.syspath_prepend(files)
    env_config._code_sha256.cache_clear()
    for words in commands(page):
        words = spelt_out(words, files)
        if words[0] in COMPOSED and "--help" not in words:
            workflow = COMPOSED[words[0]]
            overrides = asked(Namespace(overrides=[word for word in words[1:] if word != "-m"]))
            jobs = workflow.expand(overrides, "-m" in words)
            for own in jobs[:1] + jobs[1:][-1:]:
                workflow.check(workflow.jobs([own])[0].config)
        elif words[0] in ("otr-export", "otr-verify") and "certificate=proof.json" not in words:  # of the page's Python
            give(words, files)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in WITH_COMMANDS if "decisions" not in page])
def test_commands_run(page: str, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs with the smallest budget; sweeps, of which the smallest versions are `make smoke`, are not run."""
    monkeypatch.chdir(files)
    monkeypatch.syspath_prepend(files)
    for words in commands(page):
        if "-m" in words or NOT_GIVEN.search(" ".join(words)):
            continue
        words = spelt_out(words, files)
        for run in re.findall(r"(?<=[=[,])\w+/\w+/depth-[\w/-]+", " ".join(words)):
            shutil.copytree(RESULTS / "runs" / run, files / "results/runs" / run, dirs_exist_ok=True)
        if words[0] == "otr-run":
            words = [word for word in words if not word.startswith(("budget", "train.", "polishing."))]
            words += ["budget=smoke", "n_workers=1"]
        give(words, files)


def quick(function: Callable[..., Any], **few: Any) -> Callable[..., Any]:
    return lambda *given, polish=None, **named: function(*given, **(named | few))


# README's test and those of the tutorials look at what comes out, too.
@pytest.mark.parametrize(
    "page", [page for page in PAGES[1:] if "python" in dict(blocks(page)) and page not in TUTORIALS]
)
def test_python_runs(page: str, files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a page prints and then shows is the same; imitation and polish have few steps."""
    monkeypatch.chdir(tmp_path)
    for given, name in {"my.csv": "my.csv", "./my.csv": "new.csv", "of pendulum.zip": "model.zip"}.items():
        shutil.copy(files / given, tmp_path / name)
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [8]}).save(tmp_path / "sac.zip")
    few = {"n_rounds": 1, "n_episodes": 1, "n_choice_episodes": 1, "progress": False}
    monkeypatch.setattr(otr, "imitate", quick(otr.imitate, **few))
    monkeypatch.setattr(otr, "polish", quick(otr.polish, n_iterations=1, n_selection_episodes=2, n_candidates=1))
    box = [-1, -1, -8], [1, 1, 8]
    names = {"otr": otr, "model": PPO.load(tmp_path / "model.zip"), "MyEnv": partial(gymnasium.make, "Pendulum-v1"),
             "evaluate": lambda policies, seeds: np.zeros(np.shape(seeds)), "box": box}  # fmt: skip
    shown = ""
    for language, block in blocks(page):
        if language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(block, page, "exec"), names)
            shown = out.getvalue()
        elif "otr-fit data=my.csv" in block:
            give(shlex.split(block.splitlines()[0], comments=True), tmp_path)
        elif not language and shown and "otr-" not in block:
            assert shown == block
