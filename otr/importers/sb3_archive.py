"""The actor in a Stable-Baselines3 zip file, read without running anything that the file contains.

Such a file holds `policy.pth`, tensors that torch can load with ``weights_only=True``, and `data`, JSON in which Python
objects appear as a pickle (":serialized:") with a readable account of themselves. That account rounds the action box,
as numpy printed it when the file was written; the box's numbers are taken from the pickle, of which nothing is run.
"""

from __future__ import annotations

import base64
import io
import json
import math
import pickle
import re
import warnings
import zipfile
from pathlib import Path
from typing import IO, Any, NamedTuple

from numpy.typing import ArrayLike

from otr.core.arrays import FloatArray
from otr.core.head import Head
from otr.core.heads import Argmax, ClipBox, TanhBox
from otr.core.network import ReluNetwork
from otr.core.smooth_network import ACTIVATIONS, SmoothNetwork
from otr.errors import ArtefactError, InvalidNetworkError
from otr.files.zip_members import read_members
from otr.importers.assembly import RELU_REMEDY, TRAIN_RELU
from otr.importers.pickle_record import numbers, record_of_pickle
from otr.importers.sb3_layers import Tensors, actor_layers, has_limited_mean, is_on_policy, is_searched

_RELU = "<class 'torch.nn.modules.activation.ReLU'>"
_TANH = "<class 'torch.nn.modules.activation.Tanh'>"
_LEAKY_RELU = "<class 'torch.nn.modules.activation.LeakyReLU'>"
_SLOPES = {_RELU: 0.0, _LEAKY_RELU: 0.01}  # of LeakyReLU torch's default

_PARTS = ("mlp_extractor.shared_net.", "mlp_extractor.policy_net.", "mlp_extractor.value_net.", "action_net.",
          "value_net.", "log_std", "actor.latent_pi.", "actor.mu.", "actor.log_std", "actor_target.", "critic.",
          "critic_target.", "q_net.q_net.", "q_net_target.", "quantile_net.quantile_net.",
          "quantile_net_target.")  # fmt: skip
_MODULES = r"stable_baselines3\.(common|dqn|sac|td3)|sb3_contrib\.(ars|common\.maskable|crossq|qrdqn|tqc)"
# Observations that Stable-Baselines3 makes one vector of as gymnasium's FlattenObservation does, labels as 0 and 1 each
_FLATTENED = r"dict\.Dict|discrete\.Discrete|multi_discrete\.MultiDiscrete|multi_binary\.MultiBinary"
_GSDE_MEAN_LIMIT = 2.0  # the default of SAC's and TQC's clip_mean
_DATA_BYTES = 2**24  # of text; its lists and dictionaries take twenty times as much memory


class _Actor(NamedTuple):
    """What the file has of the actor, except its activation."""

    weights: list[FloatArray]
    biases: list[FloatArray]
    head: Head
    data: dict[str, Any]
    usual_units: str  # the activation by default


def network_of_file(
    file: Path | IO[bytes], action_low: ArrayLike | None, action_high: ArrayLike | None, negative_slope: float | None
) -> ReluNetwork:
    """Return the actor in a zip file; `otr.from_sb3` documents arguments and errors."""
    actor = _actor(file, action_low, action_high)
    slope = _slope(actor, negative_slope) if len(actor.weights) > 1 else 0.0
    return ReluNetwork(actor.weights, actor.biases, negative_slope=slope, head=actor.head)


def oracle_of_file(path: Path) -> ReluNetwork | SmoothNetwork:
    """Return the actor in the zip file at `path`; `otr.importers.read_policy` documents it."""
    actor = _actor(path, None, None)
    smooth = _smooth(actor) if len(actor.weights) > 1 else ""
    if not smooth:
        slope = _slope(actor, None) if len(actor.weights) > 1 else 0.0
        return ReluNetwork(actor.weights, actor.biases, negative_slope=slope, head=actor.head)
    return SmoothNetwork(actor.weights, actor.biases, activation=smooth, head=actor.head)


def zip_path(path: Path) -> Path:
    """Return the path of a saved model, whose suffix may be left out, also where a folder has that name."""
    return path if path.is_file() or path.suffix == ".zip" else path.with_name(f"{path.name}.zip")


def sign_of_normalisation(path: Path) -> str:
    """Return what in a saved model shows that it was trained under VecNormalize; empty where nothing does.

    Training keeps the last observation as the policy saw it, and PPO and A2C the first as the environment gave it,
    under VecNormalize alone. SAC and its kin keep the latter in any case.
    """
    try:
        data = json.loads(dict(read_members(path, str(path), ["data"], limit_bytes=_DATA_BYTES))["data"])
        if "gae_lambda" in data and data.get("_last_original_obs") is not None:
            return "was trained under VecNormalize"
        seen = numbers(record_of_pickle(base64.b64decode(data["_last_obs"][":serialized:"])))
        box = record_of_pickle(base64.b64decode(data["observation_space"][":serialized:"]))
        low, high = (numbers(box.state[name]) for name in ("low", "high"))
        margin = 1e-3 * (high - low)  # more than rounding
        outside = (seen < low - margin) | (seen > high + margin)
    except Exception:  # a foreign file can hold anything; the reader of its policy reports the error
        return ""
    return f"has seen {seen[outside][0]:g}, outside the range of its observations" if outside.any() else ""


def _actor(file: Path | IO[bytes], action_low: ArrayLike | None, action_high: ArrayLike | None) -> _Actor:
    tensors, data = read_archive(file)
    _refuse_other_policies(tensors, data)
    _refuse_other_actions(data)
    n_actions = _count(data, "action_space")
    mean_limit = float(_readable(data, "policy_kwargs").get("clip_mean", _GSDE_MEAN_LIMIT))
    weights, biases = actor_layers(tensors, n_actions, mean_limit)
    usual_units = _TANH if is_on_policy(tensors) else _RELU
    units = str(_readable(data, "policy_kwargs").get("activation_fn", usual_units))
    if has_limited_mean(tensors) and mean_limit > 0 and units != _RELU:
        raise InvalidNetworkError(
            f"gSDE clips the mean of the actions at {mean_limit:g}, which ReLU units can do, and {units} cannot; "
            "train with use_sde=False"
        )
    n_inputs = weights[0].shape[1]
    is_flattened = re.search(_FLATTENED, str(_readable(data, "observation_space").get(":type:"))) is not None
    n_observed = n_inputs if is_flattened else _count(data, "observation_space")
    _require_widths(n_inputs, len(biases[-1]), n_observed, n_actions)
    head = _head(data, _is_squashed(tensors, data), n_actions, action_low, action_high)
    return _Actor(weights, biases, head, data, usual_units)


def _refuse_other_actions(data: dict[str, Any]) -> None:
    """Raise InvalidNetworkError unless the actions are a Box or Discrete, whose labels count from 0 here."""
    kind = str(_readable(data, "action_space").get(":type:"))
    if "spaces.discrete.Discrete" not in kind and "spaces.box.Box" not in kind:
        raise InvalidNetworkError(
            f"the actions are {kind}; only Box and Discrete can be mapped: train with one label for every combination "
            "of actions, which a gymnasium.ActionWrapper splits (numpy.unravel_index)"
        )


def _is_squashed(tensors: Tensors, data: dict[str, Any]) -> bool:
    """Return whether tanh leads the actions into their box, and no clip."""
    usual = not is_on_policy(tensors)
    if is_searched(tensors):  # ARS's MlpPolicy squashes, its LinearPolicy does not
        usual = "ARSLinearPolicy.__init__" not in str(_readable(data, "policy_class").get("__init__"))
    return bool(_readable(data, "policy_kwargs").get("squash_output", usual))


def _require_widths(n_inputs: int, n_outputs: int, n_observed: int, n_actions: int) -> None:
    """Raise InvalidNetworkError unless an actor is as wide as the model's observations and actions."""
    if n_inputs != n_observed:
        raise InvalidNetworkError(
            f"the actor reads {n_inputs} inputs, the observation space has {n_observed} numbers; "
            "the model does not fit its own spaces: save it again, or train it on this environment"
        )
    if n_outputs != n_actions:
        raise InvalidNetworkError(
            f"the actor has {n_outputs} outputs, the action space has {n_actions} actions; "
            "the model does not fit its own spaces: save it again, or train it on this environment"
        )


def read_archive(file: Path | IO[bytes]) -> tuple[Tensors, dict[str, Any]]:
    """Return the tensors of `policy.pth` by name, and the JSON of `data`."""
    file = zip_path(file) if isinstance(file, Path) else file
    path = str(file) if isinstance(file, Path) else "the model"
    try:
        members = dict(read_members(file, path, ["data"], limit_bytes=_DATA_BYTES))
        members |= read_members(file, path, ["policy.pth"])
        data = json.loads(members["data"])
    except FileNotFoundError as error:
        raise ArtefactError(f"{path} does not exist; give the path of a saved Stable-Baselines3 model") from error
    except (ValueError, RecursionError) as error:
        raise ArtefactError(f"{path} cannot be read: data is no JSON ({error}); save the model again") from error
    tensors = load_tensors(members["policy.pth"], f"policy.pth in {path}")
    if not isinstance(data, dict):
        raise ArtefactError(f"{path} is no saved Stable-Baselines3 model: data is no dictionary")
    return tensors, data


def load_tensors(content: bytes, label: str, *, is_nested: bool = False) -> Tensors:
    """Return what torch saved, which is a zip file itself, without running anything in it.

    Of dictionaries in dictionaries, where `is_nested`, the tensors come back with the keys joined by dots.
    """
    import torch

    if content.startswith(b"PK"):
        # Written again, so that torch unpacks the members that were checked, and no others.
        checked = io.BytesIO()
        with zipfile.ZipFile(checked, "w") as archive:
            for name, member in read_members(io.BytesIO(content), label):
                archive.writestr(name, member)
        content = checked.getvalue()
    try:
        tensors = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL (\S+)", str(error))
        reason = f"it names {found[1]}" if found else str(error).strip()[:200]
        raise ArtefactError(f"{label} holds more than tensors, and was not loaded: {reason}") from error
    except Exception as error:  # torch can fail in any way on what it did not write
        raise ArtefactError(f"{label} cannot be read ({error}); save the model again") from error
    tensors = _tensors_in(tensors, "") if is_nested and isinstance(tensors, dict) else tensors
    if not isinstance(tensors, dict) or not all(isinstance(k, str) and torch.is_tensor(v) for k, v in tensors.items()):
        raise ArtefactError(f"{label} is no dictionary of tensors by name; give a saved Stable-Baselines3 model")
    return tensors


def _tensors_in(value: Any, name: str) -> Tensors:
    import torch

    if torch.is_tensor(value):
        return {name: value}
    found: Tensors = {}
    for key, inner in value.items() if isinstance(value, dict) else ():
        found |= _tensors_in(inner, f"{name}.{key}" if name else str(key))
    return found


def _refuse_other_policies(tensors: Tensors, data: dict[str, Any]) -> None:
    """Raise InvalidNetworkError unless the policy is an MlpPolicy on a vector, as far as the file shows.

    Of MaskablePPO a warning says that the masks are left out.
    """
    others = sorted(name for name in tensors if not name.startswith(_PARTS))
    if others:
        raise InvalidNetworkError(
            f"the policy has the tensor {others[0]!r}; only 'MlpPolicy' of PPO, A2C, TRPO, DQN, SAC, TD3, DDPG, TQC, "
            "QR-DQN, CrossQ, MaskablePPO and ARS, and ARS's 'LinearPolicy', without weights in a feature extractor, "
            "can be mapped"
        )
    module = _readable(data, "policy_class").get("__module__", "")
    if not re.fullmatch(rf"({_MODULES})\.policies", str(module)):
        raise InvalidNetworkError(
            f"the policy's class is from {module!r}; train with 'MlpPolicy', or ARS with 'LinearPolicy'"
        )
    extractor = str(_readable(data, "policy_kwargs").get("features_extractor_class", "FlattenExtractor"))
    if "stable_baselines3.common.torch_layers.FlattenExtractor" not in extractor and extractor != "FlattenExtractor":
        raise InvalidNetworkError(f"the policy has the feature extractor {extractor}; leave it at FlattenExtractor")
    space = _readable(data, "observation_space")
    kind, shape = str(space.get(":type:")), space.get("_shape") or ()
    if not re.search(rf"spaces\.({_FLATTENED}|box\.Box)", kind) or len(shape) > 2:
        shown = f"{kind} of shape {tuple(shape)}" if shape else kind
        raise InvalidNetworkError(f"the observations are {shown}; only what is flattened to a vector can be mapped")
    if "maskable" in str(module):
        note = "the policy was trained with action masks; it is read without: it may choose what a mask would forbid"
        warnings.warn(note, stacklevel=4)


def _activation(actor: _Actor) -> str:
    """Return the name of the activation's class, from the readable account of `policy_kwargs`."""
    if not isinstance(actor.data.get("policy_kwargs"), dict):
        raise InvalidNetworkError("the file does not give the policy's arguments, so not the activation; save it again")
    return str(_readable(actor.data, "policy_kwargs").get("activation_fn", actor.usual_units))


def readable_slope(data: dict[str, Any]) -> float | None:
    """Return the activation's negative slope in an off-policy model's `data`; None where it is no (leaky) ReLU's."""
    activation = str(_readable(data, "policy_kwargs").get("activation_fn", _RELU))
    return _SLOPES.get(activation)


def _smooth(actor: _Actor) -> str:
    """Return the name in ACTIVATIONS of the activation; empty where it is none of them."""
    found = re.fullmatch(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>", _activation(actor))
    return found[1].lower() if found and found[1].lower() in ACTIVATIONS else ""


def _slope(actor: _Actor, given: float | None) -> float:
    """Return the activation's negative slope."""
    activation = _activation(actor)
    known = _SLOPES.get(activation)
    if known is None and not (given is not None and "LeakyReLU" in activation):
        remedy = RELU_REMEDY if _smooth(actor) else f"{TRAIN_RELU}; or read the policy from its export (ONNX, .pt2)"
        if "LeakyReLU" in activation:
            remedy = "for this LeakyReLU, give negative_slope= to otr.from_sb3"
        raise InvalidNetworkError(f"the activation is {activation}; {remedy}")
    if known is not None and given is not None and known != given:
        raise InvalidNetworkError(f"negative_slope is {given}, the file says {activation}, whose slope is {known}")
    return float(known if known is not None else given)  # type: ignore[arg-type]


def _head(data: dict[str, Any], squashed: bool, n_outputs: int, low: ArrayLike | None, high: ArrayLike | None) -> Head:
    """Return the head that the readable account of the action space asks for."""
    space = _readable(data, "action_space")
    if "spaces.discrete.Discrete" in str(space.get(":type:")):
        return Argmax()
    low = _limits(data, "low", n_outputs) if low is None else low
    high = _limits(data, "high", n_outputs) if high is None else high
    try:
        return TanhBox(low, high) if squashed else ClipBox(low, high)
    except ValueError as error:
        raise InvalidNetworkError(f"the actions' limits: {error}; give action_low= and action_high=") from error


def _count(data: dict[str, Any], name: str) -> int:
    """Return how many numbers a state has, or how many actions there are."""
    space = _readable(data, name)
    size = space["n"] if "n" in space else space.get("_shape", space.get("shape"))
    try:
        return math.prod(map(int, size)) if isinstance(size, list) else int(str(size))
    except (TypeError, ValueError) as error:
        raise InvalidNetworkError(
            f"the file does not give the size of the {name} (it reads {size!r}); load the model with "
            "Stable-Baselines3 and give it in place of the path"
        ) from error


def _limits(data: dict[str, Any], name: str, n_outputs: int) -> FloatArray:
    """Return the action limits in the pickle of the action space, (n_outputs,)."""
    try:
        box = record_of_pickle(base64.b64decode(data["action_space"][":serialized:"]))
        limits = numbers(box.state[name]).ravel()
    except Exception as error:  # a foreign pickle can hold anything
        raise InvalidNetworkError(
            f"the file does not give the actions' {name} ({error!r}); give action_{name}="
        ) from error
    if limits.shape != (n_outputs,):
        raise InvalidNetworkError(
            f"the action space's {name} has {len(limits)} numbers, expected {n_outputs}; give action_{name}="
        )
    return limits


def _readable(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the readable account of an object in `data`, without its pickle."""
    account = data.get(name)
    return {key: value for key, value in account.items() if key != ":serialized:"} if isinstance(account, dict) else {}
