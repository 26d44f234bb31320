"""Table 4.2, trees on molecules: from finished fits, as Markdown, CSV, LaTeX and a figure."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import otr
from pipelines.datasets import fragment_names
from pipelines.engine.archive import MANIFEST, read_manifest
from pipelines.engine.store import corrupt, exists, read_bytes, read_json
from pipelines.report.cells import CSV_COLUMNS, DECIMALS, LINES, beside_the_thesis, summarise
from pipelines.report.figures.style import auc_of_methods
from pipelines.report.frames import load_fits
from pipelines.report.statistics import MIN_RUNS_FOR_INTERVAL, ResampledAreas, resplit_interval
from pipelines.report.text import latex_grid, latex_notes, markdown_grid, markdown_table, page, write_tables

DATA = {"bace": "Bace", "hiv": "HIV", "sider": "SIDER", "tox21": "Tox21", "pdbbind": "PDBbind"}
LEARNERS = {"linear_tuned": "Linear (depth 0)", "linear_taught": "Linear (taught)", "cart": "CART",
            "cart_taught": "CART (taught)", "hhcart": "HHCART", "tao": "TAO (L2)", "tao_l1": "TAO (L1)",
            "tao_taught": "TAO (taught)", "lcn": "LCN", "augtree": "AugTree", "otr": "OTR",
            "otr_tuned": "OTR (tuned)", "otr_readable": "OTR (16 tests)"}  # fmt: skip
CLASSIFIERS_ONLY = ("linear_taught", "cart_taught", "tao", "tao_l1", "tao_taught", "otr_tuned", "otr_readable")
NETWORKS = ("lcn", "otr", "otr_tuned", "otr_readable")  # whose whole tree is what a network computes
RIVALS = ("linear_tuned", "linear_taught", "otr_tuned")  # with which all others are compared
SPARSE = {"otr_16": "without L1", "otr_16_l1": "with L1 1e-5", "otr_16_sparse": "with L1 8e-3, decaying rate"}
SHOWN = "runs/bace/otr_16_sparse/seed-0"  # the fit whose tree is printed and drawn
KEY = ["task", "method"]
TEST_TO_TRAIN = 10 / 80  # rows of redrawn parts
CELLS = [("4.2", data, method) for method in LEARNERS for data in DATA] + [("sparse", "bace", name) for name in SPARSE]
FURTHER = {"train_mean": ("train", "mean"), "train_std": ("train", "std"), "valid_mean": ("valid", "mean"),
           "valid_std": ("valid", "std"), "whole": ("whole_test", "mean"),
           "leaves": ("leaves", "mean"), "tree_depth": ("depth", "mean"),
           "fit_cpu_seconds": ("fit_cpu_seconds", "mean"), "small_weights": ("small_weights", "mean"),
           "seeds": ("seed", tuple), "metric": ("metric", "first"), "n_labels": ("n_labels", "first"),
           "teacher_train": ("teacher.train", "mean"), "teacher_valid": ("teacher.valid", "mean"),
           "teacher_test": ("teacher.test", "mean"), "labels_left_out": ("labels_left_out.test", "first"),
           "run": ("run", "first"), "tune_s": ("seconds.tune", "first")}  # fmt: skip
COLUMNS = [*CSV_COLUMNS, "metric", "train_mean", "train_std", "valid_mean", "valid_std", "whole", "teacher_test",
           "leaves", "tree_depth", "fit_cpu_seconds", "small_weights", "n_labels", "labels_left_out"]  # fmt: skip
HEAD = ["Method", "", *DATA.values()]


def write_table_4_2(results_dir: Path) -> list[Path]:
    """Write Table 4.2 and, where there are fits, its figure; also a picture of the tree that it prints."""
    fits = own_fits(load_fits(results_dir))
    cells = make_cells(fits)
    table = cells[cells["table"] == "4.2"]
    rows = {LEARNERS[method]: row for method, row in table.groupby("method", sort=False)}
    ran = table[table["n_runs"] > 0]
    markdown = page(
        "table_4_2.md",
        table=markdown_grid(HEAD, rows, LINES),
        seeds=_seeds(ran),
        left_out=_left_out(ran),
        details=markdown_table(_details(ran), empty="Nothing has been run yet."),
        beside=markdown_table(_beside(fits[fits["split"].isna()], results_dir), empty="Nothing has been run yet."),
        splits=markdown_table(_splits(fits[fits["split"].notna()]), empty="Nothing has been run yet."),
        tuned=_tuned(ran, results_dir),
        sparse=markdown_table(_sparse(cells[cells["table"] == "sparse"])),
        program=_sparse_program(results_dir),
        min_runs=MIN_RUNS_FOR_INTERVAL,
    )
    latex = latex_notes(r"\usepackage{booktabs}", markdown) + latex_grid(HEAD, rows, LINES)
    paths = write_tables(results_dir, "table_4_2", cells.reindex(columns=COLUMNS).round(DECIMALS), markdown, latex)
    return [*paths, *_write_figure(ran, results_dir), *_draw_sparse_tree(results_dir)]


def own_fits(fits: pd.DataFrame) -> pd.DataFrame:
    """Return the fits with the method's own settings."""
    return fits[fits["settings"] == ""]


def make_cells(fits: pd.DataFrame) -> pd.DataFrame:
    """Return the cells of the table and of the sparse experiment, a row a method and data set.

    Fits with other settings than the method's own, or on redrawn parts, are left out.
    """
    own = own_fits(fits)
    own = own[own["split"].isna()].rename(columns={"data": "task"})
    found = summarise(own, KEY, "test", **FURTHER)
    cells = pd.DataFrame(CELLS, columns=["table", *KEY]).merge(found, "left", KEY)
    cells = beside_the_thesis(cells, (("4.2", task, method, "") for _, task, method in CELLS))
    cells["note"], cells["ours"] = ([text(cell) for cell in cells.itertuples()] for text in (_not_run, _ours))
    return cells


def _not_run(cell: Any) -> str:
    if cell.n_runs:
        return ""
    if cell.task != "pdbbind":
        return "not run"
    return "for classes only" if cell.method in CLASSIFIERS_ONLY else "not run: file not at hand"


def _ours(cell: Any) -> str:
    return _not_run(cell) if math.isnan(cell.mean) else _with_spread(cell.mean, cell.std)


def _with_spread(mean: float, std: float) -> str:
    return f"{mean:.3f} ± {std:.3f}" if std > 0 else f"{mean:.3f}"


def _seeds(cells: pd.DataFrame) -> str:
    """Return how many seeds were run in how many cells."""
    counts = Counter(cells["seeds"]).most_common()
    shown = (f"{len(seeds)} ({seeds[0]} to {seeds[-1]}) in {n} cell{'s' * (n > 1)}" for seeds, n in counts)
    return "; ".join(shown) or "none yet"


def _left_out(cells: pd.DataFrame) -> str:
    """Return how many labels of which data sets have one class in the test part."""
    counts = {(DATA[cell.task], cell.labels_left_out, cell.n_labels) for cell in cells.itertuples()}
    return ", ".join(f"{n} of {n_labels} of {data}" for data, n, n_labels in sorted(counts) if n) or "none"


def _by_data(cells: pd.DataFrame) -> Iterable[Any]:
    """Yield cells data set by data set."""
    return (cell for data in DATA for cell in cells[cells["task"] == data].itertuples())


def _details(cells: pd.DataFrame) -> list[list[str]]:
    lines = [["Data", "Method", "Train", "Validation", "Test", "Network", "Leaves", "Depth", "CPU seconds", "Seeds"]]
    for cell in _by_data(cells):
        scores = [f"{score:.3f}" for score in (cell.train_mean, cell.valid_mean, cell.mean, cell.whole)]
        scores[-1] = scores[-1] if cell.method in NETWORKS else ""
        lines.append([DATA[cell.task], LEARNERS[cell.method], *scores, f"{cell.leaves:,.1f}", f"{cell.tree_depth:.1f}",
                      f"{cell.fit_cpu_seconds:,.1f}", str(cell.n_runs)])  # fmt: skip
        if not math.isnan(cell.teacher_test):
            taught = [f"{score:.3f}" for score in (cell.teacher_train, cell.teacher_valid, cell.teacher_test)]
            name = f"Teacher of {LEARNERS[cell.method]}"
            lines.append([DATA[cell.task], name, *taught, "", "", "", "", str(cell.n_runs)])
    return lines


def _beside(fits: pd.DataFrame, results_dir: Path) -> list[list[str]]:
    """Return a head and a line a method and data set: its differences from the rivals on the same test molecules."""
    lines = [["Data", "Method", *(f"Less {LEARNERS[rival]}" for rival in RIVALS)]]
    for data in DATA:
        own = fits[(fits["data"] == data) & (fits["metric"] == "auc")]
        predicted = {method: _predictions(own[own["method"] == method], results_dir) for method in LEARNERS}
        labels = next((part["labels"] for parts in predicted.values() for part in parts), None)
        if labels is None:
            continue
        areas = ResampledAreas(labels)
        found = {method: areas.of([part["test"] for part in parts]) for method, parts in predicted.items() if parts}
        for method in found:
            texts = [_difference(found, method, rival) for rival in RIVALS]
            lines.append([DATA[data], LEARNERS[method], *texts])
    return lines


def _splits(fits: pd.DataFrame) -> list[list[str]]:
    """Return a head and a line a method and data set: the mean over redrawn parts, and less linear's on the same."""
    lines = [["Data", "Method", "Test", "Less Linear (depth 0)", "Leaves", "Splits"]]
    for data in DATA:
        means = fits[fits["data"] == data].groupby(["method", "split"])[["test", "leaves"]].mean()
        for method in (name for name in LEARNERS if name in means.index.levels[0] and name in means.index):
            own = means.loc[method]
            linear = means.loc["linear_tuned"] if "linear_tuned" in means.index else own.iloc[:0]
            less = (own["test"] - linear["test"]).dropna()
            lines.append([DATA[data], LEARNERS[method], _with_spread(own["test"].mean(), own["test"].std()),
                          "" if method == "linear_tuned" else _less(less), f"{own['leaves'].mean():,.1f}",
                          ", ".join(map(str, own.index))])  # fmt: skip
    return lines


def _less(differences: pd.Series) -> str:
    """Return a mean difference and its interval over splits, where there are enough of them."""
    if differences.empty:
        return ""
    low, high = resplit_interval(differences, TEST_TO_TRAIN)
    interval = "" if math.isnan(low) else f" ({low:+.3f} to {high:+.3f})"
    return f"{differences.mean():+z.3f}{interval}"


def _predictions(fits: pd.DataFrame, results_dir: Path) -> list[Mapping[str, np.ndarray]]:
    """Return what the fits of a method answered on the test rows, where that is among what is scored.

    Raises:
        PipelineError: they, or what is recorded of them, are gone.
    """
    predicted: list[Mapping[str, np.ndarray]] = []
    for run in fits["run"]:
        folder = results_dir / "runs" / run / "score"
        if "predictions.npz" in read_manifest(folder)["outputs"]:
            path = folder / "predictions.npz"
            try:
                predicted.append(np.load(BytesIO(read_bytes(path))))
            except (OSError, ValueError) as error:
                raise corrupt(path, error) from error
    return predicted


def _difference(found: Mapping[str, np.ndarray], method: str, rival: str) -> str:
    if rival not in found or method == rival:
        return ""
    difference, (low, high) = ResampledAreas.difference(found[method], found[rival])
    return f"{difference:+z.3f} ({low:+.3f} to {high:+.3f})"  # -0.000 is below zero


def _tuned(cells: pd.DataFrame, results_dir: Path) -> str:
    """Return the grids of the tuned methods and what was chosen of them."""
    tuned = [(cell, *_tuning(results_dir / "runs" / cell.run)) for cell in _by_data(cells[cells["tune_s"].notna()])]
    return "\n\n".join(["\n".join(_grids(tuned)), markdown_table(_chosen(tuned))]) if tuned else "Nothing."


def _tuning(run_dir: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return what was tuned, and what was chosen."""
    manifest, chosen = (read_json(run_dir / "tune" / name) for name in (MANIFEST, "chosen.json"))
    return manifest["settings"]["method"], chosen


def _grids(tuned: Sequence[tuple[Any, dict[str, Any], list[dict[str, Any]]]]) -> list[str]:
    """Return the grid of every tuned method as the lines of a list, with the data sets that share it."""
    lines = []
    for method in LEARNERS:
        grids: dict[str, list[str]] = {}
        for cell, tuning, _ in tuned:
            if cell.method == method:
                parts = [_text({key: _span(values) for key, values in part.items()}) for part in tuning["grid"]]
                grids.setdefault("\n".join(parts), []).append(DATA[cell.task])
        for text, data in grids.items():
            parts = text.split("\n")
            where = f" ({', '.join(data)})" if len(grids) > 1 else ""
            lines.append(f"* {LEARNERS[method]}{where}: " + (parts[0] if len(parts) == 1 else "one of"))
            lines += [f"    * {part}" for part in parts] if len(parts) > 1 else []
    return lines


def _chosen(tuned: Sequence[tuple[Any, dict[str, Any], list[dict[str, Any]]]]) -> list[list[str]]:
    """Return a head and a line for every tuned cell: for what, with which seeds, and what was chosen how often."""
    lines = [["Data", "Method", "For each", "On", "Seeds", "Score", "Chosen"]]
    for cell, tuning, chosen in tuned:
        texts = Counter(_text(each["settings"]) for each in chosen).most_common()
        if tuning["tuned_for"] == "data" or len(texts) == 1:
            text = _text(chosen[0]["settings"])
        else:
            text = "; ".join(f"{text} ({n})" for text, n in texts)
        per = {"label": "label", "data": "data set"}[tuning["tuned_for"]]
        where = {"valid": "validation", "folds": "5 folds"}[tuning.get("tuned_on", "valid")]
        seeds = ", ".join(map(str, tuning["tuning_seeds"]))
        score = f"{sum(each['valid'] for each in chosen) / len(chosen):.3f}"
        lines.append([DATA[cell.task], LEARNERS[cell.method], per, where, seeds, score, text])
    return lines


def _span(values: Sequence[Any]) -> str:
    """Return values to try as text: 2 to 12 where they are numbers in a row."""
    are_integers = all(type(value) is int for value in values)
    if len(values) > 2 and are_integers and list(values) == list(range(values[0], values[0] + len(values))):
        return f"{values[0]} to {values[-1]}"
    return " / ".join(_value(value) for value in values)


def _text(changes: dict[str, Any]) -> str:
    """Return settings as text, `max_depth 3, C 1.0`."""
    return ", ".join(f"{key} {_value(value)}" for key, value in changes.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return f"({_text(value)})"
    return value if isinstance(value, str) else json.dumps(value)


def _sparse(cells: pd.DataFrame) -> list[list[str]]:
    lines = [["Training", "Test AUC", "Weights below 1e-5", "Leaves reached", "Seeds"]]
    for cell in cells.itertuples():
        sizes = [f"{100 * cell.small_weights:.1f} %", f"{cell.leaves:,.0f}"] if cell.n_runs else ["", ""]
        lines.append([SPARSE[cell.method], _ours(cell), *sizes, str(cell.n_runs)])
    return lines


def _write_figure(cells: pd.DataFrame, results_dir: Path) -> list[Path]:
    """Write the test AUC and the leaves reached, a panel a data set; nothing where nothing was run."""
    points = cells[cells["metric"] == "auc"]
    if points.empty:
        return []
    published = pd.to_numeric(points["published_mean"])
    names = {"panel": points["task"].map(DATA), "label": points["method"].map(LEARNERS), "published": published}
    path = results_dir / "figures" / "table_4_2.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    otr.save_picture(auc_of_methods(points.assign(**names)), path)
    return [path]


def _draw_sparse_tree(results_dir: Path) -> list[Path]:
    """Draw the sparse model's tree, read from its printed program, where that is at hand."""
    if not (program := _printed(results_dir)):
        return []
    features, classes = fragment_names("bace"), ("Class 0", "Class 1")
    tree = otr.parse_program(program, features, labels=True, output_names=classes)
    path = results_dir / "figures" / "tree_bace.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    otr.save_picture(otr.draw_tree(tree, feature_names=features, output_names=classes, max_terms=8), path)
    return [path]


def _sparse_program(results_dir: Path) -> str:
    """Return the printed tree of the sparse model with the first seed, where it is at hand."""
    program = _printed(results_dir)
    return page("sparse_program.md", program=program) if program else ""


def _printed(results_dir: Path) -> str:
    path = results_dir / SHOWN / "score" / "program.txt"
    return read_bytes(path).decode() if exists(path) else ""
