"""Small trees, for reading: the part that the training rows reach, as a program and as a picture."""

import re
from pathlib import Path

import numpy as np

import otr
from otr import draw_tree, save_picture, to_text
from pipelines.datasets import fragment_names
from pipelines.datasets.dataset import Dataset

MOST_LEAVES, MOST_CHARACTERS, WIDTH = 32, 20_000, 110


def program_of(tree: otr.ObliqueTree | otr.PatternTree, dataset: Dataset) -> str | None:
    """Return the program of what the training rows reach of a one-label tree; None if it is too long to read."""
    pruned, _ = _reached(tree, dataset)
    if pruned is None:
        return None
    text = to_text(pruned, feature_names=_features(dataset), output_names=_answers(pruned, dataset))
    if pruned.head.gives_labels and pruned.labels is None and dataset.columns and dataset.columns.classes:
        classes = ", ".join(f"{label} is {name}" for label, name in enumerate(dataset.columns.classes))
        text = f"# {dataset.label_names[0]}: {classes}\n{text}"
    return wrapped(text) if len(text) <= MOST_CHARACTERS else None


def draw(tree: otr.ObliqueTree | otr.PatternTree, dataset: Dataset, path: Path) -> bool:
    """Draw what the training rows reach of a tree, if that has few leaves; return whether it was drawn."""
    pruned, X = _reached(tree, dataset)
    if pruned is None:
        return False
    figure = draw_tree(
        pruned,
        feature_names=_features(dataset),
        output_names=_answers(pruned, dataset),
        states=X,
        max_terms=8,
    )
    save_picture(figure, path)
    return True


def _reached(tree: otr.ObliqueTree | otr.PatternTree, dataset: Dataset) -> tuple[otr.ObliqueTree | None, np.ndarray]:
    """Return what the training rows reach of a tree, None if that has many leaves, and the rows."""
    X, _ = dataset.labelled("train")
    pruned = otr.prune_unreached(tree, X)
    return pruned if pruned.n_leaves <= MOST_LEAVES else None, X


def wrapped(program: str) -> str:
    """Return a program with its long lines broken before an operator, what follows being indented."""
    lines = []
    for line in program.splitlines():
        indent = " " * (len(line) - len(line.lstrip()) + len("if "))
        terms = re.split(r" (?=[+-] )", line)
        current = terms[0]
        for term in terms[1:]:
            if len(current) + 1 + len(term) > WIDTH:
                lines.append(current)
                current = indent + term
            else:
                current += f" {term}"
        lines.append(current)
    return "\n".join(lines) + "\n"


def named(tree: otr.ObliqueTree | otr.PatternTree, dataset: Dataset) -> otr.ObliqueTree | otr.PatternTree:
    """Return a tree of a table with the names of its features and answers; activation patterns have none."""
    if dataset.columns is None or isinstance(tree, otr.PatternTree):
        return tree
    return tree.replace(feature_names=dataset.feature_names, output_names=_answers(tree, dataset))


def _features(dataset: Dataset) -> tuple[str, ...]:
    return fragment_names(dataset.name) if dataset.columns is None else dataset.feature_names


def _answers(tree: otr.ObliqueTree, dataset: Dataset) -> list[str] | None:
    """Return names for what the leaves answer, where the labels are 0 and 1 or the answer is one number."""
    name = dataset.label_names[0]
    if dataset.columns and dataset.columns.classes and tree.n_answers == len(dataset.columns.classes):
        taken = set(dataset.feature_names)
        return [f"{name} {each}" if each in taken else each for each in dataset.columns.classes]
    if tree.labels is None:
        return [name] if tree.n_outputs == 1 else None
    return [f"{name} 0", f"{name} 1"] if np.nanmax(dataset.train.Y) <= 1 else None
