"""The program that `program=...` names: a file, or one that is shipped under conf/program."""

from pathlib import Path

from pipelines.config.conf_dir import CONF_DIR
from pipelines.errors import ConfigError, did_you_mean

ENDING = ".txt"


def shipped_programs() -> list[str]:
    """Return the names of the programs that come with the package."""
    return sorted(path.stem for path in (CONF_DIR / "program").glob(f"*{ENDING}"))


def read_program(name: str) -> str:
    """Return the text of a program; a shipped one's name comes before a file's.

    Raises:
        ConfigError: there is no such program, or it is no text.
    """
    shipped = shipped_programs()
    if not name:
        raise ConfigError(f"method=program: which program? Add program=FILE, or one of: {', '.join(shipped)}")
    path = CONF_DIR / "program" / f"{name}{ENDING}" if name in shipped else Path(name).expanduser()
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        is_path = path.name != name or path.suffix
        hint = f" Shipped are: {', '.join(shipped)}" if is_path else did_you_mean(name, shipped)
        raise ConfigError(f"program={name}: there is no such file, and no such program is shipped.{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = "it is no UTF-8 text" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise ConfigError(f"program={name} cannot be read: {reason}") from error
