"""Packing runs and fits for a commit: `python -m pipelines.cli.pack [RESULTS_DIR]`, `make pack`."""

import sys
from functools import partial
from pathlib import Path

from pipelines.cli.runs import load_config
from pipelines.engine.archive import MANIFEST, pack
from pipelines.engine.store import CONFIG, SUMMARY, exists
from pipelines.errors import PipelineError
from pipelines.runs.derived import derive


def pack_results(results_dir: Path) -> int:
    """Pack every run and fit below `results_dir/runs`, print what was done, and return how many failed.

    The trees of a fit stay in their folder where they are kept: they are not committed.
    """
    if not (results_dir / "runs").is_dir():
        print(f"{results_dir}/runs: there is no such folder", file=sys.stderr)
        return 1
    runs = sorted({path.parents[1] for path in (results_dir / "runs").rglob(f"[!.]*/{MANIFEST}")})
    n_failed = 0
    for run_dir in runs:
        try:
            # A fit has nothing that is made again in seconds; nor has an oracle, a run without a configuration.
            if not run_dir.parts[-3].startswith("depth-"):
                pack(run_dir, leave=("fit",), of_run=(CONFIG, SUMMARY))
            else:
                pack(run_dir, partial(derive, load_config(run_dir, None)) if exists(run_dir / CONFIG) else None)
        except PipelineError as error:
            n_failed += 1
            print(f"{run_dir} stays as it is: {error}", file=sys.stderr)
    print(f"{results_dir}: runs and fits packed: {len(runs) - n_failed}; left as they are: {n_failed}")
    return n_failed


if __name__ == "__main__":
    sys.exit(1 if pack_results(Path(*sys.argv[1:2] or ["results"])) else 0)
