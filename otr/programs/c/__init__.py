"""A tree or network as one C99 source file."""

from otr.programs.c.source import to_c

__all__ = ["to_c"]
