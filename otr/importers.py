"""Networks from torch, Stable-Baselines3 and scikit-learn, which are imported only when they are asked for."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from otr.arrays import FloatArray
from otr.errors import InvalidNetworkError
from otr.head import Argmax, ClipBox, Head, Identity, Sign, TanhBox
from otr.network import ReluNetwork
from otr.sb3_archive import read_actor

if TYPE_CHECKING:
    import torch

__all__ = ["from_sb3", "from_sklearn", "from_torch"]


def from_torch(module: torch.nn.Module, *, head: Head | None = None) -> ReluNetwork:
    """Return the network of a `torch.nn.Sequential` of Linear, ReLU and LeakyReLU layers.

    Nested Sequentials are opened; Flatten, Identity and Dropout are skipped, as they do nothing to a vector at
    inference. Linear layers without an activation between them are multiplied. A last Tanh becomes the head
    `TanhBox(-1, 1)`; a last Sigmoid needs ``head=otr.Sign()`` and a last Softmax ``head=otr.Argmax()``, since the tree
    answers with the label and not the probability.

    Args:
        module: the layers; parameters of any float type, on any device.
        head: from the outputs to the answer; None for Identity, or TanhBox after a last Tanh.

    Raises:
        InvalidNetworkError: a layer of another kind, named with its position, or activations of several slopes.
    """
    import torch

    layers = list(_flat(module, "module"))
    if layers and head is None and isinstance(layers[-1][1], torch.nn.Tanh):
        layers.pop()
        head = TanhBox(-1.0, 1.0)
    elif layers and _is_decided_by(layers[-1][1], head):
        layers.pop()
    return _network_of_layers(layers, head)


def from_sb3(
    model: Any,
    *,
    action_low: ArrayLike | None = None,
    action_high: ArrayLike | None = None,
    negative_slope: float | None = None,
) -> ReluNetwork:
    """Return the deterministic actor of a Stable-Baselines3 model, or of sb3-contrib's TRPO and ARS.

    SAC, TD3 and DDPG end in `TanhBox`, the others in `ClipBox` or, with discrete actions, `Argmax`; DQN's actor is the
    network of its action values, and of ARS `LinearPolicy` without squashed outputs is read. Stable-Baselines3 computes
    in float32, so its answers differ from the network's by about 1e-7 of the action box. A model trained under
    VecNormalize expects normalised states: `ReluNetwork.fold_input_normalisation` takes that in.

    From the path of a saved model, only tensors (torch's ``weights_only`` loading) and plain text are read, and no
    code in the file is run. That text prints the action box to eight decimals.

    Args:
        model: a live model, or the path of the zip file that `model.save` wrote, with or without ".zip".
        action_low, action_high: (o,) limits of the action box in place of the model's.
        negative_slope: of LeakyReLU, for a file that does not tell; must agree with what can be known.

    Raises:
        InvalidNetworkError: a policy that is no ReLU network on a vector of inputs: other activations, gSDE, images,
            feature extractors, dictionaries, several discrete actions; or something that the file does not tell.
        ArtefactError: the file is missing, cut off, or holds more than tensors in its `policy.pth`.
    """
    if isinstance(model, str | os.PathLike):
        actor = read_actor(model, action_low=action_low, action_high=action_high, negative_slope=negative_slope)
        return ReluNetwork(actor.weights, actor.biases, negative_slope=actor.negative_slope, head=actor.head)
    network = _network_of_layers(_sb3_layers(model), _sb3_head(model, action_low, action_high))
    if negative_slope is not None and network.n_hidden and network.negative_slope != negative_slope:
        raise InvalidNetworkError(f"negative_slope is {negative_slope}, the model's is {network.negative_slope}")
    return network


def from_sklearn(mlp: Any) -> ReluNetwork:
    """Return the network of a fitted scikit-learn `MLPClassifier` or `MLPRegressor`.

    A binary classifier gets the head `Sign`, one of several classes `Argmax`; labels are positions in
    ``mlp.classes_``. With activation "identity" the layers are multiplied into a linear model.

    Raises:
        InvalidNetworkError: not fitted, another activation, several labels at once, or a loss with a link function.
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


def _flat(module: Any, name: str) -> Iterable[tuple[str, Any]]:
    """Yield (position, layer) of nested Sequentials in order, without the layers that do nothing at inference."""
    import torch

    if isinstance(module, torch.nn.Sequential):
        for position, child in module.named_children():
            yield from _flat(child, f"{name}[{position}]")
    elif not isinstance(module, torch.nn.Flatten | torch.nn.Identity | torch.nn.Dropout):
        yield name, module


def _is_decided_by(layer: Any, head: Head | None) -> bool:
    """Return whether `head` answers the same before this last layer as after it."""
    import torch

    if isinstance(head, Sign):
        return isinstance(layer, torch.nn.Sigmoid)
    return isinstance(head, Argmax) and isinstance(layer, torch.nn.Softmax | torch.nn.LogSoftmax)


def _network_of_layers(layers: Iterable[tuple[str, Any]], head: Head | None) -> ReluNetwork:
    """Return the network of (position, layer) pairs: Linear, ReLU and LeakyReLU."""
    import torch

    weights: list[FloatArray] = []
    biases: list[FloatArray] = []
    slopes: set[float] = set()
    after_activation = True
    for position, layer in layers:
        if type(layer) is torch.nn.Linear:
            W = layer.weight.detach().cpu().double().numpy()
            b = np.zeros(len(W)) if layer.bias is None else layer.bias.detach().cpu().double().numpy()
            if after_activation:
                weights.append(W)
                biases.append(b)
            else:
                weights[-1], biases[-1] = W @ weights[-1], W @ biases[-1] + b
        elif type(layer) in (torch.nn.ReLU, torch.nn.LeakyReLU):
            if after_activation:
                raise InvalidNetworkError(f"{position} is {layer}, which follows no Linear layer; put one before it")
            slopes.add(float(getattr(layer, "negative_slope", 0.0)))
        else:
            raise InvalidNetworkError(f"{position} is {layer}; {_remedy(layer)}")
        after_activation = type(layer) is not torch.nn.Linear
    if not weights:
        raise InvalidNetworkError("there is no Linear layer; give a Sequential of Linear, ReLU and LeakyReLU layers")
    if len(slopes) > 1:
        raise InvalidNetworkError(f"activations have the slopes {sorted(slopes)} below zero; one network has one slope")
    if after_activation:  # the activation's output is the answer: one more layer that passes it on
        weights.append(np.eye(len(biases[-1])))
        biases.append(np.zeros(len(biases[-1])))
    return ReluNetwork(weights, biases, negative_slope=slopes.pop() if slopes else 0.0, head=head)


def _remedy(layer: Any) -> str:
    import torch

    if isinstance(layer, torch.nn.Sigmoid):
        return "as the last layer it needs head=otr.Sign() (label 1 where its input is above zero)"
    if isinstance(layer, torch.nn.Softmax | torch.nn.LogSoftmax):
        return "as the last layer it needs head=otr.Argmax() (the label with the largest input)"
    if isinstance(layer, torch.nn.Tanh):
        return "a tree needs ReLU or LeakyReLU; train with activation_fn=nn.ReLU"
    return "only Linear, ReLU and LeakyReLU layers can be mapped to a tree"


def _sb3_layers(model: Any) -> list[tuple[str, Any]]:
    """Return the (position, layer) pairs of a live model's deterministic actor."""
    from sb3_contrib import ARS, TRPO
    from sb3_contrib.ars.policies import ARSLinearPolicy
    from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from stable_baselines3.dqn.policies import DQNPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    if not isinstance(model, A2C | ARS | DQN | PPO | SAC | TD3 | TRPO):  # DDPG is a TD3
        raise InvalidNetworkError(
            f"expected a PPO, A2C, TRPO, ARS, DQN, SAC, TD3 or DDPG model or a path, got {type(model).__name__}"
        )
    policy: Any = model.policy
    if type(policy) not in (ActorCriticPolicy, ARSLinearPolicy, DQNPolicy, SACPolicy, TD3Policy):
        expected = "LinearPolicy" if isinstance(model, ARS) else "MlpPolicy"
        raise InvalidNetworkError(f"the policy is a {type(policy).__name__}; train with '{expected}'")
    if type(policy) is ARSLinearPolicy and policy.squash_output:
        raise InvalidNetworkError("the policy squashes its outputs; train with squash_output=False")
    if getattr(model, "use_sde", False):
        raise InvalidNetworkError("the model uses gSDE; train with use_sde=False")
    on_policy = type(policy) is ActorCriticPolicy
    if type(policy) is ARSLinearPolicy:
        extractor = policy.features_extractor
    elif type(policy) is DQNPolicy:
        extractor = policy.q_net.features_extractor
    else:
        extractor = policy.pi_features_extractor if on_policy else policy.actor.features_extractor
    is_vector = type(model.observation_space).__name__ == "Box" and len(model.observation_space.shape or ()) <= 2
    if type(extractor) is not FlattenExtractor or not is_vector:
        raise InvalidNetworkError(
            f"the actor sees {model.observation_space} through a {type(extractor).__name__}; "
            "only vectors of inputs that go straight into the first layer can be mapped"
        )
    if on_policy:
        parts = {"mlp_extractor.policy_net": policy.mlp_extractor.policy_net, "action_net": policy.action_net}
    elif type(policy) is ARSLinearPolicy:
        parts = {"action_net": policy.action_net}
    elif type(policy) is DQNPolicy:
        parts = {"q_net.q_net": policy.q_net.q_net}
    elif type(policy) is SACPolicy:
        parts = {"actor.latent_pi": policy.actor.latent_pi, "actor.mu": policy.actor.mu}
    else:
        # The Tanh at its end is TanhBox's.
        parts = {"actor.mu": policy.actor.mu[:-1]}
    return [layer for name, part in parts.items() for layer in _flat(part, name)]


def _sb3_head(model: Any, action_low: ArrayLike | None, action_high: ArrayLike | None) -> Head:
    """Return the head of a live model."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    space = model.action_space
    # By name: gymnasium stays out of this library's imports.
    kind = type(space).__name__
    if kind == "Discrete" and space.start == 0:
        return Argmax()
    if kind != "Box":
        raise InvalidNetworkError(f"the actions are {space}; only Box and Discrete (start=0) can be mapped")
    low = space.low.ravel() if action_low is None else action_low
    high = space.high.ravel() if action_high is None else action_high
    return TanhBox(low, high) if isinstance(model, OffPolicyAlgorithm) else ClipBox(low, high)
