"""Do the intervals of Table 4.2 hold where whole scaffolds are drawn? `python -m benchmarks.scaffolds`.

Prints, for OTR (16 tests) less linear on each data set, the difference of the test AUC with the 95 % interval of the
paired bootstrap over molecules, as in the table, and over scaffolds: all test molecules of a scaffold together.
Reads the committed fits and the data sets (OTR_DATA_DIR).
"""

from io import BytesIO

import numpy as np

from benchmarks.measure import results_dir
from pipelines.datasets import load_dataset
from pipelines.engine.store import read_bytes
from pipelines.report import load_fits
from pipelines.report.statistics import ResampledAreas

OURS, RIVAL = "otr_readable", "linear_tuned"


def main() -> None:
    """Print a line for each data set and way of drawing."""
    fits = load_fits(results_dir())
    fits = fits[(fits["settings"] == "") & fits["split"].isna() & (fits["metric"] == "auc")]
    for data in ("bace", "hiv", "sider", "tox21"):
        scaffolds = load_dataset(data).test.groups
        outputs, labels = {}, None
        for method in (OURS, RIVAL):
            runs = fits.loc[(fits["data"] == data) & (fits["method"] == method), "run"]
            paths = [results_dir() / "runs" / run / "score" / "predictions.npz" for run in runs]
            parts = [np.load(BytesIO(read_bytes(path))) for path in paths]
            outputs[method], labels = [part["test"] for part in parts], parts[0]["labels"]
        for drawn, groups in (("molecules", np.arange(len(scaffolds))), ("scaffolds", scaffolds)):
            areas = ResampledAreas(labels, groups=groups)
            difference, (low, high) = areas.difference(*(areas.of(outputs[method]) for method in (OURS, RIVAL)))
            sizes = np.unique(groups, return_counts=True)[1]
            print(f"{data}: {difference:+.4f} ({low:+.4f} to {high:+.4f}) over {len(sizes):,} {drawn}, "
                  f"the largest of {sizes.max():,}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
