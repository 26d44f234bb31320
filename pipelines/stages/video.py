"""Stage video: one evaluated episode as a GIF, with the leaf that acts."""

from pathlib import Path

from pipelines.engine.seeding import evaluation_seeds
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_json
from pipelines.play.episodes import PlaysEvaluation
from pipelines.play.video import write_video
from pipelines.stages.prune import load_tree


def video(inputs: Inputs, settings: PlaysEvaluation, out: Path) -> None:
    """Write the first evaluation episode of the pruned tree, or of the polished one, as `episode.gif`."""
    tree = load_tree(inputs.get("polish") or inputs["prune"])
    (seed,) = evaluation_seeds(settings.evaluate.first_seed, 1)
    write_json(out / "report.json", write_video(tree, settings.env, seed, out / "episode.gif"))


VIDEO_KEYS = picked(env="env", first_seed="evaluate.first_seed")
VIDEO = Stage("video", version=2, inputs=("prune",), keyed=VIDEO_KEYS, run=video, settings=PlaysEvaluation)
