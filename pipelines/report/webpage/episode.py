"""An episode as a page plays it: the states, quantised, the leaf and the answer of every step, and small frames."""

from __future__ import annotations

import base64
import io
import math
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray

import otr
from otr.control.environments import GymnasiumVectorEnv
from otr.control.rollout import play_side_by_side
from pipelines.config.env import EnvConfig
from pipelines.errors import ConfigError, PipelineError
from pipelines.play.environments import make_env
from pipelines.play.video import renderable, rendered

MOST_STEPS = 500  # that are kept, as a rule; of a longer episode every second, third, ... step
LEVELS = 255  # of a quantised state, between its least and its greatest value: finer than a chart shows
COLUMNS = 10  # of frames in a sprite
QUALITY = 30  # of a sprite (WebP), of 100


def record(
    tree: otr.ObliqueTree,
    env: EnvConfig,
    seed: int,
    *,
    length: int,
    n_frames: int,
    width: int,
    most_steps: int = MOST_STEPS,
) -> dict[str, Any]:
    """Play the episode that starts from `reset(seed)` and return it as JSON-able data.

    Args:
        tree: the policy; leaves are numbered as in it.
        env, seed, length: the environment, the episode, and its number of steps, which is known from a play before.
        n_frames: frames, at most; 0 for none. An environment that cannot be rendered here has none, and `no_frames`
            says why.
        width: of a frame, in pixels.
        most_steps: that are kept.

    Returns:
        `states` (k, d) quantised as `packed` holds them, `leaves` (k,) and `answers` (k,) or (k, a) of every
        `stride`-th step; the `sprite` with the frames of every `frame_stride`-th of these; the return and the number of
        all steps.
    """
    stride = -(-length // most_steps)
    kept = -(-length // stride)
    frame_stride = max(1, math.ceil(kept / n_frames)) if n_frames else 0
    states: list[NDArray[Any]] = []
    frames: list[NDArray[Any]] = []
    step, why_not = 0, ""
    playing = make_env(env)
    if n_frames:
        try:
            playing = _sparing(renderable(env, 2 * width))
        except (ConfigError, PipelineError) as error:
            why_not = str(error)

    def acting(batch: NDArray[Any], _: NDArray[Any]) -> NDArray[Any]:
        nonlocal step, why_not
        if step % stride == 0:
            if n_frames and not why_not and len(states) % frame_stride == 0:
                try:
                    frames.append(rendered(playing, env))
                except PipelineError as error:
                    why_not = str(error)
            states.append(batch[0].copy())
        step += 1
        return np.asarray(tree.predict(batch))

    with closing(GymnasiumVectorEnv(lambda: playing)) as envs:
        played = play_side_by_side(envs, acting, [seed])
    X = np.array(states)
    low, high = X.min(axis=0), X.max(axis=0)
    answers = np.asarray(tree.predict(X))
    return {
        "seed": seed,
        "return": float(played.returns[0]),
        "n_steps": length,
        "stride": stride,
        "seconds_a_step": stride / float(playing.metadata.get("render_fps") or 30),
        "low": low.tolist(),
        "high": high.tolist(),
        "states": packed(np.round((X - low) / np.where(high > low, high - low, 1.0) * LEVELS).astype("<u1")),
        "leaves": packed(tree.apply(X).astype("<u2")),
        "answers": packed(answers.astype("<f4")),
        **({"frame_stride": frame_stride, **_sprite(frames, width)} if frames else {"no_frames": _first_line(why_not)}),
    }


def _sparing(env: Any) -> Any:
    """Return MuJoCo's environment set to render in a quarter of the time, before its first picture; any other as it is.

    Frames are made from pictures of twice their size, which smooths edges without several samples a pixel.
    """
    quality = getattr(getattr(getattr(env.unwrapped, "model", None), "vis", None), "quality", None)
    if quality is not None:
        quality.offsamples, quality.shadowsize = 0, 1024
    return env


def packed(values: NDArray[Any]) -> dict[str, Any]:
    """Return an array as JSON-able data: its type and shape, and its little-endian bytes in base64."""
    array = np.ascontiguousarray(values)
    return {
        "dtype": array.dtype.newbyteorder("<").str.lstrip("<|"),
        "shape": list(array.shape),
        "data": base64.b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode("ascii"),
    }


def _sprite(frames: list[NDArray[Any]], width: int) -> dict[str, Any]:
    """Return the frames side by side as one WebP picture, row by row."""
    from PIL import Image

    height = round(frames[0].shape[0] * width / frames[0].shape[1])
    columns = min(COLUMNS, len(frames))
    sheet = Image.new("RGB", (columns * width, -(-len(frames) // columns) * height))
    for i, frame in enumerate(frames):
        small = Image.fromarray(frame.astype(np.uint8)).resize(
            (width, height), Image.Resampling.LANCZOS, reducing_gap=2.0
        )
        sheet.paste(small, (i % columns * width, i // columns * height))
    written = io.BytesIO()
    sheet.save(written, format="WEBP", quality=QUALITY, method=4)
    return {
        "frame_width": width,
        "frame_height": height,
        "frame_columns": columns,
        "n_frames": len(frames),
        "sprite": base64.b64encode(written.getvalue()).decode("ascii"),
    }


def _first_line(text: str) -> str:
    return text.partition(": give the")[0].partition(" MuJoCo needs")[0]
