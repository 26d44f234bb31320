"""Policies from torch, Stable-Baselines3, ONNX and scikit-learn, which are imported only when they are needed."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from otr.core.head import Head
from otr.core.network import ReluNetwork
from otr.core.pattern_tree import PatternTree
from otr.core.smooth_network import Oracle
from otr.errors import ArtefactError, InvalidNetworkError, OtrError
from otr.extras import naming_the_extra
from otr.files.artefacts import load
from otr.importers.assembly import mappable, policy_of
from otr.importers.input_statistics import AUTO, find_statistics, fold_observation_statistics, is_auto
from otr.importers.onnx_file import oracle_of_onnx, sections_of_onnx
from otr.importers.sb3_archive import network_of_file, oracle_of_file
from otr.importers.sb3_model import network_of_model
from otr.importers.sklearn_estimator import policy_of_estimator, read_skops
from otr.importers.stored_layers import network_of_nnet, policy_of_state_dict
from otr.importers.torch_modules import oracle_of_export, oracle_of_module, policy_of_module, sections_of_export

if TYPE_CHECKING:
    import torch
    from onnx import ModelProto
    from torch.export import ExportedProgram

__all__ = ["from_onnx", "from_sb3", "from_sklearn", "from_torch", "read_policy"]


def __dir__() -> list[str]:
    return __all__


@contextmanager
def _reading(file: Any) -> Iterator[None]:
    """Raise ArtefactError where a reader fails on a file in an unforeseen way, as on changed files."""
    try:
        yield
    except (OtrError, ImportError):
        raise
    except Exception as error:
        what = file if isinstance(file, str | os.PathLike) else "the model"
        problem = f"{what} cannot be read ({type(error).__name__}: {error})"
        raise ArtefactError(f"{problem}; it is damaged, or of another version: write it again") from error


@naming_the_extra("otr.from_torch")
def from_torch(
    module: torch.nn.Module | ExportedProgram | str | os.PathLike[str], *, head: Head | None = None
) -> ReluNetwork:
    """Return the network of a torch module, of an exported program, or of the file of one.

    The module is a graph. Its activations cut it into sections, and each section is the matrix that it evaluates to in
    float64, whatever operations it is written in. Activations are ReLU, LeakyReLU, PReLU, abs, and clips of any kind;
    what skips layers becomes dense links. Of one linear layer the stored numbers are read bit for bit. A last tanh,
    also scaled, becomes the head `TanhBox`, a last clip `ClipBox`, an argmax `Argmax`. A last sigmoid needs
    ``head=otr.Sign()`` and a last softmax ``head=otr.Argmax()``, since the tree answers with the label and not the
    probability. On fixed states of several magnitudes the network is compared with the module, in evaluation mode.

    A Sequential of torch's layers is read layer by layer, and another module by `torch.export`, for as many inputs as
    its first Linear has. Hooks, the old `weight_norm` among them, and functions that replace a method of one module
    are refused, as they may act on some states alone.

    Of a file, JSON and the bytes of tensors are read and torch's operators are run. Its pickles are not opened, as
    `torch.export.load` would.

    Args:
        module: of any float type, on any device, and left as it is; ``torch.export.export(module, (states,))``; or the
            path of the file to which `torch.export.save` wrote that (torch 2.9 or newer).
        head: from the outputs to the answer; None for Identity, or the module's own.

    Raises:
        InvalidNetworkError: an operation that is neither affine nor known, named; smooth units; a hook; another answer
            than the module's; tensors that are complex, sparse, expanded or without numbers; weights that are not
            finite; a matrix of more than 2^24 numbers.
        ArtefactError: a file that is missing, cut off, unpacks to more than 64 MiB, or is no torch export.
        MissingExtraError: torch is not installed.

    Examples:
        >>> import torch
        >>> otr.from_torch(torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.ReLU(), torch.nn.Linear(8, 2)))
        ReluNetwork(4 -> 8 -> 2, negative_slope=0.0, dense=False, head=Identity())
    """
    if isinstance(module, str | os.PathLike):
        with _reading(module):
            return _of_export(Path(module), head)
    from torch.export import ExportedProgram, save

    if isinstance(module, ExportedProgram):
        written = io.BytesIO()
        save(module, written)
        return _of_export(written.getvalue(), head)
    return policy_of_module(module, head)


@naming_the_extra("otr.from_sb3")
def from_sb3(
    model: Any,
    *,
    action_low: ArrayLike | None = None,
    action_high: ArrayLike | None = None,
    negative_slope: float | None = None,
    normalise: Any = AUTO,
) -> ReluNetwork:
    """Return the deterministic actor of a Stable-Baselines3 model, or of sb3-contrib's.

    That is the policy on a vector, or on what gymnasium's FlattenObservation makes one of, of PPO, A2C, TRPO, SAC, TD3,
    DDPG, DQN, TQC, QR-DQN, CrossQ, ARS and MaskablePPO, which is read without its masks, as a warning says. Actions
    that tanh squashes end in `TanhBox`, others in `ClipBox` or, with discrete actions, `Argmax`; DQN's actor is the
    network of its action values, QR-DQN's of their means over the quantiles. Batch normalisation is folded into the
    layer after it; where gSDE clips the mean, a layer of ReLU units does. Stable-Baselines3 computes in float32, so
    its answers differ from the network's by about 1e-7 of the
    action box. A live model has no hooks. It is read as `model.save` writes it, and is run on fixed states: where its
    predictions differ from its layers', nothing is returned.

    A model trained under VecNormalize expects normalised states. Mean and variance go into the first layer, so that the
    network takes raw states. They are those of a live model's environment, or of the ``vecnormalize.pkl`` in the
    folder named as the zip or next to the zip, which a warning says, or of `normalise`. A warning also says
    where a zip shows that it was trained under VecNormalize and there is no such file. VecNormalize clips the
    normalised state to +-clip_obs, which the network does not: it is the policy inside the box
    ``mean +- clip_obs * sqrt(variance + epsilon)`` and not outside. That box is the network's `domain`;
    `network.domain.contains(X)` says which states are in it.

    From the path of a saved model, only tensors (torch's ``weights_only`` loading), plain text and the action box's
    numbers are read, and no code in the file is run, nor in the file of statistics.

    Args:
        model: a live model, or the path of the zip file that `model.save` wrote, with or without ".zip".
        action_low, action_high: (o,) limits of the action box in place of the model's.
        negative_slope: of LeakyReLU, for a file that does not give it; must agree with what can be known.
        normalise: statistics, as `read_policy` takes them; None for the network of the states that the model saw,
            whatever these were; "auto" to find the statistics.

    Raises:
        InvalidNetworkError: a policy that is no ReLU network on a vector of inputs: other activations, images,
            feature extractors, dictionaries, several discrete actions; widths other than the spaces' or the
            statistics'; or something that the file does not give.
        ArtefactError: a file is missing, cut off, damaged, unpacks to more than 256 MiB, or holds more than tensors in
            its `policy.pth`, or no VecNormalize.
        MissingExtraError: torch is not installed.

    Examples:
        >>> import torch, stable_baselines3
        >>> kwargs = {"net_arch": [8], "activation_fn": torch.nn.ReLU}
        >>> model = stable_baselines3.PPO("MlpPolicy", "CartPole-v1", policy_kwargs=kwargs, device="cpu")
        >>> otr.from_sb3(model)
        ReluNetwork(4 -> 8 -> 2, negative_slope=0.0, dense=False, head=Argmax())
    """
    if isinstance(model, str | os.PathLike):
        with _reading(model):
            network = network_of_file(Path(model), action_low, action_high, negative_slope)
        normalise = _found_next_to(Path(model)) if is_auto(normalise) else normalise
    else:
        with _reading(model):
            network = network_of_model(model, action_low, action_high, negative_slope)
        normalise = model.get_vec_normalize_env() if is_auto(normalise) else normalise
    return network if normalise is None else fold_observation_statistics(network, normalise)


@naming_the_extra("otr.read_policy")
def read_policy(
    model: str | os.PathLike[str] | torch.nn.Module | ExportedProgram | ModelProto,
    *,
    normalise: Any = AUTO,
    output: str | None = None,
    layers: str | Sequence[str] | None = None,
    activation: str | None = None,
) -> Oracle:
    """Return the policy in a file, to be mapped to a tree or to be imitated by one.

    The suffix says what the file is: ``.zip`` of Stable-Baselines3 (`from_sb3`), ``.onnx`` (`from_onnx`), ``.pt2`` of
    torch (`from_torch`), ``.skops`` of scikit-learn (`from_sklearn`), ``.json`` and ``.npz`` of `otr.save`, ``.nnet``
    (ACAS Xu: its minima and maxima are the domain), ``.pth`` and ``.pt`` with a torch module's state_dict. It is read
    as these functions read it, and with the same errors, but units may be others, too. No tree is equal to such a
    policy. Layers with tanh (the default of PPO and A2C in Stable-Baselines3) and the other units of
    `otr.core.smooth_network.ACTIVATIONS` in a zip are a `SmoothNetwork`. An ONNX model, or an export of torch, that is
    no ReLU network is a `BlackBox`: onnxruntime, or torch, answers, whatever its operators are. Of a model that ends in
    a Softmax the likeliest label is the answer.

    Args:
        model: path of the file; or a torch module, its export or an ONNX model, in place of its file.
        normalise: statistics of the states, where the policy saw ``(x - mean) / sqrt(var + epsilon)``: the path of the
            ``.pkl`` that `VecNormalize.save` wrote, of JSON, or of an npz, with mean, var and epsilon, of which
            ``std`` in place of var divides by ``std + epsilon``, and ``clip`` limits the result; a dictionary of these;
            or a live VecNormalize or gymnasium's NormalizeObservation. Of a zip it is found, or left out with None, as
            by `from_sb3`.
        output: name of the output that is the policy's, of an ONNX model with several.
        layers: of a state_dict, the names of the linear layers in order, or what their names begin with; None where no
            others are in it.
        activation: between the layers of a state_dict, which does not say: "relu", "leaky_relu" or one of
            `otr.core.smooth_network.ACTIVATIONS`.

    Raises:
        InvalidNetworkError: as the functions above; a classifier whose classes are not 0, 1, ..., the actions; a saved
            tree other than a whole `PatternTree`, which represents no network; statistics that do not fit; a model with
            memory; or `output` with another than an ONNX model.
        ArtefactError: as the functions above; or the suffix is another one.
        MissingExtraError: a package that the kind of file needs is not installed.

    Examples:
        >>> import torch
        >>> torch.save({"0.weight": torch.ones(2, 3), "0.bias": torch.zeros(2)}, "agent.pth")
        >>> otr.read_policy("agent.pth").predict([1.0, 2.0, 3.0])
        array([6., 6.])
    """
    if not isinstance(model, str | os.PathLike):
        with _reading(model):
            policy = _of_object(model, output)
        return policy if is_auto(normalise) or normalise is None else fold_observation_statistics(policy, normalise)
    path = Path(model)
    reader = _reader(path, output, of_layers=(layers, activation) != (None, None))
    with _reading(path):
        policy = reader(path, output=output, layers=layers, activation=activation)
    if is_auto(normalise):
        normalise = _found_next_to(path) if path.suffix == ".zip" else None
    return policy if normalise is None else fold_observation_statistics(policy, normalise)


def _reader(path: Path, output: str | None, *, of_layers: bool) -> Callable[..., Oracle]:
    """Return what reads a kind of file; raise where it is another kind, or has no such arguments."""
    reader = _READERS.get(path.suffix)
    if reader is None:
        raise ArtefactError(
            f"{path}: read are {', '.join(_READERS)}, not {path.suffix or 'files without a suffix'}; a torch module is "
            "written by torch.export.save(torch.export.export(module, (states,)), 'policy.pt2'), a scikit-learn "
            "estimator by skops.io.dump(estimator, 'policy.skops')"
        )
    if of_layers and path.suffix not in (".pth", ".pt"):
        raise InvalidNetworkError(f"layers= and activation= are for a state_dict (.pth, .pt); {path} says both itself")
    if output is not None and path.suffix != ".onnx":
        raise InvalidNetworkError(f"output={output!r} is one of several outputs of an ONNX model; {path} is none")
    return reader


def read_black_box(content: bytes, suffix: str, output: str | None) -> Oracle:
    """Return a policy of `read_policy` again from the bytes, suffix and output that a `BlackBox` keeps."""
    with _reading("the model"):
        return oracle_of_onnx(content, output) if suffix == ".onnx" else oracle_of_export(content)


def _of_object(model: Any, output: str | None) -> Oracle:
    import torch

    if isinstance(model, torch.nn.Module):
        return oracle_of_module(model)
    if isinstance(model, torch.export.ExportedProgram):
        written = io.BytesIO()
        torch.export.save(model, written)
        return oracle_of_export(written.getvalue())
    if hasattr(model, "SerializeToString"):
        return oracle_of_onnx(model, output)
    raise InvalidNetworkError(
        f"a policy is read from the path of a file, a torch module, its export or an ONNX model, not from a "
        f"{type(model).__name__}; of another policy, anything with predict(X) can be played by otr.rollout"
    )


def _found_next_to(model: Path) -> Path | None:
    """Return the file of statistics next to a saved model, with a warning; None where there is none."""
    file, warning = find_statistics(model)
    if warning:
        warnings.warn(warning, stacklevel=4)
    return file


def _of_export(file: Path | bytes, head: Head | None = None) -> ReluNetwork:
    sections, answer = sections_of_export(file)
    return policy_of(sections, head, answer=answer)


def _of_skops(path: Path) -> Oracle:
    estimator = read_skops(path)
    policy = policy_of_estimator(estimator)
    classes = np.asarray(estimator.classes_).tolist() if policy.head.gives_labels else []
    if classes != list(range(len(classes))):
        raise InvalidNetworkError(
            f"the classes of {estimator!r} are {classes}, expected the actions' numbers 0, 1, ...; fit it on these"
        )
    return policy


def _of_saved(path: Path) -> Oracle:
    tree = load(path)
    if isinstance(tree, PatternTree) and not tree.is_restricted:
        return tree.network
    n_leaves = tree.n_paths if isinstance(tree, PatternTree) else tree.n_leaves
    raise InvalidNetworkError(f"it holds a tree of {n_leaves} leaves, which represents no network")


_READERS: dict[str, Callable[..., Oracle]] = {
    ".zip": lambda path, **_: oracle_of_file(path),
    ".onnx": lambda path, output, **_: oracle_of_onnx(path, output),
    ".pt2": lambda path, **_: oracle_of_export(path),
    ".skops": lambda path, **_: _of_skops(path),
    ".nnet": lambda path, **_: network_of_nnet(path),
    ".pth": lambda path, layers, activation, **_: policy_of_state_dict(path, layers, activation),
    ".pt": lambda path, layers, activation, **_: policy_of_state_dict(path, layers, activation),
    ".json": lambda path, **_: _of_saved(path),
    ".npz": lambda path, **_: _of_saved(path),
}


@naming_the_extra("otr.from_onnx")
def from_onnx(
    model: str | os.PathLike[str] | bytes | ModelProto, *, head: Head | None = None, output: str | None = None
) -> ReluNetwork:
    """Return the network of an ONNX model, read as `from_torch` reads a module, by onnx's reference in float64.

    Any operators may occur between the activations as long as they are affine together: Gemm, MatMul, Conv,
    BatchNormalization, Concat, Shape, Gather, Reshape, branches of constants, and so on. An ArgMax may follow a Softmax
    or the subtraction of a LogSumExp. A model computes in its own type, mostly float32, so its answers differ from the
    network's by about 1e-7 of the size of the terms that are summed.

    The file is data alone: at most 32 MiB are read, and of no other file.

    Args:
        model: the path of a file, its bytes, or an `onnx.ModelProto`. Its input is (n, number of inputs), also with
            more axes, or (number of inputs,).
        head: from the outputs to the answer; None for the model's own.
        output: name of the output that is the policy's, where the model has several.

    Raises:
        InvalidNetworkError: a node that is neither affine nor known, named; smooth units; numbers kept outside the
            file; a matrix of more than 2^24 numbers; opset 6 or older.
        ArtefactError: the file is missing, too large, cut off or not valid.
        MissingExtraError: onnx is not installed.

    Examples:
        >>> import onnx
        >>> onnx.save(otr.to_onnx(otr.parse_program("2 x + 1", ["x"])), "policy.onnx")
        >>> otr.from_onnx("policy.onnx")
        ReluNetwork(1 -> 1, negative_slope=0.0, dense=False, head=Identity())
    """
    with _reading(model):
        return policy_of(sections_of_onnx(model, output), head)


@naming_the_extra("otr.from_sklearn")
def from_sklearn(estimator: Any) -> ReluNetwork:
    """Return the network of a fitted scikit-learn MLP or linear model, also after the scalers of a Pipeline.

    Read are `MLPClassifier`, `MLPRegressor`, and models with coefficients (LogisticRegression, Ridge, LinearSVC, ...),
    which have no hidden layer. `StandardScaler`, `MinMaxScaler`, `MaxAbsScaler` and `RobustScaler` before one of them
    are folded into the first layer. A binary classifier gets the head `Sign`, one of several classes `Argmax`; labels
    are positions in ``estimator.classes_``. With activation "identity" the layers are multiplied into a linear model.

    The estimator predicts fixed states of several magnitudes: where its predictions are not those of its
    coefficients (a link function, one classifier for each pair of classes), nothing is returned.

    Args:
        estimator: fitted, or the path of the file to which `skops.io.dump` wrote it. Of a file, types are loaded that
            skops trusts by itself, and the two optimizers of an MLP, which hold numbers; nothing of any other.

    Raises:
        InvalidNetworkError: not fitted, another activation, several labels at once, a loss with a link function, or
            another step of the Pipeline; a file that holds a type that skops does not trust, which is named.
        ArtefactError: the file is missing, cut off, or unpacks to more than 64 MiB.
        MissingExtraError: scikit-learn, or for a file skops, is not installed.

    Examples:
        >>> from sklearn.linear_model import LinearRegression
        >>> net = otr.from_sklearn(LinearRegression().fit([[0.0], [1.0]], [1.0, 3.0]))
        >>> net.predict([2.0]).round(6)
        array([5.])
    """
    if not isinstance(estimator, str | os.PathLike):
        return mappable(policy_of_estimator(estimator))
    with _reading(estimator):
        return mappable(policy_of_estimator(read_skops(Path(estimator))))
