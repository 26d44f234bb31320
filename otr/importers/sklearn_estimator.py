"""Networks from scikit-learn: MLPs and linear models, with the scalers of a Pipeline before them, and skops files."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from otr.core.head import Head
from otr.core.heads import Argmax, Identity, Sign
from otr.core.smooth_network import Layered, SmoothNetwork
from otr.errors import ArtefactError, InvalidNetworkError
from otr.files.zip_members import read_members
from otr.importers.assembly import policy_of, probe_states, reach
from otr.importers.sections import Sections

Step = Callable[[NDArray[Any]], NDArray[Any]]
_UNITS: dict[str, Step] = {"relu": lambda z: np.maximum(z, 0.0), "tanh": np.tanh, "logistic": expit}
_SMOOTH = {"tanh": "tanh", "logistic": "sigmoid"}
_ACCEPTED = "MLPClassifier or MLPRegressor, linear model, or Pipeline of scalers before one of these"
_ROUNDING = 1e-9  # of the size of a sum's terms
_LIMIT_BYTES = 2**26  # of a file's members
_TREE_REMEDY = (
    "a single decision tree is written where it was fitted, as a tree of otr: "
    'otr.save(otr.learners.from_sklearn_tree(tree), "tree.json")'
)
# What an MLP keeps of its training: numbers alone, and no method that loading would call. skops does not know them.
_TRUSTED = tuple(f"sklearn.neural_network._stochastic_optimizers.{name}" for name in ("AdamOptimizer", "SGDOptimizer"))


def policy_of_estimator(estimator: Any) -> Layered:
    """Return the network of a fitted estimator, units smooth or not; `otr.from_sklearn` documents it."""
    from sklearn.pipeline import Pipeline

    steps = [step for _, step in estimator.steps] if isinstance(estimator, Pipeline) else [estimator]
    *scalers, last = [step for step in steps if step not in (None, "passthrough")] or [None]
    n_inputs = getattr((scalers or [last])[0], "n_features_in_", None)
    if n_inputs is None:
        raise InvalidNetworkError(f"expected a fitted {_ACCEPTED}, got {estimator!r}; {_remedy(last)}")
    layers, head = _answer(last)
    steps = [*map(_scaled, scalers), *layers]
    smooth = _SMOOTH.get(getattr(last, "activation", ""), "") if len(layers) > 1 else ""
    read = steps[: len(scalers) + 1] if smooth else steps  # up to the first layer
    sections = Sections.of_steps([(f"{last!r}, step {k},", s) for k, s in enumerate(read)], n_inputs)
    policy: Layered = policy_of(sections, None if smooth else head)
    if smooth:
        weights, biases = _layers(last)
        weights, biases = [policy.weights[0], *weights[1:]], [policy.biases[0], *biases[1:]]
        policy = SmoothNetwork(weights, biases, activation=smooth, head=head)
    _require_same_answers(estimator, policy)
    return policy


def read_skops(path: Path) -> Any:
    """Return the estimator in a file of `skops.io.dump`, of types that skops trusts by itself and MLPs' optimizers.

    Raises:
        ArtefactError: the file is missing, cut off, or unpacks to more than 64 MiB.
        InvalidNetworkError: it holds another type, which is named; nothing of it was loaded.
        MissingExtraError: skops is not installed.
    """
    import skops.io

    try:
        for _ in read_members(path, str(path), limit_bytes=_LIMIT_BYTES):
            pass  # its size is known to be moderate
        content = path.read_bytes()
        untrusted = sorted(set(skops.io.get_untrusted_types(data=content)) - set(_TRUSTED))
        if not untrusted:
            return skops.io.loads(content, trusted=list(_TRUSTED))
    except FileNotFoundError as error:
        raise ArtefactError(f"{path} does not exist; give the path of a file that skops.io.dump wrote") from error
    except ArtefactError:
        raise
    except Exception as error:  # foreign files can fail in any way
        raise ArtefactError(f"{path} is no skops file that can be read ({error}); write it again") from error
    is_tree = any(name.startswith("sklearn.tree.") for name in untrusted)
    remedy = _TREE_REMEDY if is_tree else f"expected is a fitted {_ACCEPTED}"
    raise InvalidNetworkError(f"{path} holds {', '.join(untrusted[:3])}, which skops does not trust; {remedy}")


def _scaled(scaler: Any) -> Step:
    """Return what a transformer does that shifts and scales every feature."""
    from sklearn.preprocessing import MaxAbsScaler, MinMaxScaler, RobustScaler, StandardScaler

    if not isinstance(scaler, StandardScaler | MinMaxScaler | MaxAbsScaler | RobustScaler):
        raise InvalidNetworkError(
            f"the Pipeline has the step {scaler!r}; StandardScaler, MinMaxScaler, MaxAbsScaler and RobustScaler are "
            "folded into the first layer, others are not"
        )
    if getattr(scaler, "clip", False):
        raise InvalidNetworkError(f"{scaler!r} clips the states, which no layer does; fit it with clip=False")
    if isinstance(scaler, MinMaxScaler):
        return lambda z: z * scaler.scale_ + scaler.min_
    centre = scaler.mean_ if isinstance(scaler, StandardScaler) and scaler.with_mean else None
    centre = scaler.center_ if isinstance(scaler, RobustScaler) else centre
    return lambda z: (z - (0.0 if centre is None else centre)) / (1.0 if scaler.scale_ is None else scaler.scale_)


def _affine(W: Any, b: Any) -> Step:
    W, b = np.asarray(W, dtype=np.float64), np.asarray(b, dtype=np.float64)
    return lambda z: z @ W.T + b


def _answer(estimator: Any) -> tuple[list[Step], Head]:
    """Return the layers of an MLP or a linear model, and the head of its answer."""
    from sklearn.base import is_classifier
    from sklearn.neural_network import MLPClassifier, MLPRegressor

    if isinstance(estimator, MLPClassifier | MLPRegressor) and hasattr(estimator, "coefs_"):
        return _mlp(estimator), _mlp_head(estimator)
    if not (hasattr(estimator, "coef_") and hasattr(estimator, "intercept_")):
        raise InvalidNetworkError(f"expected a fitted {_ACCEPTED}, got {estimator!r}; {_remedy(estimator)}")
    try:
        W = np.atleast_2d(np.asarray(estimator.coef_, dtype=np.float64))
        layer = _affine(W, estimator.intercept_)
    except (TypeError, ValueError) as error:
        raise InvalidNetworkError(f"the coefficients of {estimator!r} are no matrix of numbers: {error}") from error
    if not is_classifier(estimator):
        return [layer], Identity()
    return [layer], Sign() if len(W) == 1 else Argmax()


def _remedy(estimator: Any) -> str:
    """Return what to do with an estimator that has no layers to be read."""
    from sklearn.exceptions import NotFittedError
    from sklearn.utils.validation import check_is_fitted

    if hasattr(estimator, "tree_"):
        return _TREE_REMEDY
    try:
        check_is_fitted(estimator)
    except NotFittedError:
        return "call fit first"
    except TypeError:
        return "it is no estimator"
    return "one of another kind cannot be read"


def _mlp(mlp: Any) -> list[Step]:
    if mlp.activation != "identity" and mlp.activation not in _UNITS:
        raise InvalidNetworkError(f"the activation is {mlp.activation!r}; fit with activation='relu'")
    between = [_UNITS[mlp.activation]] if mlp.activation != "identity" else []
    steps = [step for W, b in zip(*_layers(mlp), strict=True) for step in (_affine(W, b), *between)]
    return steps[: len(steps) - len(between)]


def _layers(mlp: Any) -> tuple[list[Any], list[Any]]:
    """Return the weights (n_out, n_in) and biases of an MLP."""
    weights, biases = [np.transpose(W) for W in mlp.coefs_], list(mlp.intercepts_)
    if len(getattr(mlp, "classes_", ())) == 1:  # which it predicts whatever its outputs are
        weights[-1], biases[-1] = np.zeros_like(weights[-1]), np.full_like(biases[-1], -1.0)
    return weights, biases


def _mlp_head(mlp: Any) -> Head:
    from sklearn.neural_network import MLPClassifier
    from sklearn.preprocessing import LabelBinarizer

    if isinstance(mlp, MLPClassifier):
        kind = mlp._label_binarizer.y_type_ if isinstance(mlp._label_binarizer, LabelBinarizer) else "unknown"
        if kind not in ("binary", "multiclass"):
            raise InvalidNetworkError(f"the labels are of type {kind!r}; fit one classifier for each label")
        return Sign() if kind == "binary" else Argmax()
    if mlp.out_activation_ != "identity":
        raise InvalidNetworkError(f"the output goes through {mlp.out_activation_!r}; fit with loss='squared_error'")
    return Identity()


def _require_same_answers(estimator: Any, policy: Layered) -> None:
    """Raise InvalidNetworkError where the estimator's predictions differ from the network's, beyond rounding."""
    states = probe_states(policy.n_inputs)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the states have no names
            expected = estimator.predict(states)
    except Exception as error:  # a foreign estimator can fail in any way
        raise InvalidNetworkError(f"{estimator!r} cannot predict {len(states)} fixed states: {error}") from error
    outputs = policy.forward(states)
    rounding = _ROUNDING * reach(policy, states).max(axis=1)
    if policy.head.gives_labels:
        gaps = np.abs(outputs[:, 0]) if outputs.shape[1] == 1 else np.ptp(np.sort(outputs, axis=1)[:, -2:], axis=1)
        if np.ndim(expected) != 1:
            raise InvalidNetworkError(
                f"{estimator!r} predicts several labels at once; fit one classifier for each label"
            )
        answers = np.asarray(estimator.classes_)[policy.predict(states)]
        differs = (answers != expected) & (gaps > rounding)
    else:
        expected = np.asarray(expected, dtype=np.float64).reshape(len(states), -1)
        differs = ~(np.abs(outputs - expected) <= rounding[:, None]).all(axis=1)
    if differs.any():
        i = int(np.argmax(differs))
        raise InvalidNetworkError(
            f"{estimator!r} predicts differently from its coefficients: {expected[i]} in state {states[i].tolist()}; a "
            "link function, or one classifier for each pair of classes, cannot be mapped"
        )
