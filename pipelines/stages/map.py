"""Stage map: the actor, trained or imported, as an oblique tree, exactly."""

from dataclasses import dataclass
from pathlib import Path

import otr
from pipelines.config.env import EnvConfig
from pipelines.config.stages import MapConfig
from pipelines.engine.stage import Inputs, Stage, picked
from pipelines.engine.store import write_json
from pipelines.play.actor_files import load_actor
from pipelines.play.printed_programs import write_program


@dataclass(frozen=True)
class MapSettings:
    """What the stage reads of a run's configuration."""

    env: EnvConfig
    map: MapConfig


def map_actor(inputs: Inputs, settings: MapSettings, out: Path) -> None:
    """Map the actor and write `tree.npz` with `tree.json`, `report.json`, and `program.txt` where the tree is explicit.

    A tree of more than `map.max_leaves` leaves is held as activation patterns and never written out.
    """
    (actor,) = inputs.values()
    network = load_actor(actor)
    tree, n_tests = full_tree(network, settings.map.max_leaves), _n_tests(network)
    otr.save(tree, out / "tree")
    kind = "pattern_tree"
    if isinstance(tree, otr.ObliqueTree):
        kind = "oblique_tree"
        write_program(tree, settings.env, out)
    write_json(out / "report.json", {"kind": kind, "n_leaves": 2**n_tests, "depth": n_tests})


def full_tree(network: otr.ReluNetwork, max_leaves: int) -> otr.ObliqueTree | otr.PatternTree:
    """Return the tree of an actor, as activation patterns where it has more leaves than that."""
    explicit = 2 ** _n_tests(network) <= max_leaves
    return otr.map_network(network, max_leaves=max_leaves) if explicit else otr.PatternTree(network)


def _n_tests(network: otr.ReluNetwork) -> int:
    return network.n_hidden + network.head.n_tests(network.n_outputs)


MAP_KEYS = picked(max_leaves="map.max_leaves", feature_names="env.feature_names", action_names="env.action_names")
# Its input depends on the method: `pipelines.runs.stage_table.stages_of` sets it.
MAP = Stage("map", version=1, inputs=(), keyed=MAP_KEYS, run=map_actor, settings=MapSettings)
