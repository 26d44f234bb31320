"""Statistics of observations next to a policy, by which its states were normalised: found, read, and folded in.

VecNormalize's are in a pickle, which is read without running it; others are numbers in JSON or npz.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.black_box import BlackBox
from otr.core.domain import Domain
from otr.core.network import ReluNetwork
from otr.core.smooth_network import Oracle
from otr.errors import ArtefactError, InvalidNetworkError
from otr.files.zip_members import read_members
from otr.importers.pickle_record import Record, numbers, record_of_pickle, truth
from otr.importers.sb3_archive import sign_of_normalisation, zip_path

_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
_LIMIT_BYTES = 2**24  # of a file with a few numbers for each input; what it makes takes sixty times as much memory
_NORMALIZE_OBSERVATION = "gymnasium.wrappers.stateful_observation.NormalizeObservation"
_EXPECTED = (
    "mean, epsilon, and var, of (x - mean) / sqrt(var + epsilon), or std, of (x - mean) / (std + epsilon); clip where "
    "the result was clipped"
)
STATISTICS = ("vecnormalize.pkl", "vec_normalize.pkl")  # rl-baselines3-zoo's: on disk, and on the Hugging Face Hub
AUTO = "auto"  # in place of statistics: those of the live model, or of the file next to a saved one


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
    """Return the file of statistics next to a saved model, and a note for the user.

    Looked for is ``vecnormalize.pkl``, or ``vec_normalize.pkl``, in the folder that is named as the zip is (where
    rl-baselines3-zoo saves it), and in the zip's own folder. Where there is none, the text says whether the model's
    file shows that one is missing; it is empty where nothing does.
    """
    model = zip_path(model)
    for file in (folder / name for folder in (model.with_suffix(""), model.parent) for name in STATISTICS):
        if file.is_file():
            return file, (
                f"{model} is read with the statistics of {file}, which is next to it: its network takes raw states; "
                "normalise=FILE names another file, normalise=None says that it was trained on raw states"
            )
    sign = sign_of_normalisation(model)
    if not sign:
        return None, ""
    return None, (
        f"{model} {sign}, so the network may expect normalised states, and no {STATISTICS[0]} is next to it; "
        "normalise=FILE names the file that VecNormalize.save wrote, normalise=None says that there is none"
    )


def is_auto(given: Any) -> bool:
    """Return whether statistics are to be found, and not given."""
    return isinstance(given, str) and given == AUTO


@overload
def fold_observation_statistics(network: ReluNetwork, given: Any) -> ReluNetwork: ...
@overload
def fold_observation_statistics(network: Oracle, given: Any) -> Oracle: ...
def fold_observation_statistics(network: Oracle, given: Any) -> Oracle:
    """Return the network on raw states; its domain is the box inside which nothing is clipped.

    Args:
        network: on normalised states; a BlackBox clips them as its statistics say, and has no domain.
        given: what `otr.read_policy` takes as `normalise`.

    Raises:
        ArtefactError: the file holds no statistics.
        InvalidNetworkError: they do not fit the network.
    """
    statistics = _statistics(given)
    if statistics is None:
        return network
    mean, variance = numbers(statistics.mean).ravel(), numbers(statistics.variance).ravel()
    if len(mean) != network.n_inputs or len(variance) != network.n_inputs:
        where = f" in {given}" if isinstance(given, str | os.PathLike) else ""
        raise InvalidNetworkError(
            f"the statistics{where} are of {len(mean)} means and {len(variance)} variances, the network has "
            f"{network.n_inputs} inputs; give those that were saved with this model, or normalise=None"
        )
    spread = variance + float(numbers(statistics.epsilon))
    clip = float(numbers(statistics.clip))
    if not (np.isfinite(mean).all() and np.isfinite(spread).all() and (spread > 0).all() and clip > 0):
        raise InvalidNetworkError(
            f"the statistics need finite means, variance + epsilon above 0 and a clip above 0; the smallest "
            f"variance + epsilon is {spread.min():g}, the clip is {clip:g}; is the file damaged?"
        )
    if isinstance(network, BlackBox):
        return network.fold_input_normalisation(mean, np.sqrt(spread), clip)
    folded = network.fold_input_normalisation(mean, np.sqrt(spread))
    if np.isinf(clip):
        return folded
    try:
        box = Domain(mean - clip * np.sqrt(spread), mean + clip * np.sqrt(spread))
    except ValueError as error:
        raise InvalidNetworkError(f"the clip is {clip:g}, which gives no box of states: {error}") from error
    return folded.replace(domain=box)


def _statistics(given: Any) -> ObservationStatistics | None:
    """Return the statistics, or None where observations are not normalised."""
    if isinstance(given, ObservationStatistics):
        return given
    if isinstance(given, Mapping):
        return _of_numbers(given, "normalise")
    if isinstance(given, str | os.PathLike):
        path = Path(given)
        if path.suffix in _READERS:
            return _of_numbers(_READERS[path.suffix](_content(path), str(path)), str(path))
        record = _read(path)
        try:
            return _of_vec_normalize(record)
        except InvalidNetworkError:
            raise
        except Exception as error:  # a foreign record can hold anything
            raise ArtefactError(
                f"{path} holds no statistics of observations ({error!r}); save the VecNormalize again"
            ) from error
    kind = f"{type(given).__module__}.{type(given).__qualname__}"
    if kind == _NORMALIZE_OBSERVATION:
        return ObservationStatistics(given.obs_rms.mean, given.obs_rms.var, given.epsilon, np.inf)
    if kind != _VEC_NORMALIZE:
        raise InvalidNetworkError(
            f"normalise is a {type(given).__name__}, expected the path of a file (.pkl that VecNormalize.save wrote, "
            f".json or .npz with {_EXPECTED}), a dictionary of these, a VecNormalize or a NormalizeObservation"
        )
    return _of_vec_normalize(given)


def _of_numbers(found: Any, where: str) -> ObservationStatistics:
    """Return the statistics in a dictionary, or raise InvalidNetworkError, which names what is missing."""
    names = {"variance": "var", "eps": "epsilon"}
    values = {names.get(str(name), str(name)): value for name, value in dict(found).items()}
    unknown = sorted(values.keys() - {"mean", "var", "std", "epsilon", "clip", "count"})
    if unknown or not {"mean", "epsilon"} <= values.keys() or ("var" in values) == ("std" in values):
        raise InvalidNetworkError(f"{where} has {', '.join(map(repr, found)) or 'nothing'}, expected {_EXPECTED}")
    try:
        mean, epsilon = numbers(values["mean"]).ravel(), float(numbers(values["epsilon"]))
        spread = numbers(values["var" if "var" in values else "std"]).ravel()
        clip = float(numbers(values.get("clip", np.inf)))
    except (TypeError, ValueError) as error:
        raise InvalidNetworkError(f"{where}: {error}; expected {_EXPECTED}, all of them real numbers") from error
    if "std" in values:
        return ObservationStatistics(mean, (spread + epsilon) ** 2, 0.0, clip)
    return ObservationStatistics(mean, spread, epsilon, clip)


def _of_json(content: bytes, label: str) -> dict[str, Any]:
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ArtefactError(f"{label} is no JSON ({error}); write {_EXPECTED} into it") from error
    return found if isinstance(found, dict) else {}


def _of_npz(content: bytes, label: str) -> dict[str, Any]:
    members = dict(read_members(io.BytesIO(content), label, limit_bytes=_LIMIT_BYTES))
    try:
        return {
            name.removesuffix(".npy"): np.load(io.BytesIO(member), allow_pickle=False)
            for name, member in members.items()
        }
    except (ValueError, EOFError) as error:
        raise ArtefactError(f"{label} holds no arrays of numbers ({error}); write it by numpy.savez") from error


_READERS = {".json": _of_json, ".npz": _of_npz}


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


def _content(path: Path) -> bytes:
    try:
        n_bytes = path.stat().st_size
        if n_bytes > _LIMIT_BYTES:
            raise ArtefactError(f"{path} has {n_bytes:,} bytes, the limit is {_LIMIT_BYTES:,}; is it the right file?")
        return path.read_bytes()
    except OSError as error:
        raise ArtefactError(f"{path} cannot be read ({error}); give a file that VecNormalize.save wrote") from error


def _read(path: Path) -> Record:
    """Return the record of the VecNormalize in a pickle."""
    content = _content(path)
    try:
        found = record_of_pickle(content)
    except Exception as error:  # a foreign pickle can fail in any way
        raise ArtefactError(f"{path} is no pickle ({error!r}); give a file that VecNormalize.save wrote") from error
    name = found.name if isinstance(found, Record) else type(found).__name__
    if not isinstance(found, Record) or name != _VEC_NORMALIZE:
        raise ArtefactError(f"{path} holds a {name}, expected a {_VEC_NORMALIZE}; nothing of it was run")
    return found
