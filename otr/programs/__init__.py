"""Trees written out as programs, and drawn."""

from otr.programs.picture import draw_tree, save_picture
from otr.programs.text import to_text

__all__ = ["draw_tree", "save_picture", "to_text"]
