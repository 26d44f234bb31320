"""The statistics of Stable-Baselines3's VecNormalize: found beside a model, and read without running their pickle."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.smooth_network import SmoothNetwork
from otr.errors import ArtefactError, InvalidNetworkError
from otr.importers.pickle_record import Record, numbers, record_of_pickle, truth
from otr.importers.sb3_archive import sign_of_normalisation, zip_path

Network = TypeVar("Network", ReluNetwork, SmoothNetwork)

_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
_LIMIT_BYTES = 2**24  # of a file with a few numbers for each input; what it makes takes sixty times as much memory
_FILE = "vecnormalize.pkl"  # as rl-baselines3-zoo names it
AUTO = "auto"  # in place of statistics: those of the live model, or of the file that lies beside a saved one


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


def find_statistics(model: Path) -> tuple[Path | None, str]:
    """Return the file of statistics that lies beside a saved model, and what a user has to know of it.

    Looked for is ``vecnormalize.pkl`` in the folder that is named as the zip is (where rl-baselines3-zoo saves it), and
    in the zip's own folder. Where there is none, the text says whether the model's file shows that one is missing; it
    is empty where nothing does.
    """
    model = zip_path(model)
    for file in (model.with_suffix("") / _FILE, model.with_name(_FILE)):
        if file.is_file():
            return file, (
                f"{model} is read with the statistics of {file}, which lies beside it: its network takes raw states; "
                "vec_normalize=FILE names another file, vec_normalize=None says that it was trained on raw states"
            )
    sign = sign_of_normalisation(model)
    if not sign:
        return None, ""
    return None, (
        f"{model} {sign}, so the network may expect normalised states, and no {_FILE} lies beside it; "
        "vec_normalize=FILE names the file that VecNormalize.save wrote, vec_normalize=None says that there is none"
    )


def is_auto(given: Any) -> bool:
    """Return whether statistics are to be found, and not given."""
    return isinstance(given, str) and given == AUTO


def fold_observation_statistics(network: Network, given: Any) -> Network:
    """Return the network on raw states; its domain is the box inside which nothing is clipped.

    `given` is the path of the file that `VecNormalize.save` wrote, a live VecNormalize, or `ObservationStatistics`.
    Raise ArtefactError if the file holds no VecNormalize, InvalidNetworkError if the statistics do not fit the network.
    """
    statistics = _statistics(given)
    if statistics is None:
        return network
    mean, variance = numbers(statistics.mean).ravel(), numbers(statistics.variance).ravel()
    if len(mean) != network.n_inputs or len(variance) != network.n_inputs:
        where = f" in {given}" if isinstance(given, str | os.PathLike) else ""
        raise InvalidNetworkError(
            f"the statistics{where} are of {len(mean)} means and {len(variance)} variances, the network has "
            f"{network.n_inputs} inputs; give those that were saved with this model, or vec_normalize=None"
        )
    spread = variance + float(numbers(statistics.epsilon))
    clip = float(numbers(statistics.clip))
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
    if not truth(state["norm_obs"]):
        return None
    if isinstance(state["obs_rms"], dict):
        raise InvalidNetworkError(
            f"the statistics are of the observations {list(state['obs_rms'])}; only a vector of inputs can be mapped"
        )
    moments = _state(state["obs_rms"])
    mean, variance = numbers(moments["mean"]), numbers(moments["var"])
    return ObservationStatistics(mean, variance, float(numbers(state["epsilon"])), float(numbers(state["clip_obs"])))


def _state(found: Any) -> dict[str, Any]:
    state = found.state if isinstance(found, Record) else vars(found)
    if not isinstance(state, dict):
        raise TypeError(f"a state that is a {type(state).__name__}")
    return state


def _read(path: Path) -> Record:
    """Return the record of the VecNormalize in a pickle."""
    try:
        n_bytes = path.stat().st_size
        if n_bytes > _LIMIT_BYTES:
            raise ArtefactError(f"{path} has {n_bytes:,} bytes, the limit is {_LIMIT_BYTES:,}; is it the right file?")
        content = path.read_bytes()
    except OSError as error:
        raise ArtefactError(f"{path} cannot be read ({error}); give a file that VecNormalize.save wrote") from error
    try:
        found = record_of_pickle(content)
    except Exception as error:  # a foreign pickle can fail in any way
        raise ArtefactError(f"{path} is no pickle ({error!r}); give a file that VecNormalize.save wrote") from error
    name = found.name if isinstance(found, Record) else type(found).__name__
    if not isinstance(found, Record) or name != _VEC_NORMALIZE:
        raise ArtefactError(f"{path} holds a {name}, expected a {_VEC_NORMALIZE}; nothing of it was run")
    return found
