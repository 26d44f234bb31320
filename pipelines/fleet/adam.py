"""Adam over stacks: torch's fused kernel on whole flat vectors, with gradients and moments in storage of our own.

The kernel is called directly, because what `torch.optim.Adam` does around it costs several percent of an update of
these small networks. It is the one that `torch.optim.Adam(fused=True)` calls.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.fleet.mlp import Layers

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class AdamGroup:
    """Parameters that share a learning rate and a weight decay, tensor by tensor with gradients and moments.

    Attributes:
        learning_rate, weight_decay: as Stable-Baselines3 gives them to Adam.
        tensors: the lists of parameters, gradients, first and second moments.
        steps: a counter for each parameter, as the kernel wants it.
    """

    learning_rate: float
    weight_decay: float
    tensors: tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]
    steps: list[Tensor]

    @classmethod
    def of(
        cls, learning_rate: float, weight_decay: float, tensors: Sequence[list[Tensor]], n_steps: int
    ) -> "AdamGroup":
        """Return a group that has done `n_steps` steps."""
        parameters, gradients, moments1, moments2 = tensors
        steps = [torch.tensor(float(n_steps), device=tensor.device) for tensor in parameters]
        return cls(learning_rate, weight_decay, (parameters, gradients, moments1, moments2), steps)

    def step(self) -> None:
        """Do one step."""
        torch._foreach_add_(self.steps, 1.0)
        torch._fused_adam_(
            *self.tensors,
            [],
            self.steps,
            lr=self.learning_rate,
            beta1=BETA1,
            beta2=BETA2,
            weight_decay=self.weight_decay,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )


def stack_tensors(layers: Layers, networks: slice) -> list[Tensor]:
    """Return the parameters of some networks of a stack: its flat vector where it is all of them."""
    if networks == slice(None):
        return [layers.flat]
    return [tensor[networks] for tensor in (*layers.weights, *layers.biases)]
