"""A map of a tree over two of its inputs: its regions, what it does there, and the states that it visits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

import otr
from otr.programs.merging import merge_equal_leaves
from otr.programs.picture.colours import label_colours, level_colour
from pipelines.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIDE = 500  # points of the grid along each axis
MOST_STATES, MOST_PANELS = 2000, 6
PANEL, LEGEND, NOTE = 3.6, 1.35, 0.75  # inches
SMALL, NORMAL = 8, 9  # points


def chosen_inputs(
    tree: otr.ObliqueTree, states: np.ndarray, names: Sequence[str], asked: Sequence[str]
) -> tuple[int, int]:
    """Return two inputs: those with the names that were asked for, else the two that weigh most in the tests.

    An input weighs what its coefficients sum to, in units of its spread over the states (n, d).

    Raises:
        ConfigError: a name is unknown, there are not two of them, or the tree has one input alone.
    """
    if tree.n_inputs < 2:
        raise ConfigError(f"figure=regions: a map needs two inputs, the tree has {tree.n_inputs}")
    if asked:
        for name in asked:
            if name not in names:
                raise ConfigError(f"inputs: the policy has no input {name!r}.{did_you_mean(name, names)}")
        if len(set(asked)) != 2:
            raise ConfigError(f"inputs=[{','.join(asked)}]: give two inputs, as inputs=[{names[0]},{names[1]}]")
        return names.index(asked[0]), names.index(asked[1])
    weights = np.abs(tree.P).sum(axis=0) if tree.n_nodes else np.abs(tree.M).sum(axis=(0, 1))
    order = np.argsort(-weights * states.std(axis=0), kind="stable")
    first, second = sorted(order[:2].tolist())
    return first, second


def draw_regions(
    tree: otr.ObliqueTree,
    states: np.ndarray,
    inputs: tuple[int, int],
    *,
    feature_names: Sequence[str],
    output_names: Sequence[str],
    title: str,
) -> Figure:
    """Return a map of what the tree does where two inputs vary and all others are at their medians over the states.

    A panel an action, of six at most; one panel where the answers are labels. Dark lines part the leaves; dots are the
    visited states, by these two inputs, whatever their others are.

    Args:
        tree: any tree of at least two inputs.
        states: (n, d) visited states, at least one.
        inputs: the two inputs, by their numbers: along, and up.
        feature_names, output_names: as in `otr.to_text`.
        title: above the map.
    """
    from matplotlib.figure import Figure

    tree = merge_equal_leaves(tree)
    across, up = inputs
    x, y = (_range(states[:, each]) for each in inputs)
    grid = np.tile(np.median(states, axis=0), (SIDE * SIDE, 1))
    grid[:, across], grid[:, up] = (axis.ravel() for axis in np.meshgrid(x, y))
    leaves = tree.apply(grid).reshape(SIDE, SIDE)
    answers = np.asarray(tree.predict(grid))
    labelled = answers.ndim == 1
    panels = [0] if labelled else list(range(min(answers.shape[1], MOST_PANELS)))
    n_columns = min(len(panels), 3)
    n_rows = -(-len(panels) // n_columns)
    figure = Figure(figsize=(PANEL * n_columns + LEGEND, PANEL * n_rows * 0.9 + NOTE), layout="constrained")
    figure.set_facecolor("white")
    axes = list(figure.subplots(n_rows, n_columns, squeeze=False).flat)
    shown = states[:: max(1, len(states) // MOST_STATES)]
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    for axis, action in zip(axes, panels, strict=False):
        if labelled:
            _draw_labels(axis, x, y, answers.reshape(SIDE, SIDE), output_names)
        else:
            _draw_action(figure, axis, x, y, answers[:, action].reshape(SIDE, SIDE), _limits(tree, answers, action))
            axis.set_title(output_names[action], fontsize=NORMAL, fontweight="bold", loc="left")
        _draw_borders(axis, x, y, leaves)
        axis.plot(shown[:, across], shown[:, up], ".", color="black", markersize=3, alpha=0.4, markeredgewidth=0)
        axis.set_xlim(x[0], x[-1])
        axis.set_ylim(y[0], y[-1])
        axis.set_xlabel(feature_names[across], fontsize=SMALL, parse_math=False)
        axis.set_ylabel(feature_names[up], fontsize=SMALL, parse_math=False)
        axis.tick_params(labelsize=SMALL)
    figure.suptitle(title, fontsize=NORMAL)
    figure.supxlabel(_note(tree, states, len(shown), leaves), fontsize=SMALL - 1, color="#5b6570")
    return figure


def _range(values: np.ndarray) -> np.ndarray:
    """Return points from the least to the greatest value, and a little beyond."""
    low, high = float(values.min()), float(values.max())
    margin = 0.06 * (high - low) or 1.0
    return np.linspace(low - margin, high + margin, SIDE)


def _limits(tree: otr.ObliqueTree, answers: np.ndarray, action: int) -> tuple[float, float]:
    limits = tree.head.limits(tree.n_outputs)
    if limits is None:
        largest = float(np.abs(answers[:, action]).max()) or 1.0
        return -largest, largest
    return float(limits[0][action]), float(limits[1][action])


def _draw_labels(axis: Axes, x: np.ndarray, y: np.ndarray, labels: np.ndarray, names: Sequence[str]) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    there = sorted(set(labels.ravel().tolist()))
    pixels = np.zeros((*labels.shape, 3))
    for label in there:
        pixels[labels == label] = to_rgb(label_colours(label)[1])
    axis.imshow(pixels, extent=(x[0], x[-1], y[0], y[-1]), origin="lower", aspect="auto", interpolation="nearest")
    patches = [
        Patch(facecolor=label_colours(label)[1], edgecolor=label_colours(label)[0],
              label=names[label] if label < len(names) else str(label))
        for label in there
    ]  # fmt: skip
    axis.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False, fontsize=SMALL)


def _draw_action(
    figure: Figure, axis: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, limits: tuple[float, float]
) -> None:
    from matplotlib.colors import ListedColormap

    colours = ListedColormap([level_colour(level) for level in np.linspace(-1, 1, 201).tolist()])
    image = axis.imshow(
        values, extent=(x[0], x[-1], y[0], y[-1]), origin="lower", aspect="auto", cmap=colours, vmin=limits[0],
        vmax=limits[1], interpolation="nearest",
    )  # fmt: skip
    bar = figure.colorbar(image, ax=axis, fraction=0.05, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL - 1)


def _draw_borders(axis: Axes, x: np.ndarray, y: np.ndarray, leaves: np.ndarray) -> None:
    """Draw the lines between points that end in different leaves."""
    border = np.zeros(leaves.shape, dtype=bool)
    border[:, 1:] |= leaves[:, 1:] != leaves[:, :-1]
    border[1:] |= leaves[1:] != leaves[:-1]
    pixels = np.zeros((*leaves.shape, 4))
    pixels[border] = (0.2, 0.2, 0.2, 0.75)
    axis.imshow(pixels, extent=(x[0], x[-1], y[0], y[-1]), origin="lower", aspect="auto", interpolation="nearest")


def _note(tree: otr.ObliqueTree, states: np.ndarray, n_dots: int, leaves: np.ndarray) -> str:
    n_shown = len(np.unique(leaves))
    here = f"{n_shown} of {tree.n_leaves:,} leaves" if tree.n_leaves > 1 else "one leaf"
    if tree.n_inputs == 2:
        return f"{here}, parted by dark lines; dots: {n_dots:,} visited states"
    return (
        f"all other inputs at their medians over {len(states):,} visited states, of which {n_dots:,} are the dots;\n"
        f"{here} in this section, parted by dark lines"
    )
