"""NDPS as Orfanos (2023) ran it: an oblique tree fitted by gradient to an oracle, then hardened and refitted."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from otr.control.dagger.row_sampling import draw_rows
from otr.control.search.state_moments import CONSTANT
from otr.control.settings import NdpsSettings
from otr.control.soft_trees.soft_tree import SoftTree
from otr.core.arrays import BoolArray, FloatArray, IntArray
from otr.core.head import Head
from otr.core.tree import ObliqueTree
from otr.setting import check_settings

_MAX_ACTIVE_SETS = 20
_MAX_LBFGS_STEPS = 25
_LARGE_MEAN = 10.0  # in standard deviations: a larger one takes more updates of Adam than there are
_CONSTANT = 1e-12  # deviation, compared with the largest number of a component, that rounding alone may make
_SPREAD_OF_ZEROS = 1e-8  # what answers that are all 0 are divided by, so that what training adds to them stays small


@dataclass(frozen=True)
class NdpsFit:
    """The hard tree, and its module, on the states as they are, from which the next round starts."""

    tree: ObliqueTree
    module: SoftTree


def fit_ndps(
    X: FloatArray,
    answers: FloatArray | IntArray,
    weights: FloatArray,
    generator: np.random.Generator,
    *,
    head: Head,
    n_outputs: int,
    depth: int,
    settings: NdpsSettings,
    start: SoftTree | None = None,
) -> NdpsFit:
    """Fit a soft tree to an oracle's answers, harden it and fit its leaves again.

    Labels are fitted by cross-entropy, actions by squared error. With a `ClipBox` head an answer at the box's edge asks
    for a value at the edge or beyond, as that is what the head makes of it. Inputs are standardised for the fit and
    the tests written in the states' own units afterwards. Each action component is divided by its standard deviation
    for the fit. Where its mean is more than 10 standard deviations, the mean is subtracted before the fit and added to
    the leaves' offsets afterwards; a constant other than zero is centred in this way and not divided.

    Args:
        X: (n, d) states.
        answers: (n,) labels for the head `Argmax`, else (n, o) actions.
        weights: (n,) importance of each row, not negative.
        generator: of the mini-batches and of the first tests.
        head: of the tree.
        n_outputs: o, or the number of labels.
        depth: tests on each path of the tree.
        settings: see `NdpsSettings`.
        start: the module of the last round's fit; None to start afresh.

    Returns:
        The tree, and the module that the next fit may start from.

    Raises:
        ValueError: the shapes do not agree, or a setting is out of its range.
    """
    check_settings(settings)
    if len(X) == 0 or len(answers) != len(X) or len(weights) != len(X):
        raise ValueError(f"{len(X)} states, {len(answers)} answers and {len(weights)} weights; give as many of each")
    X = np.asarray(X, dtype=np.float64)  # the leaves' refit counts in this type
    centre, spread = X.mean(axis=0), X.std(axis=0)
    spread[spread <= _CONSTANT * np.abs(X).max(axis=0)] = 1.0
    problem = _StandardisedRows.of((X - centre) / spread, answers, weights / weights.mean(), head, n_outputs)
    torch_generator = torch.Generator().manual_seed(int(generator.integers(2**63)))
    if start is None:
        module = SoftTree(X.shape[1], n_outputs, depth, affine_leaves=settings.affine_leaves, generator=torch_generator)
    else:
        module = copy.deepcopy(start)
        module.substitute(centre, spread)
        _shift_leaves(module, -problem.centre)
        _scale_leaves(module, 1.0 / problem.scale)
    _fit_softly(module.float(), problem, settings, torch_generator)
    module.double()
    _refit_leaves(module, problem, settings.ridge)
    _scale_leaves(module, problem.scale)
    _shift_leaves(module, problem.centre)
    module.substitute(-centre / spread, 1.0 / spread)
    return NdpsFit(module.harden(head), module)


@dataclass(frozen=True)
class NdpsImitator(NdpsSettings):
    """NDPS as the fit of a DAgger run: each round goes on from the soft tree of the round before.

    The soft trees are in `folder` under the number of rows that they were fitted to, so that a resumed run goes on from
    the same one.

    Attributes:
        head: of the tree: `Argmax` for labels, else the box of the actions.
        depth: tests on each path of the tree.
        folder: of the soft trees.
    """

    head: Head
    depth: int
    folder: Path

    def __call__(
        self, X: FloatArray, answers: FloatArray, weights: FloatArray | None, generator: np.random.Generator
    ) -> ObliqueTree:
        """Return the tree for states X (n, d) and what `run_dagger` says of them."""
        rows, counts = draw_rows(len(X), None, self.max_samples, generator)
        n_outputs = answers.shape[1]
        targets = answers[rows] if weights is None else answers[rows].argmax(axis=1)
        start = self._before(len(X), X.shape[1], n_outputs)
        settings = replace(self, n_updates=self.n_updates_next) if start else self
        fit = fit_ndps(
            np.asarray(X[rows]), targets, counts.astype(np.float64), generator,
            head=self.head, n_outputs=n_outputs, depth=self.depth, settings=settings, start=start,
        )  # fmt: skip
        self.folder.mkdir(parents=True, exist_ok=True)
        arrays = {name: tensor.numpy() for name, tensor in fit.module.state_dict().items()}
        np.savez(self.folder / f"soft-{len(X):012d}.npz", **arrays)
        return fit.tree

    def _before(self, n_rows: int, n_inputs: int, n_outputs: int) -> SoftTree | None:
        """Return the soft tree of the fit before one to `n_rows` rows; None for the first."""
        earlier = [path for path in self.folder.glob("soft-*.npz") if int(path.stem.split("-")[1]) < n_rows]
        if not earlier:
            return None
        module = SoftTree(n_inputs, n_outputs, self.depth, affine_leaves=self.affine_leaves).double()
        with np.load(max(earlier), allow_pickle=False) as saved:
            module.load_state_dict({name: torch.from_numpy(saved[name]) for name in saved})
        return module


@dataclass(frozen=True)
class _StandardisedRows:
    """Standardised states, and answers in units of their spread, centred where their mean is large compared with it."""

    X: FloatArray
    answers: FloatArray | IntArray
    weights: FloatArray
    low: FloatArray  # (o,), -inf where values are not clipped
    high: FloatArray
    centre: FloatArray  # (o,), subtracted from the answers
    scale: FloatArray  # (o,), of the answers

    @property
    def has_labels(self) -> bool:
        return self.answers.ndim == 1

    @classmethod
    def of(
        cls, X: FloatArray, answers: FloatArray | IntArray, weights: FloatArray, head: Head, n_outputs: int
    ) -> _StandardisedRows:
        unlimited = np.full(n_outputs, np.inf)
        if head.gives_labels:
            labels = np.asarray(answers, dtype=np.int64)
            return cls(X, labels, weights, -unlimited, unlimited, np.zeros(n_outputs), np.ones(n_outputs))
        mean, std = answers.mean(axis=0), answers.std(axis=0)
        is_far = np.abs(mean) > _LARGE_MEAN * std
        centre = np.where(is_far, mean, 0.0)
        scale = np.where(std > CONSTANT * np.abs(mean), std, np.where(is_far, 1.0, _SPREAD_OF_ZEROS))
        low, high = (head.limits(n_outputs) if head.is_projection else None) or (-unlimited, unlimited)
        rows, low, high = ((values - centre) / scale for values in (answers, low, high))
        return cls(X, rows, weights, low, high, centre, scale)


def _fit_softly(
    module: SoftTree, problem: _StandardisedRows, settings: NdpsSettings, generator: torch.Generator
) -> None:
    """Fit all parameters by Adam while the tests grow hard."""
    X = torch.tensor(problem.X, dtype=torch.float32)
    answers = torch.tensor(problem.answers, dtype=torch.int64 if problem.has_labels else torch.float32)
    weights, low, high = (
        torch.tensor(array, dtype=torch.float32) for array in (problem.weights, problem.low, problem.high)
    )
    optimizer = torch.optim.Adam(module.parameters(), lr=settings.learning_rate)
    for update in range(settings.n_updates):
        progress = update / settings.n_updates
        module.set_beta(settings.beta_first * (settings.beta_last / settings.beta_first) ** progress)
        optimizer.param_groups[0]["lr"] = settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * progress))
        rows = torch.randint(len(X), (settings.batch_size,), generator=generator)
        outputs, wanted = module(X[rows]), answers[rows]
        if problem.has_labels:
            losses = functional.cross_entropy(outputs, wanted, reduction="none")
        else:
            losses = _clipped_errors(outputs, wanted, low, high).square().sum(dim=1)
        optimizer.zero_grad()
        (losses * weights[rows]).mean().backward()  # type: ignore[no-untyped-call]
        optimizer.step()


def _clipped_errors(outputs: Tensor, wanted: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return outputs minus answers, zero where an answer at the box's edge is overshot, (n, o)."""
    errors = outputs - wanted
    overshot = ((wanted >= high) & (errors > 0)) | ((wanted <= low) & (errors < 0))
    return errors.masked_fill(overshot, 0.0)


def _refit_leaves(module: SoftTree, problem: _StandardisedRows, ridge: float) -> None:
    """Fit every leaf to the rows that the hard tests send to it; a leaf without rows stays as it is."""
    rows_of = module.harden().apply(problem.X)
    X1 = np.ones((len(problem.X), 1))
    if module.affine_leaves:
        X1 = np.concatenate((problem.X, X1), axis=1)
    if problem.has_labels:
        _refit_logits(module, X1, rows_of, problem, ridge)
        return
    maps = _as_maps(module.leaves).detach().numpy()  # shares the module's memory
    for leaf in np.unique(rows_of):
        here = rows_of == leaf
        for output in range(maps.shape[1]):
            limits = problem.low[output], problem.high[output]
            wanted = problem.answers[here, output]
            maps[leaf, output] = _ridge(X1[here], wanted, problem.weights[here], maps[leaf, output], limits, ridge)


def _ridge(
    X1: FloatArray,
    wanted: FloatArray,
    weights: FloatArray,
    prior: FloatArray,
    limits: tuple[float, float],
    ridge: float,
) -> FloatArray:
    """Return the map (d + 1,) of least weighted squares, not counting answers at a limit that it overshoots.

    The loss is convex and quadratic for a given set of rows that count; the sets are iterated until one repeats itself.
    """
    low, high = limits
    counts: BoolArray = np.ones(len(X1), dtype=np.bool_)
    solution: FloatArray = prior
    for _ in range(_MAX_ACTIVE_SETS):
        weighted = X1[counts] * weights[counts, None]
        gram = weighted.T @ X1[counts] + ridge * np.eye(len(prior))
        solution = np.asarray(np.linalg.solve(gram, weighted.T @ wanted[counts] + ridge * prior))
        values = X1 @ solution
        still = ~(((wanted >= high) & (values > high)) | ((wanted <= low) & (values < low)))
        if np.array_equal(still, counts):
            break
        counts = still
    return solution


def _refit_logits(module: SoftTree, X1: FloatArray, leaves: IntArray, problem: _StandardisedRows, ridge: float) -> None:
    """Fit all leaves' logits at once: multinomial logistic regressions by L-BFGS, with a ridge to where they start."""
    states, rows = torch.tensor(X1), torch.tensor(leaves)
    labels, weights = torch.tensor(problem.answers), torch.tensor(problem.weights)
    prior = module.leaves.detach().clone()
    optimizer = torch.optim.LBFGS(
        [module.leaves], max_iter=_MAX_LBFGS_STEPS, history_size=10, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimizer.zero_grad()
        logits = (_as_maps(module.leaves)[rows] * states[:, None, :]).sum(-1)
        losses = functional.cross_entropy(logits, labels, reduction="none")
        total: Tensor = (losses * weights).sum() + 0.5 * ridge * (module.leaves - prior).square().sum()
        total.backward()  # type: ignore[no-untyped-call]
        return total

    optimizer.step(loss)  # type: ignore[no-untyped-call]


def _as_maps(leaves: Tensor) -> Tensor:
    """Return leaves as (k, o, c), in which a constant one (k, o) is a map of c = 1 column, that of ones."""
    return leaves if leaves.ndim == 3 else leaves[:, :, None]


@torch.no_grad()
def _scale_leaves(module: SoftTree, factors: FloatArray) -> None:
    """Multiply output k of every leaf by factors[k]."""
    _as_maps(module.leaves).mul_(torch.tensor(factors, dtype=module.leaves.dtype)[:, None])


@torch.no_grad()
def _shift_leaves(module: SoftTree, shifts: FloatArray) -> None:
    """Add shifts[k] to output k of every leaf."""
    _as_maps(module.leaves)[..., -1].add_(torch.tensor(shifts, dtype=module.leaves.dtype))
