"""The environment of a run: a file of conf/env, or one that is registered with gymnasium."""

from dataclasses import dataclass, field
from typing import Annotated, Any

from pipelines.config.setting import DERIVED, FreeText


@dataclass(frozen=True)
class PidTerms:
    """What a PID policy observes: [s, P, I, D] in place of the state s (`otr.control.pid_observation`)."""

    goal: tuple[float, ...]  # e, one number a component of the state
    n_history: int  # states before s that I sums over


@dataclass(frozen=True)
class EnvConfig:
    """One environment: its gymnasium id and the names that programs print.

    `pid` is set for PID policies, whose environments show [s, P, I, D].
    """

    name: FreeText
    # The row of the tables and of conf/budget; hopper_v5 has task hopper, one's own has task discrete or continuous
    task: FreeText
    id: FreeText
    kwargs: dict[str, Any] = field(default_factory=dict)
    feature_names: list[FreeText] = field(default_factory=list)
    action_names: list[FreeText] = field(default_factory=list)
    pid: Annotated[PidTerms | None, DERIVED] = field(default=None, metadata={"omegaconf_ignore": True})

    def settings(self) -> dict[str, Any]:
        """Return what decides how the environment behaves, for the keys of stages that play in it."""
        pid = {} if self.pid is None else {"pid": {"goal": list(self.pid.goal), "n_history": self.pid.n_history}}
        return {"id": self.id, "kwargs": self.kwargs, **pid}
