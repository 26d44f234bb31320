"""Stages video and mp4: one evaluated episode as a GIF or as an MP4, with the leaf that acts."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from pipelines.config.run import RunConfig
from pipelines.engine.seeding import evaluation_seeds
from pipelines.engine.stage import Stage, picked
from pipelines.engine.store import write_json
from pipelines.play.video import write_video
from pipelines.stages.prune import load_tree


def video(inputs: Mapping[str, Path], config: RunConfig, out: Path, *, name: str) -> None:
    """Write the first evaluation episode of the pruned tree, or of the polished one, into a file of that name."""
    tree = load_tree(inputs.get("polish") or inputs["prune"])
    (seed,) = evaluation_seeds(config.evaluate.first_seed, 1)
    shown = write_video(tree, config.env, seed, out / name)
    write_json(
        out / "report.json",
        {
            "seed": seed,
            "return": shown.episode_return,
            "n_steps": shown.n_steps,
            "n_frames": shown.n_frames,
            "steps_a_frame": shown.stride,
        },
    )


VIDEO_SETTINGS = picked(env="env", first_seed="evaluate.first_seed")
VIDEO, MP4 = (
    Stage(name, version=1, inputs=("prune",), settings=VIDEO_SETTINGS, run=partial(video, name=file))
    for name, file in (("video", "episode.gif"), ("mp4", "episode.mp4"))
)
