"""The evaluations of training: the exported network plays the selection episodes and is compared with what was trained.

Which actor is kept is decided here, on episodes of a stream of their own, never on the ones that are reported.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import otr
from pipelines.config.env import EnvConfig
from pipelines.errors import PipelineError, PolicyMismatchError
from pipelines.play.actor_files import actor_files
from pipelines.play.agreement import answers_agree
from pipelines.play.episodes import PlaysSelection, Rollout, play_selection
from pipelines.play.spaces import state_box

TOLERANCE = 1e-5  # between the float64 network and the trainer's float32 one, relative
FLOAT32_ROUNDING = 1e-6  # of the sum of all terms' sizes: some eight roundings

Predict = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class InputUnits:
    """Training sees ``(state - middle) / scale``, (d,) each."""

    middle: np.ndarray
    scale: np.ndarray


def units_of_box(env: EnvConfig, rescale_inputs: bool) -> InputUnits | None:
    """Return the units of the environment's box where inputs are rescaled to it; None for its own."""
    return InputUnits(*state_box(env)) if rescale_inputs else None


def evaluate_network(
    network: otr.ReluNetwork, trained: Predict, config: PlaysSelection, units: InputUnits | None
) -> tuple[dict[str, bytes], Rollout]:
    """Return the files of an actor, as it reads the environment's own states, and what came of its selection episodes.

    Raises:
        PolicyMismatchError: the exported network and the trained actor disagree on a visited state.
    """
    if units is not None:
        network = network.fold_input_normalisation(units.middle, units.scale)
    played = play_selection(network.predict, config)
    compare_with_trained(network, trained, played.states, units)
    return actor_files(network), played


def compare_with_trained(
    network: otr.ReluNetwork, trained: Predict, states: np.ndarray, units: InputUnits | None
) -> None:
    """Raise PolicyMismatchError where network and trainer disagree by more than TOLERANCE on a state (n, d).

    The trainer computes in float32, whose rounding grows with the terms that are summed up, not with their sum; that
    much is allowed for, as bounded by the network of the absolute weights on the absolute states. `trained` gives the
    trainer's own deterministic actions on float32 states, in the units that it was trained on.
    """
    ours, outputs = network.predict(states), network.forward(states)
    seen = states if units is None else (states - units.middle) / units.scale
    theirs = trained(seen.astype(np.float32))
    sizes = otr.ReluNetwork(
        [np.abs(weight) for weight in network.weights], [np.abs(bias) for bias in network.biases], dense=network.dense
    ).forward(np.abs(states))
    slack = FLOAT32_ROUNDING * network.head.controls(sizes)
    wrong = ~answers_agree(ours, theirs, outputs, TOLERANCE, slack=slack)
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise PolicyMismatchError(
            f"the exported network is not the trained policy: in state {states[i].tolist()} the network does "
            f"{ours[i].tolist()}, the trained policy {theirs[i].tolist()}"
        )


def diverged(step: int, reason: object) -> PipelineError:
    """Return the error for a training whose numbers are no longer finite."""
    return PipelineError(
        f"the actor after step {step:,} is no network ({reason}); if numbers are not finite, the training diverged: "
        "try a smaller algo.learning_rate"
    )
