"""Where the configuration files are."""

from pathlib import Path

_PACKAGED = Path(__file__).parents[1] / "conf"  # in a wheel; in a checkout conf/ is next to the packages
CONF_DIR = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parents[2] / "conf"
