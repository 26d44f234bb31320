"""Networks from torch, Stable-Baselines3, ONNX and scikit-learn, which are imported only when they are asked for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from otr.core.head import Head
from otr.core.heads import Argmax, Identity, Sign
from otr.core.network import ReluNetwork
from otr.core.smooth_network import SmoothNetwork
from otr.errors import InvalidNetworkError
from otr.extras import naming_the_extra
from otr.importers.onnx_graph import network_of_onnx
from otr.importers.sb3_archive import network_of_file, oracle_of_file
from otr.importers.sb3_model import network_of_model
from otr.importers.torch_modules import network_of_module
from otr.importers.vec_normalize import fold_observation_statistics

if TYPE_CHECKING:
    import torch
    from onnx import ModelProto


@naming_the_extra("otr.from_torch")
def from_torch(module: torch.nn.Module, *, head: Head | None = None) -> ReluNetwork:
    """Return the network of a `torch.nn.Sequential` of Linear, ReLU and LeakyReLU layers.

    Nested Sequentials are opened; Flatten, Identity and Dropout are skipped, as they do nothing to a vector at
    inference. Linear layers without an activation between them are multiplied. A last Tanh becomes the head
    `TanhBox(-1, 1)`; a last Sigmoid needs ``head=otr.Sign()`` and a last Softmax ``head=otr.Argmax()``, since the tree
    answers with the label and not the probability.

    A float64 copy of the module, in evaluation mode, is run on fixed states of several magnitudes: where it answers
    otherwise than its layers (hooks, an overridden `forward`, the old `weight_norm`), nothing is returned.

    Args:
        module: the layers; parameters of any float type, on any device. It stays as it is.
        head: from the outputs to the answer; None for Identity, or TanhBox after a last Tanh.

    Raises:
        InvalidNetworkError: a layer of another kind, named with its position; activations of several slopes; a module
            that is not what its layers say, with the largest difference; tensors that are complex, sparse or expanded,
            or without numbers.
        MissingExtraError: torch is not installed.
    """
    return network_of_module(module, head)


@naming_the_extra("otr.from_sb3")
def from_sb3(
    model: Any,
    *,
    action_low: ArrayLike | None = None,
    action_high: ArrayLike | None = None,
    negative_slope: float | None = None,
    vec_normalize: Any = None,
) -> ReluNetwork:
    """Return the deterministic actor of a Stable-Baselines3 model, or of sb3-contrib's TRPO and ARS.

    SAC, TD3 and DDPG end in `TanhBox`, the others in `ClipBox` or, with discrete actions, `Argmax`; DQN's actor is the
    network of its action values, and of ARS `LinearPolicy` without squashed outputs is read. Stable-Baselines3 computes
    in float32, so its answers differ from the network's by about 1e-7 of the action box. A live model is run on fixed
    states: where it predicts otherwise than its layers, nothing is returned.

    A model trained under VecNormalize expects normalised states. With `vec_normalize`, mean and variance go into the
    first layer and the network takes raw states. VecNormalize also clips the normalised state to +-clip_obs, which the
    network does not: it is the policy inside the box ``mean +- clip_obs * sqrt(variance + epsilon)`` and not outside.
    That box is the network's `domain`; `network.domain.contains(X)` tells which states lie in it.

    From the path of a saved model, only tensors (torch's ``weights_only`` loading) and plain text are read, and no
    code in the file is run, nor in the file of statistics. That text prints the action box to eight decimals.

    Args:
        model: a live model, or the path of the zip file that `model.save` wrote, with or without ".zip".
        action_low, action_high: (o,) limits of the action box in place of the model's.
        negative_slope: of LeakyReLU, for a file that does not tell; must agree with what can be known.
        vec_normalize: the path of the file that `VecNormalize.save` wrote, a live VecNormalize, or
            `ObservationStatistics(mean, variance, epsilon, clip)`; None where the model saw raw states.

    Raises:
        InvalidNetworkError: a policy that is no ReLU network on a vector of inputs: other activations, gSDE, images,
            feature extractors, dictionaries, several discrete actions; widths other than the spaces' or the
            statistics'; or something that the file does not tell.
        ArtefactError: a file is missing, cut off, unpacks to more than 256 MiB, or holds more than tensors in its
            `policy.pth`, or no VecNormalize.
        MissingExtraError: torch is not installed.
    """
    if isinstance(model, str | os.PathLike):
        network = network_of_file(Path(model), action_low, action_high, negative_slope)
    else:
        network = network_of_model(model, action_low, action_high)
        if negative_slope is not None and network.n_hidden and network.negative_slope != negative_slope:
            raise InvalidNetworkError(f"negative_slope is {negative_slope}, the model's is {network.negative_slope}")
    return network if vec_normalize is None else fold_observation_statistics(network, vec_normalize)


@naming_the_extra("otr.importers.oracle_from_sb3")
def oracle_from_sb3(
    path: str | os.PathLike[str], *, vec_normalize: str | os.PathLike[str] | None = None
) -> ReluNetwork | SmoothNetwork:
    """Return the deterministic actor of a saved Stable-Baselines3 model, to be imitated by a tree.

    As `from_sb3` reads a file, and with the same errors, but units may be smooth, too: Tanh (the default of PPO and
    A2C), Sigmoid, SiLU, ELU and GELU. No tree is equal to such a network.
    """
    network = oracle_of_file(Path(path))
    if vec_normalize is None:
        return network
    if isinstance(network, ReluNetwork):
        return fold_observation_statistics(network, vec_normalize)
    return fold_observation_statistics(network, vec_normalize)


@naming_the_extra("otr.from_onnx")
def from_onnx(
    model: str | os.PathLike[str] | bytes | ModelProto, *, head: Head | None = None, output: str | None = None
) -> ReluNetwork:
    """Return the network of an ONNX model whose graph is a chain of layers.

    Read are Gemm and MatMul, Add, Sub, Mul and Div with constants (so input normalisation, too), Relu, and LeakyRelu of
    one slope. A last Tanh becomes the head `TanhBox`, with the scale and shift that follow it; a last Clip, or Max and
    Min, the head `ClipBox`; a last ArgMax the head `Argmax`. A last Sigmoid needs ``head=otr.Sign()`` and a last
    Softmax ``head=otr.Argmax()``. Flatten, Reshape, Identity, Cast and Dropout are skipped where they leave each
    state's numbers as they are. A model computes in its own type, mostly float32, so its answers differ from the
    network's by about 1e-7 of the size of the terms that are summed.

    The file is data alone: at most 16 MiB are read, and of no other file.

    Args:
        model: the path of a file, its bytes, or an `onnx.ModelProto`. Its input is (n, number of inputs), or more axes
            before a Flatten.
        head: from the outputs to the answer; None for the model's own.
        output: name of the output that is the policy's, where the model has several.

    Raises:
        InvalidNetworkError: a node of another kind, named, with what is accepted; values that branch and join;
            activations of several slopes; numbers kept outside the file; opset 6 or older.
        ArtefactError: the file is missing, too large, cut off or not valid.
        MissingExtraError: onnx is not installed.
    """
    return network_of_onnx(model, head, output)


@naming_the_extra("otr.from_sklearn")
def from_sklearn(mlp: Any) -> ReluNetwork:
    """Return the network of a fitted scikit-learn `MLPClassifier` or `MLPRegressor`.

    A binary classifier gets the head `Sign`, one of several classes `Argmax`; labels are positions in
    ``mlp.classes_``. With activation "identity" the layers are multiplied into a linear model.

    Raises:
        InvalidNetworkError: not fitted, another activation, several labels at once, or a loss with a link function.
        MissingExtraError: scikit-learn is not installed.
    """
    from sklearn.neural_network import MLPClassifier, MLPRegressor
    from sklearn.preprocessing import LabelBinarizer

    if not isinstance(mlp, MLPClassifier | MLPRegressor) or not hasattr(mlp, "coefs_"):
        raise InvalidNetworkError(f"expected a fitted MLPClassifier or MLPRegressor, got {mlp!r}; call fit first")
    if mlp.activation not in ("relu", "identity"):
        raise InvalidNetworkError(f"the activation is {mlp.activation!r}; fit with activation='relu'")
    head: Head = Identity()
    if isinstance(mlp, MLPClassifier):
        kind = mlp._label_binarizer.y_type_ if isinstance(mlp._label_binarizer, LabelBinarizer) else "unknown"
        if kind not in ("binary", "multiclass"):
            raise InvalidNetworkError(f"the labels are of type {kind!r}; fit one classifier for each label")
        head = Sign() if kind == "binary" else Argmax()
    elif mlp.out_activation_ != "identity":
        raise InvalidNetworkError(f"the output goes through {mlp.out_activation_!r}; fit with loss='squared_error'")
    weights = [coefficients.T for coefficients in mlp.coefs_]
    biases = list(mlp.intercepts_)
    while mlp.activation == "identity" and len(weights) > 1:
        upper_weight, upper_bias = weights.pop(), biases.pop()
        biases[-1] = upper_weight @ biases[-1] + upper_bias
        weights[-1] = upper_weight @ weights[-1]
    return ReluNetwork(weights, biases, head=head)
