"""Episodes as GIFs and MP4s: what is played, how many frames there are, and what is told where nothing is rendered."""

import sys
from pathlib import Path

import numpy as np
import pytest
from imageio_ffmpeg import count_frames_and_secs, read_frames
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
    assert (shown.n_steps, shown.n_frames, shown.stride) == (200, 20, 10)
    with Image.open(tmp_path / "a.gif") as gif:
        shown_ms = []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            shown_ms.append(gif.info["duration"])
        assert len(shown_ms) == 20 and set(shown_ms) == {330, 340} and sum(shown_ms) == 6670  # 200 steps, 30 a second


def test_an_mp4_is_not_thinned_out_further(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(video, "MOST_FRAMES", 4)  # of a GIF alone
    monkeypatch.setattr(video, "FRAMES_A_SECOND", 3)
    tree, path = committed_tree("pendulum/otr/depth-6/quick/seed-0"), tmp_path / "a.mp4"
    shown = write_video(tree, PENDULUM, 3, path)
    assert (shown.n_steps, shown.n_frames, shown.stride) == (200, 20, 10)
    assert count_frames_and_secs(path) == (20, pytest.approx(200 / 30, abs=0.05))
    frames = read_frames(path, pix_fmt="rgb24")
    width, height = next(frames)["size"]
    first, *_, last = (np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames)
    assert (width, height) == (video.WIDTH + video.STRIP + 16, video.WIDTH + video.BAND)
    assert np.abs(first.astype(float) - last).max() > 100 and first[5, 5].min() > 240  # the pole moves over white


def test_an_mp4_names_its_extra_before_anything_runs(command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    for words in (["mp4=true"], ["stages=[mp4]"]):
        refused = command("run", "env=mountaincar", *words, f"results_dir={tmp_path / 'new'}")
        assert refused.returncode == 2 and "mp4=true needs the extra mp4: pip install 'otr[mp4]'" in refused.stderr
    assert not (tmp_path / "new").exists()
    tree = otr.ObliqueTree([], [], np.zeros((0, 3)), [], np.zeros((1, 1, 3)), np.zeros((1, 1)))
    with pytest.raises(otr.MissingExtraError, match="an episode as MP4 needs imageio-ffmpeg, which is not installed"):
        write_video(tree, PENDULUM, 0, tmp_path / "a.mp4")


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
