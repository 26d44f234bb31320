"""Adam over stacks: torch's fused kernel on whole stacks, with gradients and moments in our storage.

The kernel is called directly, because what `torch.optim.Adam` does around it costs several percent of an update of
these small networks. It is the one that `torch.optim.Adam(fused=True)` calls.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class RunSettings:
    """What runs of a fleet may differ in. `temperature` None is the automatic one, a number keeps it fixed."""

    learning_rate: float
    gamma: float
    weight_decay: float = 0.0
    temperature: float | None = None


@dataclass(frozen=True)
class AdamGroup:
    """Parameters that share a learning rate and a weight decay, with their gradients and moments."""

    learning_rate: float  # as Stable-Baselines3 gives them to Adam
    weight_decay: float
    # Parameters, gradients, first and second moments, in the kernel's lists of one each
    tensors: tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]
    steps: list[Tensor]  # the counter, likewise

    @classmethod
    def of(cls, learning_rate: float, weight_decay: float, tensors: Sequence[Tensor], n_steps: int) -> "AdamGroup":
        """Return a group that has done `n_steps` steps; of the parameters, gradients and two moments it is given."""
        steps = [torch.tensor(float(n_steps), dtype=torch.float32)]
        parameters, gradients, moments1, moments2 = tensors
        return cls(learning_rate, weight_decay, ([parameters], [gradients], [moments1], [moments2]), steps)

    def step(self, rate_share: float = 1.0) -> None:
        """Do one step, at a share of the learning rate."""
        torch._foreach_add_(self.steps, 1.0)
        torch._fused_adam_(
            *self.tensors,
            [],
            self.steps,
            lr=self.learning_rate * rate_share,
            beta1=BETA1,
            beta2=BETA2,
            weight_decay=self.weight_decay,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )


def adam_groups(
    runs: Sequence[RunSettings], stacks: Sequence[Tensor], n_updates: int, *, n_each: int = 1, decays: bool = True
) -> list[AdamGroup]:
    """Return the groups of stacks with `n_each` rows a run, after `n_updates` steps: one where runs learn alike.

    Args:
        runs: their settings.
        stacks: parameters, gradients and two moments, (R n_each, .) each.
        n_updates: steps done before.
        n_each: rows a run.
        decays: whether the runs' weight decay is of these parameters.
    """
    alike = len({(run.learning_rate, run.weight_decay) for run in runs}) == 1
    groups = []
    for i, run in enumerate(runs[:1] if alike else runs):
        own = slice(None) if alike else slice(n_each * i, n_each * (i + 1))
        decay = run.weight_decay if decays else 0.0
        groups.append(AdamGroup.of(run.learning_rate, decay, [stack[own] for stack in stacks], n_updates))
    return groups
