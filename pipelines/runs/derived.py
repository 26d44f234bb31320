"""What archives of runs leave out, as it is made again in seconds: full trees, trees of paths, printed programs."""

from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import otr
from pipelines.config.methods import EXTRA_STAGES
from pipelines.config.run import RunConfig
from pipelines.engine.archive import bytes_digest, opened, read_manifest
from pipelines.play.actor_files import load_actor
from pipelines.play.printed_programs import LARGEST_PROGRAM, program_text, program_text_of_every_leaf
from pipelines.stages.map import full_tree

PROGRAMS = {"tree": "program.txt", "constant_gains": "constant_gains.txt"}


def opened_run(config: RunConfig, run_dir: Path, *stages: str) -> AbstractContextManager[Path]:
    """Give a run's folder that holds these stages, by default all, with all their files (`archive.opened`)."""
    return opened(run_dir, stages or (*config.method.stages, *EXTRA_STAGES), partial(derive, config))


def derive(config: RunConfig, run_dir: Path, folder: Path) -> dict[str, bytes]:
    """Return the files of a stage that are made again from its others, or from the actor, by name.

    `folder` is the stage's own, unpacked, which may lack what is made. A program comes in the wording of which the
    manifest has the digest: in that of before equal leaves were merged, where it is older.
    """
    recorded = read_manifest(folder)["outputs"]
    with TemporaryDirectory(prefix="otr-") as place:
        out = Path(place)
        if folder.name == "map":
            otr.save(full_tree(load_actor(run_dir / config.method.actor_stage), config.map.max_leaves), out / "tree")
        paths = otr.load(folder / "paths") if (folder / "paths.json").is_file() else None
        if isinstance(paths, otr.PatternTree):
            otr.save(paths.to_tree(), out / "tree")
        for name, program in PROGRAMS.items():
            where = next((each for each in (out, folder) if (each / f"{name}.json").is_file()), None)
            tree = otr.load(where / name) if where else None
            if isinstance(tree, otr.ObliqueTree) and tree.n_leaves <= LARGEST_PROGRAM:
                texts = [write(tree, config.env).encode() for write in (program_text, program_text_of_every_leaf)]
                known = [text for text in texts if bytes_digest(text) == recorded.get(program)]
                (out / program).write_bytes((known or texts)[0])
        return {path.name: path.read_bytes() for path in out.iterdir()}
