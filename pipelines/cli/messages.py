"""What people are told where something has failed."""

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from pipelines.engine.job import message_of as message_of_job
from pipelines.errors import ConfigError

USAGE_ERRORS = (ConfigError, HydraException, OmegaConfBaseException)  # the request itself is wrong


def message_of(error: Exception) -> str:
    """Return the message alone where it was written for people, with the error's kind where it was not."""
    if isinstance(error, OmegaConfBaseException):
        return readable(str(error))
    return str(error) if isinstance(error, HydraException) else message_of_job(error)


def readable(message: str) -> str:
    """Return OmegaConf's message in one line that begins with the key."""
    lines = [line.strip() for line in message.splitlines() if line.strip() and "_type=" not in line]
    keys = [line.removeprefix("full_key: ") for line in lines if line.startswith("full_key: ")]
    rest = "\n".join(line for line in lines if not line.startswith("full_key: "))
    return f"{keys[0]}: {rest}" if keys else rest
