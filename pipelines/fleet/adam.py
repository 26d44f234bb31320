"""Adam over stacks: torch's fused kernel on whole flat vectors, with gradients and moments in storage of our own."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pipelines.fleet.mlp import Layers

# Learning rate, weight decay, and the lists of parameters, gradients, first and second moments, tensor by tensor.
AdamGroup = tuple[float, float, Sequence[Sequence[Tensor]]]


def new_adam(groups: Sequence[AdamGroup], n_steps: int) -> torch.optim.Adam:
    """Return torch's Adam as if it had done `n_steps` steps and come to these moments."""
    device = groups[0][2][0][0].device
    adam = torch.optim.Adam(
        [{"params": list(parts[0]), "lr": lr, "weight_decay": decay}
         for lr, decay, parts in groups],
        fused=True,
        capturable=device.type == "cuda",
    )  # fmt: skip
    for _, _, parts in groups:
        for parameter, gradient, moment1, moment2 in zip(*parts, strict=True):
            parameter.grad = gradient
            step = torch.tensor(float(n_steps), device=device)
            adam.state[parameter] = {"step": step, "exp_avg": moment1, "exp_avg_sq": moment2}
    return adam


def stack_tensors(layers: Layers, networks: slice) -> list[Tensor]:
    """Return the parameters of some networks of a stack: its flat vector where it is all of them."""
    if networks == slice(None):
        return [layers.flat]
    return [tensor[networks] for tensor in (*layers.weights, *layers.biases)]
