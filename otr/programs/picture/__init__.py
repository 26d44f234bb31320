"""A tree as a picture; matplotlib is loaded when one is drawn."""

from otr.programs.picture.drawing import draw_tree, save_picture

__all__ = ["draw_tree", "save_picture"]
