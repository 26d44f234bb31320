"""Policies from the Hugging Face Hub, and from folders with the same files: rl-baselines3-zoo fills both."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from otr.core.smooth_network import Oracle
from otr.errors import ArtefactError
from otr.extras import naming_the_extra
from otr.importers import read_policy
from otr.importers.input_statistics import AUTO, STATISTICS

HUB = "hf://"
_NAME = re.compile(r"(?:hf://)?(?P<name>[^/@]+/[^/@]+)(?:@(?P<revision>[^/]+))?(?:/(?P<file>.+))?")
_KINDS = (".zip", ".onnx", ".pt2", ".skops")
_NO_POLICY = "train_eval_metrics.zip"  # the zoo's, next to the policy


def from_hub(repo: str | os.PathLike[str], *, normalise: Any = AUTO) -> Oracle:
    """Return the policy in a repository of the Hugging Face Hub, as `otr.read_policy` reads its file.

    Of a repository as rl-baselines3-zoo uploads them, these are ``<algo>-<env>.zip`` and, where states were normalised,
    ``vec_normalize.pkl``, of which no code is run. Nothing else is downloaded, and that only where it is not in the
    local cache.

    Args:
        repo: "org/name", or "org/name@revision/file" where it is not the newest or has several; "hf://" may be in
            front. Or a folder with the same files.
        normalise: as of `otr.read_policy`.

    Raises:
        ArtefactError: no such repository, no file of a policy in it, or several.
        InvalidNetworkError: as `otr.read_policy`.
        MissingExtraError: huggingface_hub, or what the file needs, is not installed.

    Examples:
        >>> import stable_baselines3
        >>> model = stable_baselines3.DQN("MlpPolicy", "CartPole-v1", device="cpu", buffer_size=10)
        >>> model.save("dqn-CartPole-v1/dqn-CartPole-v1.zip")
        >>> otr.from_hub("dqn-CartPole-v1")  # a folder; sb3/dqn-CartPole-v1 is on the hub
        ReluNetwork(4 -> 64 -> 64 -> 2, negative_slope=0.0, dense=False, head=Argmax())
    """
    return read_policy(policy_file(repo), normalise=normalise)


@naming_the_extra("otr.from_hub")
def policy_file(repo: str | os.PathLike[str]) -> Path:
    """Return the path of a repository's policy, after its download; `from_hub` documents arguments and errors."""
    folder, file = Path(repo), None
    if not folder.is_dir():
        named = _NAME.fullmatch(str(repo))
        if named is None:
            raise ArtefactError(f"{repo} is no folder, and no org/name of a repository of the Hugging Face Hub")
        folder, file = _downloaded(named["name"], named["revision"]), named["file"]
    paths = (path for path in sorted(folder.rglob("*")) if path.suffix in _KINDS and path.name != _NO_POLICY)
    found = {path.relative_to(folder).as_posix(): path for path in paths}
    chosen = [path for name, path in found.items() if file in (None, name)]
    if len(chosen) != 1:
        which = f"no {file!r}" if file else f"{len(found)} files of policies, expected one; name one, as org/name/file"
        raise ArtefactError(f"{repo} has {which}; in it: {', '.join(found) or 'none'}")
    return chosen[0]


def _downloaded(name: str, revision: str | None) -> Path:
    """Return the folder in the local cache with a repository's policies and their statistics."""
    from huggingface_hub import snapshot_download

    wanted = [f"*{suffix}" for suffix in (*_KINDS, *STATISTICS)]
    try:
        return Path(snapshot_download(name, revision=revision, allow_patterns=wanted, ignore_patterns=[_NO_POLICY]))
    except Exception as error:  # of many kinds: no such repository, no access, no network
        reason = str(error).strip().partition("\n")[0]
        raise ArtefactError(
            f"{name} cannot be read from the Hugging Face Hub ({type(error).__name__}: {reason}); is it spelt "
            "org/name, and may you read it?"
        ) from error
