"""The statistics of Stable-Baselines3's VecNormalize, read from its pickle without running anything in it."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.smooth_network import SmoothNetwork
from otr.errors import ArtefactError, InvalidNetworkError

Network = TypeVar("Network", ReluNetwork, SmoothNetwork)

_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
_LIMIT_BYTES = (
    2**24
)  # of a file that holds a few numbers for each input; what it makes takes sixty times as much memory


@dataclass(frozen=True)
class ObservationStatistics:
    """What a policy saw in place of the state x: clip((x - mean) / sqrt(variance + epsilon), -clip, clip).

    Attributes:
        mean, variance: (d,) each, of the states seen in training.
        epsilon: added to the variance.
        clip: of the normalised state, `clip_obs` in VecNormalize; infinite for none.
    """

    mean: FloatArray
    variance: FloatArray
    epsilon: float = 1e-8
    clip: float = 10.0


def fold_observation_statistics(network: Network, given: Any) -> Network:
    """Return the network on raw states; its domain is the box inside which nothing is clipped.

    `given` is the path of the file that `VecNormalize.save` wrote, a live VecNormalize, or `ObservationStatistics`.
    Raise ArtefactError if the file holds no VecNormalize, InvalidNetworkError if the statistics do not fit the network.
    """
    statistics = _statistics(given)
    if statistics is None:
        return network
    mean, variance = _numbers(statistics.mean).ravel(), _numbers(statistics.variance).ravel()
    if len(mean) != network.n_inputs or len(variance) != network.n_inputs:
        raise InvalidNetworkError(
            f"the statistics are of {len(mean)} means and {len(variance)} variances, the network has "
            f"{network.n_inputs} inputs; give the file that was saved with this model"
        )
    spread = variance + float(_numbers(statistics.epsilon))
    clip = float(_numbers(statistics.clip))
    if not (np.isfinite(mean).all() and np.isfinite(spread).all() and (spread > 0).all() and clip > 0):
        raise InvalidNetworkError(
            f"the statistics need finite means, variance + epsilon above 0 and clip_obs above 0; the smallest "
            f"variance + epsilon is {spread.min():g}, clip_obs is {clip:g}; is the file damaged?"
        )
    folded = network.fold_input_normalisation(mean, np.sqrt(spread))
    if np.isinf(clip):
        return folded
    try:
        box = Domain(mean - clip * np.sqrt(spread), mean + clip * np.sqrt(spread))
    except ValueError as error:
        raise InvalidNetworkError(f"clip_obs is {clip:g}, which gives no box of states: {error}") from error
    return folded.replace(domain=box)


def _statistics(given: Any) -> ObservationStatistics | None:
    """Return the statistics, or None where observations are not normalised."""
    if isinstance(given, ObservationStatistics):
        return given
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        record = _read(path)
        try:
            return _of_vec_normalize(record)
        except InvalidNetworkError:
            raise
        except Exception as error:  # a foreign record can hold anything
            raise ArtefactError(
                f"{path} holds no statistics of observations ({error!r}); save the VecNormalize again"
            ) from error
    if f"{type(given).__module__}.{type(given).__qualname__}" != _VEC_NORMALIZE:
        raise InvalidNetworkError(
            f"vec_normalize is a {type(given).__name__}, expected the path of a file that VecNormalize.save wrote, a "
            "VecNormalize or ObservationStatistics"
        )
    return _of_vec_normalize(given)


def _of_vec_normalize(found: Any) -> ObservationStatistics | None:
    """Return the statistics of a VecNormalize, live or as its file records it."""
    state = _state(found)
    if not state["norm_obs"]:
        return None
    if isinstance(state["obs_rms"], dict):
        raise InvalidNetworkError(
            f"the statistics are of the observations {list(state['obs_rms'])}; only a vector of inputs can be mapped"
        )
    moments = _state(state["obs_rms"])
    mean, variance = _numbers(moments["mean"]), _numbers(moments["var"])
    return ObservationStatistics(mean, variance, float(_numbers(state["epsilon"])), float(_numbers(state["clip_obs"])))


def _state(found: Any) -> dict[str, Any]:
    state = found.state if isinstance(found, _Record) else vars(found)
    if not isinstance(state, dict):
        raise TypeError(f"a state that is a {type(state).__name__}")
    return state


def _read(path: Path) -> _Record:
    """Return the record of the VecNormalize in a pickle."""
    try:
        n_bytes = path.stat().st_size
        if n_bytes > _LIMIT_BYTES:
            raise ArtefactError(f"{path} has {n_bytes:,} bytes, the limit is {_LIMIT_BYTES:,}; is it the right file?")
        content = path.read_bytes()
    except OSError as error:
        raise ArtefactError(f"{path} cannot be read ({error}); give a file that VecNormalize.save wrote") from error
    try:
        _refuse_traps(content)
        found = _Recorder(io.BytesIO(content)).load()
    except Exception as error:  # a foreign pickle can fail in any way
        raise ArtefactError(f"{path} is no pickle ({error!r}); give a file that VecNormalize.save wrote") from error
    name = found.name if isinstance(found, _Record) else type(found).__name__
    if not isinstance(found, _Record) or name != _VEC_NORMALIZE:
        raise ArtefactError(f"{path} holds a {name}, expected a {_VEC_NORMALIZE}; nothing of it was run")
    return found


class _Record:
    """Stands for whatever a pickle makes or calls: keeps of what, and does nothing."""

    name = ""

    def __new__(cls, *arguments: Any, **_: Any) -> _Record:
        record = super().__new__(cls)
        record.arguments, record.state = arguments, None
        return record

    arguments: tuple[Any, ...]
    state: Any

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def ignore(self, *_: Any) -> None:
        """Take an element, as a list, a set or a dictionary would."""

    append = extend = add = __setitem__ = ignore


class _Recorder(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_Record]:
        """Return a stand-in; nothing is looked up."""
        return type("_Record", (_Record,), {"name": f"{module}.{name}"})


def _refuse_traps(content: bytes) -> None:
    """Raise UnpicklingError for what no stand-in stops: registered extensions, and a memo that fills the memory."""
    for opcode, argument, _ in pickletools.genops(content):
        fills_memory = opcode.name.endswith("PUT") and int(argument or 0) > len(content)
        if fills_memory or opcode.name.startswith("EXT"):
            raise pickle.UnpicklingError(f"{opcode.name} {argument}")


def _numbers(value: Any) -> FloatArray:
    """Return numbers, live or recorded, as float64."""
    if not isinstance(value, _Record):
        given = np.asarray(value)
        if given.dtype.kind not in "fiu":
            raise InvalidNetworkError(f"the statistics hold {value!r}, expected real numbers")
        return given.astype(np.float64)
    shape: Any = ()
    order: Any = "C"
    name = value.name.replace("numpy._core", "numpy.core")  # renamed in NumPy 2
    if name == "numpy.core.multiarray._reconstruct":
        _, shape, dtype, is_fortran, content = value.state
        order = "F" if is_fortran else "C"
    elif name == "numpy.core.numeric._frombuffer":
        content, dtype, shape, order = value.arguments
    elif name == "numpy.core.multiarray.scalar":
        dtype, content = value.arguments
    else:
        raise TypeError(f"{value.name} in place of numbers")
    return np.frombuffer(_bytes(content), dtype=_number_type(dtype)).reshape(shape, order=order).astype(np.float64)


def _number_type(record: Any) -> np.dtype[Any]:
    code = record.arguments[0]
    if (
        record.name != "numpy.dtype"
        or not isinstance(code, str)
        or not re.fullmatch(r"[<>=|]?(f[248]|[iu][1248])", code)
    ):
        raise TypeError(f"numbers of the type {code!r}")
    return np.dtype(code).newbyteorder(record.state[1])


def _bytes(content: Any) -> bytes:
    """Return bytes, which pickles of protocol 2 keep as text."""
    if isinstance(content, _Record) and content.name == "_codecs.encode":
        text, encoding = content.arguments
        if encoding == "latin1":
            return str(text).encode("latin1")
    if not isinstance(content, bytes | bytearray):
        raise TypeError("numbers that are not made of bytes")
    return bytes(content)
