"""Episodes as GIFs: what is played, how many frames there are, and what is told where nothing is rendered."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import otr
from pipelines.engine.store import read_csv
from pipelines.errors import PipelineError
from pipelines.play import video
from pipelines.play.video import write_video
from tests.committed import RESULTS, committed_tree, copy_run
from tests.pipelines.conftest import HOPPER, PENDULUM

CAR_RUN = "mountaincar/otr/depth-1/quick/seed-0"


def test_a_run_leaves_a_video_of_its_first_evaluated_episode(command, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    copy_run(CAR_RUN, tmp_path / "runs" / CAR_RUN)
    done = command("run", "env=mountaincar", "depth=1", "budget=quick", "video=true", f"results_dir={tmp_path}")
    assert done.returncode == 0, done.stdout + done.stderr
    first = read_csv(RESULTS / "runs" / CAR_RUN / "evaluate/episodes_pruned_tree.csv")[0]
    assert f"video: the episode of seed 1000, return {float(first['return']):.1f}: {tmp_path}/runs/" in done.stdout
    with Image.open(tmp_path / "runs" / CAR_RUN / "video/episode.gif") as gif:
        assert gif.n_frames == int(first["length"])  # 30 steps a second, each of them shown
        gif.seek(0)
        start = np.asarray(gif.convert("RGB"))
        gif.seek(40)
        assert (np.asarray(gif.convert("RGB")) != start).any()


def test_long_episodes_are_thinned_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(video, "MOST_FRAMES", 20)
    shown = write_video(committed_tree("pendulum/otr/depth-6/quick/seed-0"), PENDULUM, 3, tmp_path / "a.gif")
    assert (shown["n_steps"], shown["n_frames"], shown["steps_a_frame"]) == (200, 20, 10)
    with Image.open(tmp_path / "a.gif") as gif:
        shown_ms = []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            shown_ms.append(gif.info["duration"])
        assert len(shown_ms) == 20 and set(shown_ms) == {330, 340} and sum(shown_ms) == 6670  # 200 steps, 30 a second


def test_what_cannot_be_rendered_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fails(self: object) -> None:
        raise RuntimeError("no OpenGL")

    monkeypatch.setattr("gymnasium.envs.mujoco.mujoco_env.MujocoEnv.render", fails)
    tree = otr.ObliqueTree([], [], np.zeros((0, 11)), [], np.zeros((1, 3, 11)), np.zeros((1, 3)))
    with pytest.raises(
        PipelineError, match=r"Hopper-v4 cannot be rendered here \(RuntimeError: no OpenGL\).*MUJOCO_GL=egl"
    ):
        write_video(tree, HOPPER, 0, tmp_path / "a.gif")


def test_an_environment_without_pictures_is_refused_before_anything_runs(command, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    own = "env=tests.pipelines.own_envs:Cart-v0"
    refused = command("run", own, "video=true", "depth=1", f"results_dir={tmp_path / 'new'}")
    assert refused.returncode == 2
    assert "tests.pipelines.own_envs:Cart-v0 renders nothing, and a video needs rgb_array" in refused.stderr
    assert not (tmp_path / "new").exists()
