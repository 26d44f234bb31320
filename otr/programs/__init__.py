"""Trees written out as programs."""

from otr.programs.text import to_text

__all__ = ["to_text"]
