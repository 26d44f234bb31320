"""An imported policy, as the command line has read it."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ImportedModel:
    """A policy, the name of the file that it came from, and the sha256 of what was read."""

    policy: Any  # otr.ReluNetwork, or an oracle that is none (otr.core.smooth_network.SmoothNetwork)
    name: str
    sha256: str
    is_normalised: bool = False  # whether statistics of VecNormalize are folded in
    note: str = ""  # a note for the user on such statistics that the command does not name
    critics: Any = None  # otr.importers.critics.Critics, where the file has some
