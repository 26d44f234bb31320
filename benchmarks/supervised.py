"""Supervised training: the OTR networks of Table 4.2 against their arithmetic and against plain PyTorch.

Trained are networks of two hidden layers of 8 neurons for every label of Bace, HIV, SIDER and Tox21 with ten seeds, 410
in all, by `train_many` with its defaults: 30 epochs of mini-batches of 64, scored on the validation rows after every
epoch. All is CPU time on one core, from arrays in memory to networks. Every network is trained once.

Two floors, both measured in the same run. The dense one is the time of the float32 matrix products alone, that any
implementation with dense arithmetic must spend: inputs times first weights for every step, their transposed product,
the small products of every network, inputs times first weights for the validation rows. The sparse one has our sums
over the ones of the fingerprints in place of the products with the inputs, their indices ready. Neither has an
activation, a loss, an update or the choice of rows in it. Both are taken in the number of seeds at once that is
fastest.

The peer is a PyTorch script that trains one network: `nn.Sequential`, `torch.optim.SGD`, a label's rows without the
missing ones, scikit-learn's area under the curve, and the best epoch kept. One network of every data set is trained,
all epochs, and its seconds stand for each of the others. Its mini-batches come by indexing a tensor, which is
the faster way; by a `DataLoader`, as PyTorch's tutorials do it, the first epochs alone are measured.

Targets, over the four data sets: 300 s, which took the thesis two hours; half the speed of the dense floor; a tenth of
the peer's seconds a network, rows indexed.

Without the molecules, and with no network to fetch them by, scikit-learn's breast_cancer and digits (ten labels, one
against the others) are measured instead, without targets: there is no table of theirs. --quick measures Bace alone.
"""

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from sklearn.metrics import roc_auc_score
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from benchmarks.measure import Entry, alternate, repeats_for
from otr.learners.networks.batched_mlp import MlpSettings
from otr.learners.networks.first_layer import SparseRows, new_rows
from otr.learners.networks.labels_and_seeds import train_many
from pipelines.datasets import load_dataset
from pipelines.errors import MissingInputError

torch.set_num_threads(1)

MOLECULES = {"bace": "Bace", "hiv": "HIV", "sider": "SIDER", "tox21": "Tox21"}
EXAMPLES = {"breast_cancer": "breast_cancer", "digits": "digits"}
N_SEEDS = 10
SEEDS_AT_ONCE = (1, 2, 5, 10)
LOADER_STEPS = 600  # with a DataLoader, at least: whole epochs
SETTINGS = MlpSettings()


@dataclass(frozen=True)
class Problem:
    """A data set's rows: X (n, d) and Y (n, L), NaN where a label is missing."""

    title: str
    X: np.ndarray
    Y: np.ndarray
    X_valid: np.ndarray
    Y_valid: np.ndarray

    @property
    def n_networks(self) -> int:
        """Labels times seeds."""
        return N_SEEDS * self.Y.shape[1]

    @property
    def name(self) -> str:
        """As an entry names it."""
        n_labels = self.Y.shape[1]
        return f"{self.title}, {self.n_networks} networks ({n_labels} label{'s' * (n_labels > 1)}, {N_SEEDS} seeds)"


@dataclass(frozen=True)
class Seconds:
    """CPU-seconds of all networks of a problem.

    Attributes:
        ours: measured.
        dense, sparse: the floors; the latter None where the inputs are dense.
        peer, loader: the peer's one network, and the same with a DataLoader, times the number of networks.
    """

    ours: float
    dense: float
    sparse: float | None
    peer: float
    loader: float


def measure(quick: bool) -> list[Entry]:
    """Return the entries; quick measures one data set."""
    problems, of_the_thesis = load_problems(quick)
    train_plainly(problems[0], 1)  # torch.optim imports much when first used
    seconds = []
    for problem in problems:
        began = time.process_time()
        train_many(
            problem.X, problem.Y, range(N_SEEDS), MlpSettings(), X_valid=problem.X_valid, Y_valid=problem.Y_valid
        )
        ours = time.process_time() - began
        seconds.append(
            Seconds(ours, dense_floor(problem), sparse_floor(problem), peer_seconds(problem), loader_seconds(problem))
        )
        print(f"supervised: {problem.title} done, {ours:.1f} s", flush=True)
    entries = []
    if len(problems) > 1:
        total = Seconds(
            sum(each.ours for each in seconds),
            sum(each.dense for each in seconds),
            sum(each.sparse for each in seconds if each.sparse) or None,
            sum(each.peer for each in seconds),
            sum(each.loader for each in seconds),
        )
        n_networks = sum(problem.n_networks for problem in problems)
        name = f"{' + '.join(problem.title for problem in problems)}, {n_networks} networks"
        entries += entries_of(name, n_networks, total, of_the_thesis and not quick)
    for problem, each in zip(problems, seconds, strict=True):
        entries += entries_of(problem.name, problem.n_networks, each, False)
    return entries


def load_problems(quick: bool) -> tuple[list[Problem], bool]:
    """Return the data sets, and whether they are the thesis's; says so where they are not."""
    try:
        names = ["bace"] if quick else list(MOLECULES)
        return [_fingerprints(name) for name in names], True
    except MissingInputError as error:
        reason = str(error).splitlines()[0]
    print(f"supervised: no molecules ({reason}); otr-data fetches them", flush=True)
    print(f"supervised: measuring scikit-learn's {' and '.join(EXAMPLES)} instead", flush=True)
    return [_example(name) for name in EXAMPLES], False


def entries_of(name: str, n_networks: int, seconds: Seconds, judged: bool) -> list[Entry]:
    """Return the entries of one data set or of all together; `judged` is whether they have targets."""
    ours = n_networks / seconds.ours
    each = seconds.ours / n_networks

    def floor(kind: str, of: float, target: str | None) -> Entry:
        return Entry(
            f"{name}: of the {kind} floor", ours, "networks/s", f"its {kind} products alone", n_networks / of, target
        )

    def plain(kind: str, of: float, target: str | None) -> Entry:
        return Entry(f"{name}: a network", each, "s", f"one by one in PyTorch, {kind}", of / n_networks, target)

    entries = [
        Entry(f"{name}: training", seconds.ours, "s", target="value <= 300" if judged else None),
        floor("dense", seconds.dense, "ratio >= 0.5" if judged else None),
    ]
    if seconds.sparse is not None:
        entries.append(floor("sparse", seconds.sparse, None))
    return [
        *entries,
        plain("rows indexed", seconds.peer, "ratio <= 0.1" if judged else None),
        plain("DataLoader", seconds.loader, None),
    ]


def dense_floor(problem: Problem) -> float:
    """Return the seconds of all float32 matrix products of the training, inputs taken as dense."""
    n_inputs, n_columns = problem.X.shape[1], problem.Y.shape[1] * SETTINGS.hidden[0]
    ones = torch.from_numpy(problem.X_valid.astype(np.float32))
    table, out = torch.randn(n_inputs, n_columns), torch.empty(len(ones), n_columns)

    def products(n_seeds: int) -> Callable[[], None]:
        x = torch.from_numpy(problem.X[_mini_batch(problem, n_seeds)].astype(np.float32))
        tables = torch.randn(n_seeds, n_inputs, n_columns)
        forward, gradient = torch.empty(*x.shape[:2], n_columns), torch.empty_like(tables)
        return lambda: (torch.bmm(x, tables, out=forward), torch.bmm(x.transpose(1, 2), forward, out=gradient))

    validation = _seconds_of(lambda: torch.mm(ones, table, out=out)) * SETTINGS.schedule.epochs * N_SEEDS
    return _floor(problem, products) + validation


def sparse_floor(problem: Problem) -> float | None:
    """Return the same with our sums over ones in place of the products with the inputs; None for dense inputs."""
    rows, valid = new_rows(problem.X), new_rows(problem.X_valid)
    if not isinstance(rows, SparseRows):
        return None
    n_columns = problem.Y.shape[1] * SETTINGS.hidden[0]
    table = torch.randn(rows.n_inputs, n_columns)

    def products(n_seeds: int) -> Callable[[], None]:
        chosen = _mini_batch(problem, n_seeds)
        batch, tables = rows.batch(chosen), table.repeat(n_seeds, 1)
        deltas = torch.randn(*chosen.shape, n_columns)
        return lambda: (batch.times(tables), batch.transposed_times(deltas))

    validation = _seconds_of(lambda: valid.times(table)) * SETTINGS.schedule.epochs * N_SEEDS
    return _floor(problem, products) + validation


def _floor(problem: Problem, products_with_inputs: Callable[[int], Callable[[], None]]) -> float:
    """Return the seconds of all steps' products, of those seeds at once that are fastest."""
    n_steps = SETTINGS.schedule.epochs * len(problem.X) / SETTINGS.schedule.batch_size
    least = float("inf")
    for n_seeds in SEEDS_AT_ONCE:
        parts = products_with_inputs(n_seeds), small_products(n_seeds * problem.Y.shape[1])
        least = min(least, sum(map(_seconds_of, parts)) / n_seeds)
    return least * n_steps * N_SEEDS


def small_products(n_networks: int) -> Callable[[], None]:
    """Return a function with a step's products behind the first layer of so many networks, forward and back."""
    first, second = SETTINGS.hidden
    n_rows = SETTINGS.schedule.batch_size
    h1, h2 = torch.randn(n_networks, n_rows, first), torch.randn(n_networks, n_rows, second)
    W2, W3 = torch.randn(n_networks, first, second), torch.randn(n_networks, second, 1)
    d1, d2, d3 = torch.empty_like(h1), torch.empty_like(h2), torch.randn(n_networks, n_rows, 1)
    G2, G3 = torch.empty_like(W2), torch.empty_like(W3)

    def products() -> None:
        torch.bmm(h1, W2, out=d2)
        torch.bmm(h2, W3, out=d3)
        torch.bmm(h2.transpose(1, 2), d3, out=G3)
        torch.bmm(d3, W3.transpose(1, 2), out=d2)
        torch.bmm(h1.transpose(1, 2), d2, out=G2)
        torch.bmm(d2, W2.transpose(1, 2), out=d1)

    return products


def _mini_batch(problem: Problem, n_seeds: int) -> np.ndarray:
    """Return the rows of a mini-batch of every seed, (n_seeds, B)."""
    generator = np.random.default_rng(0)
    return np.stack([generator.permutation(len(problem.X))[: SETTINGS.schedule.batch_size] for _ in range(n_seeds)])


def _seconds_of(function: Callable[[], object]) -> float:
    return alternate(function, rounds=5, repeats=repeats_for(function, 0.01))[0]


def peer_seconds(problem: Problem) -> float:
    """Return the seconds of one network by the plain script, all epochs, times the number of networks."""
    return train_plainly(problem, SETTINGS.schedule.epochs) * problem.n_networks


def loader_seconds(problem: Problem) -> float:
    """Return the same with a DataLoader, from its first epochs."""
    n_epochs = min(SETTINGS.schedule.epochs, -(-LOADER_STEPS * SETTINGS.schedule.batch_size // len(problem.X)))
    seconds = train_plainly(problem, n_epochs, with_loader=True)
    return seconds * SETTINGS.schedule.epochs / n_epochs * problem.n_networks


def train_plainly(problem: Problem, n_epochs: int, with_loader: bool = False) -> float:
    """Train one network, of the first label, as a PyTorch script would; return the seconds."""
    schedule = SETTINGS.schedule
    X, y = _of_first_label(problem.X, problem.Y)
    X_valid, y_valid = _of_first_label(problem.X_valid, problem.Y_valid)
    began = time.process_time()
    layers: list[nn.Module] = []
    widths = [X.shape[1], *SETTINGS.hidden]
    for n_in, n_out in pairwise(widths):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    model = nn.Sequential(*layers, nn.Linear(widths[-1], 1))
    loss = nn.BCEWithLogitsLoss()
    optimiser = torch.optim.SGD(
        model.parameters(), lr=schedule.learning_rate, momentum=schedule.momentum, nesterov=True
    )
    scheduler = torch.optim.lr_scheduler.StepLR(optimiser, schedule.decay_every, schedule.decay)
    loader = DataLoader(TensorDataset(X, y), schedule.batch_size, shuffle=True)
    best, kept = -np.inf, model.state_dict()
    for _ in range(n_epochs):
        indexed = ((X[rows], y[rows]) for rows in torch.randperm(len(X)).split(schedule.batch_size))
        for x_batch, y_batch in loader if with_loader else indexed:
            optimiser.zero_grad()
            loss(model(x_batch)[:, 0], y_batch).backward()
            optimiser.step()
        scheduler.step()
        with torch.no_grad():
            score = roc_auc_score(y_valid, model(X_valid)[:, 0])
        if score > best:
            best, kept = score, copy.deepcopy(model.state_dict())
    model.load_state_dict(kept)
    return time.process_time() - began


def _of_first_label(X: np.ndarray, Y: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    known = ~np.isnan(Y[:, 0])
    return torch.from_numpy(X[known].astype(np.float32)), torch.from_numpy(Y[known, 0].astype(np.float32))


def _fingerprints(name: str) -> Problem:
    data = load_dataset(name)
    return Problem(MOLECULES[name], data.train.X, data.train.Y, data.valid.X, data.valid.Y)


def _example(name: str) -> Problem:
    """Return an example data set with standardised inputs and a label for each class, or one for two classes."""
    data = load_dataset(name)
    mean, scale = data.train.X.mean(axis=0), data.train.X.std(axis=0)
    scale[scale == 0] = 1.0
    X, X_valid = ((part.X - mean) / scale for part in (data.train, data.valid))
    classes: Sequence[float] = np.unique(data.train.Y).tolist()
    classes = classes[1:] if len(classes) == 2 else classes
    Y, Y_valid = (np.equal(part.Y, classes).astype(np.float64) for part in (data.train, data.valid))
    return Problem(EXAMPLES[name], X, Y, X_valid, Y_valid)
