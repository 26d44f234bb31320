"""Stage import: a policy that was trained elsewhere, as a network for the run's environment."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import otr
from otr.core.smooth_network import Oracle
from otr.importers import read_policy
from otr.importers.critics import Critics, critics_of_zip
from otr.importers.hub import HUB, policy_file
from otr.importers.input_statistics import find_statistics
from pipelines.config.env import EnvConfig
from pipelines.config.model import ImportedModel
from pipelines.engine.stage import Inputs, Stage
from pipelines.engine.store import write_files, write_json
from pipelines.errors import ConfigError
from pipelines.play.actor_files import actor_files
from pipelines.play.spaces import Spaces, spaces
from pipelines.training.critics import critics_file


@dataclass(frozen=True)
class ImportSettings:
    """What the stage reads of a run's configuration."""

    env: EnvConfig
    imported: ImportedModel


def import_keys(settings: ImportSettings) -> dict[str, Any]:
    """Return what decides the network: the files, and the environment, whose actions its answers are clipped to."""
    return {"env": settings.env.settings(), "model_sha256": settings.imported.sha256}


def import_policy(inputs: Inputs, settings: ImportSettings, out: Path) -> None:
    """Write the network as a trained actor is, and `report.json`, which names the file that it came from."""
    network, critics = settings.imported.policy, settings.imported.critics
    write_files(actor_files(network), out)
    if critics is not None:
        write_files(critics_file(critics), out)
    widths = [int(width) for width in network.hidden_widths]
    write_json(out / "report.json", {"model": settings.imported.name, "hidden_widths": widths})


def read_model(
    model: str, normalise: str | None, env: EnvConfig, key: str = "model", output: str | None = None
) -> ImportedModel:
    """Return the policy in a file of one of the kinds that `otr.importers.read_policy` reads.

    Args:
        model: path of the file; a zip's suffix may be left out; or hf://org/name (`otr.from_hub`).
        normalise: path of a file of statistics that `otr.read_policy` takes, or "none"; where it is None, one is looked
            for next to a zip.
        env: its observations and actions are compared with the policy's.
        key: the setting that named the file, for what an error says.
        output: the policy's, of an ONNX model with several.

    Raises:
        ConfigError: there is no such file, it is of another kind, no policy can be read from it, or not for this
            environment.
    """
    try:
        path = policy_file(model) if model.startswith(HUB) else Path(model).expanduser()
    except otr.OtrError as error:
        raise ConfigError(f"{key}={model}: {error}") from error
    if path.suffix == "" and not path.exists():  # Stable-Baselines3 adds the suffix where it is left out
        path = path.with_name(f"{path.name}.zip")
    statistics, note = None, ""
    if normalise is not None and normalise.lower() != "none":
        statistics = Path(normalise).expanduser()
    elif normalise is None and path.suffix == ".zip" and path.is_file():
        statistics, note = find_statistics(path)
    files = [path, *([statistics] if statistics else [])]
    for file in files:
        if not file.is_file():
            what = "that is a folder, expected a file" if file.is_dir() else "there is no such file"
            raise ConfigError(f"{key if file is path else 'normalise'}={file}: {what}")
    try:
        network = read_policy(path, normalise=statistics, output=output)
        policy = _fitted(network, spaces(env), env)
    except (otr.OtrError, ValueError) as error:
        raise ConfigError(f"{key}={model}: {error}") from error
    if path.suffix == ".npz":  # the arrays of a policy whose JSON next to them has all else, and their digest
        files[0] = path.with_suffix(".json")
    read = [file.read_bytes() for file in files] + ([output.encode()] if output else [])
    sha256 = hashlib.sha256(b"".join(hashlib.sha256(content).digest() for content in read)).hexdigest()
    critics = None if statistics else _critics(path)
    return ImportedModel(policy, path.name, sha256, statistics is not None, note, critics)


def _critics(path: Path) -> Critics | None:
    """Return the critics in a file; None where there are none, or none that can be read: the policy is enough."""
    try:
        return critics_of_zip(path) if path.suffix == ".zip" else None
    except otr.OtrError:
        return None


def _fitted(network: Oracle, space: Spaces, env: EnvConfig) -> Oracle:
    """Return the network with a head that answers with the environment's actions; ConfigError where it cannot."""
    if network.n_inputs != space.n_inputs:
        raise ValueError(
            f"the policy reads {network.n_inputs} numbers, the observations of {env.id} have {space.n_inputs}"
        )
    head = network.head
    if space.box is not None:
        head = head if head.gives_labels else head.clipped_to(*space.box)
    elif isinstance(head, otr.Identity):  # real numbers, of which the largest one's label is the action
        head = otr.Argmax()
    if head.gives_labels is not (space.box is None):
        kinds = ("real numbers", "labels")
        ours, theirs = kinds[head.gives_labels], kinds[space.box is None]
        raise ValueError(f"the policy answers with {ours}, the actions of {env.id} are {theirs}")
    n_answers = (head.n_labels if head.gives_labels else head.n_answers)(network.n_outputs)
    if n_answers != space.n_actions:
        raise ValueError(f"the policy has {n_answers} actions, {env.id} has {space.n_actions}")
    return network.replace(head=head)


IMPORT = Stage("import", version=1, inputs=(), keyed=import_keys, run=import_policy, settings=ImportSettings)
