"""The actor of a live Stable-Baselines3 model, read layer by layer and compared with what the model predicts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from otr.core.head import Head
from otr.core.heads import Argmax, ClipBox, TanhBox
from otr.core.network import ReluNetwork
from otr.errors import InvalidNetworkError
from otr.importers.torch_modules import flat_layers, network_of_layers, probe_states, reach, refuse_changes

_ROUNDING = 1e-5  # of the size of a sum's terms, in float32


def network_of_model(model: Any, action_low: ArrayLike | None, action_high: ArrayLike | None) -> ReluNetwork:
    """Return the deterministic actor of a live model; `otr.from_sb3` documents arguments and errors."""
    layers = _actor_layers(model)
    refuse_changes(model.policy, "policy")
    network = network_of_layers(layers, None)
    head = _head(model, action_low, action_high)
    n_inputs = math.prod(model.observation_space.shape)
    space = model.action_space
    n_actions = int(space.n) if _kind(space) == "Discrete" else math.prod(space.shape or ())
    require_widths(network.n_inputs, network.n_outputs, n_inputs, n_actions)
    network = network.replace(head=head)
    _require_same_answers(model, network)
    return network


def require_widths(n_inputs: int, n_outputs: int, n_observed: int, n_actions: int) -> None:
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


def _actor_layers(model: Any) -> list[tuple[str, Any]]:
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
    return [layer for name, part in parts.items() for layer in flat_layers(part, name)]


def _head(model: Any, action_low: ArrayLike | None, action_high: ArrayLike | None) -> Head:
    space = model.action_space
    if _kind(space) == "Discrete" and space.start == 0:
        return Argmax()
    if _kind(space) != "Box":
        raise InvalidNetworkError(f"the actions are {space}; only Box and Discrete (start=0) can be mapped")
    low = space.low.ravel() if action_low is None else action_low
    high = space.high.ravel() if action_high is None else action_high
    return TanhBox(low, high) if _is_squashed(model) else ClipBox(low, high)


def _is_squashed(model: Any) -> bool:
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    return isinstance(model, OffPolicyAlgorithm)


def _kind(space: Any) -> str:
    """Return a space's kind, by name: gymnasium stays out of this library's imports."""
    return type(space).__name__


def _require_same_answers(model: Any, network: ReluNetwork) -> None:
    """Raise InvalidNetworkError where the model predicts something else than the network, beyond float32's rounding."""
    states = probe_states(network.n_inputs).astype(np.float32)
    outputs = network.forward(states)
    modes = [(part, part.training) for part in model.policy.modules()]  # predict switches to evaluation
    try:
        found = model.policy.predict(states.reshape(-1, *model.observation_space.shape), deterministic=True)[0]
        found = found.reshape(len(states), -1)
    except Exception as error:  # foreign code can fail in any way
        raise InvalidNetworkError(
            f"the model cannot predict {len(states)} states of {network.n_inputs} inputs, so its layers cannot be "
            f"compared with it: {error}; take hooks and other changes out of its policy"
        ) from error
    finally:
        for part, mode in modes:
            part.training = mode
    rounding = _ROUNDING * reach(zip(network.weights, network.biases, strict=True), states.astype(np.float64))
    if network.head.gives_labels:
        # How far the label's output lies below the largest.
        differences = outputs.max(axis=1, keepdims=True) - np.take_along_axis(outputs, found, axis=1)
        rounding = 2 * rounding.max(axis=1, keepdims=True)
    else:
        low, high = model.action_space.low.ravel(), model.action_space.high.ravel()
        if _is_squashed(model):
            differences = np.abs(TanhBox(low, high)(outputs) - found)
            rounding = rounding * (high - low) + _ROUNDING * np.maximum(np.abs(low), np.abs(high))
        else:
            differences = np.abs(np.clip(outputs, low, high) - found)
    if not (differences <= rounding).all():
        i = int(np.argmax(np.nan_to_num(differences - rounding, nan=np.inf).max(axis=1)))
        raise InvalidNetworkError(
            f"the model predicts otherwise than its layers: in state {states[i].tolist()} it does {found[i].tolist()}, "
            f"its layers give {outputs[i].tolist()} (the largest difference is {differences.max():g}); "
            "take hooks, replaced functions and other changes out of its policy"
        )
