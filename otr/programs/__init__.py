"""Trees written out as programs, read from them, and drawn."""

from otr.programs.parser import parse_program
from otr.programs.picture import draw_tree, save_picture
from otr.programs.text import to_text

__all__ = ["draw_tree", "parse_program", "save_picture", "to_text"]
