"""An episode of a tree as a GIF: what gymnasium renders, and below it the leaf that acts and what it does."""

from __future__ import annotations

import dataclasses
import os
import sys
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

import otr
from otr.control.environments import GymnasiumVectorEnv
from otr.control.rollout import play_side_by_side
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import label_name
from otr.programs.picture.colours import label_colours, level_colour
from otr.programs.walk import in_printed_order
from pipelines.config.env import EnvConfig
from pipelines.config.run import RunConfig
from pipelines.errors import ConfigError, PipelineError
from pipelines.play.environments import make_env, spec_of
from pipelines.play.episodes import play_seeds
from pipelines.play.spaces import action_names

if TYPE_CHECKING:
    from PIL.Image import Image

MOST_FRAMES, FRAMES_A_SECOND = 250, 25
WIDTH, TEXT, BAND = 480, 13, 42  # pixels: of a picture, of letters, and below it
COLOURS = 96


def write_video(tree: otr.ObliqueTree, env_config: EnvConfig, seed: int, path: Path) -> dict[str, Any]:
    """Play the episode that starts from `reset(seed)`, write it in real time as a GIF, and return what it shows.

    It has at most MOST_FRAMES frames: in a long episode each covers more steps, and so more time. Below the picture is
    the leaf that acts, in its colour of `otr.to_svg`, but that of several actions the first colours it.

    Raises:
        PipelineError: the environment cannot be rendered here; says what to do.
    """
    tree = in_printed_order(merge_equal_leaves(tree))
    env = gym.wrappers.RecordEpisodeStatistics(renderable(env_config))
    names = action_names(env_config, tree.n_answers)
    frames_a_second = float(env.metadata.get("render_fps") or 30)
    (length,) = play_seeds(tree.predict, env_config, [seed], n_workers=1).lengths.tolist()
    stride = max(1, round(frames_a_second / FRAMES_A_SECOND), -(-length // MOST_FRAMES))
    frames: list[Image] = []

    def acting(states: np.ndarray, _: np.ndarray) -> np.ndarray:
        answers, step = np.asarray(tree.predict(states)), env.episode_lengths
        if step % stride == 0:
            shown, leaf = rendered(env, env_config), int(tree.apply(states)[0])
            frames.append(_frame(shown, tree, leaf, answers[0], names, step, env.episode_returns))
            if len(frames) % 50 == 0:
                print(f"video: step {step:,} of {length:,}", flush=True)
        return answers

    with closing(GymnasiumVectorEnv(lambda: env)) as envs:
        played = play_side_by_side(envs, acting, [seed])
    _write_gif(path, frames, stride / frames_a_second)
    about = {"seed": seed, "return": float(played.returns[0]), "n_steps": int(played.lengths[0])}
    return about | {"n_frames": len(frames), "steps_a_frame": stride}


def check_video(config: RunConfig) -> None:
    """Raise ConfigError where a video is asked for and the environment cannot be rendered: a frame is tried."""
    if "video" in config.selected_stages:
        env = renderable(config.env)
        try:
            env.reset(seed=0)
            rendered(env, config.env)
        except PipelineError as error:
            raise ConfigError(str(error)) from error
        finally:
            env.close()


def _write_gif(path: Path, frames: list[Image], frame_s: float) -> None:
    ends = [round(100 * frame_s * i) for i in range(len(frames) + 1)]  # a GIF counts hundredths of a second
    shown_ms = [10 * (end - start) for start, end in pairwise(ends)]
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=shown_ms, loop=0)


def renderable(env_config: EnvConfig, width: int = WIDTH) -> Any:
    """Return the environment with pictures, MuJoCo's of `width` pixels.

    Without a screen MuJoCo renders by EGL, unless MUJOCO_GL is set.
    """
    is_mujoco = "mujoco" in str(spec_of(env_config.id).entry_point)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL" if is_mujoco else "SDL_VIDEODRIVER", "egl" if is_mujoco else "dummy")
    kwargs = {**env_config.kwargs, "render_mode": "rgb_array"} | (
        {"width": width, "height": 3 * width // 4} if is_mujoco else {}
    )
    modes = make_env(env_config).metadata.get("render_modes", [])
    if "rgb_array" not in modes:
        raise ConfigError(
            f"video: {env_config.id} renders {', '.join(modes) or 'nothing'}, and a video needs rgb_array: give the "
            'environment metadata["render_modes"] with it and a render_mode, or leave video=true out'
        )
    env: Any = make_env(dataclasses.replace(env_config, kwargs=kwargs))
    if is_mujoco:
        import mujoco

        # -1, where the model has no camera that follows the body, is the fixed one.
        camera = mujoco.mj_name2id(env.unwrapped.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
        env.unwrapped.mujoco_renderer.camera_id = camera
    return env


def rendered(env: Any, env_config: EnvConfig) -> np.ndarray:
    """Return what the environment shows (height, width, 3)."""
    try:
        shown = env.render()
        if shown is None:
            raise ValueError("render() gave no picture")
    except Exception as error:  # a renderer or a driver can fail in any way
        raise PipelineError(
            f"video: {env_config.id} cannot be rendered here ({type(error).__name__}: {error}). MuJoCo needs "
            "OpenGL: MUJOCO_GL=egl with a GPU's driver or Mesa, MUJOCO_GL=osmesa with libosmesa, or a screen. Without "
            "video=true all else is done; the same command with it adds the video later"
        ) from error
    return np.asarray(shown)


def _frame(
    shown: np.ndarray, tree: otr.ObliqueTree, leaf: int, answer: np.ndarray, names: list[str], step: int, total: float
) -> Image:
    from PIL import Image, ImageDraw, ImageFont
    from PIL.Image import Dither

    picture = Image.fromarray(shown.astype(np.uint8))
    height = round(picture.height * WIDTH / picture.width)
    frame = Image.new("RGB", (WIDTH, height + BAND), "#ffffff")
    frame.paste(picture.resize((WIDTH, height)), (0, 0))
    draw, font = ImageDraw.Draw(frame), ImageFont.load_default(TEXT)
    draw.rectangle((6, height + 6, 18, height + BAND - 6), fill=_colour(tree, answer), outline="#7b8794")
    does = f"leaf {leaf + 1} of {tree.n_leaves:,}: {_in_words(answer, names)}"
    draw.text((26, height + 4), _fitting(does, font), fill="#1a1a1a", font=font)
    draw.text((26, height + 21), f"step {step:,}, return {total:.1f}", fill="#5b6570", font=font)
    return frame.quantize(COLOURS, dither=Dither.NONE)


def _in_words(answer: np.ndarray, names: list[str]) -> str:
    if answer.ndim == 0:
        return label_name(int(answer), names)
    return ", ".join(f"{name} {value:+.2f}" for name, value in zip(names, answer.tolist(), strict=True))


def _fitting(text: str, font: Any) -> str:
    """Return a text that is no wider than the picture, its end left out where it is."""
    shown = text
    while font.getlength(shown) > WIDTH - 32:
        text = text[:-1]
        shown = f"{text.rstrip(', ')} ..."
    return shown


def _colour(tree: otr.ObliqueTree, answer: np.ndarray) -> str:
    if answer.ndim == 0:
        return label_colours(int(answer))[1]
    limits = tree.head.limits(tree.n_outputs)
    low, high = (-1.0, 1.0) if limits is None else (float(limits[0][0]), float(limits[1][0]))
    return level_colour((float(answer[0]) - (low + high) / 2) / ((high - low) / 2))
