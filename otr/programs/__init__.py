"""Trees written out as programs, read from them, and drawn."""

from otr.programs.c.source import to_c
from otr.programs.dot import to_dot
from otr.programs.json import to_json
from otr.programs.latex import to_latex
from otr.programs.onnx import to_onnx
from otr.programs.parser import parse_program
from otr.programs.picture.drawing import draw_tree, save_picture
from otr.programs.python import to_python
from otr.programs.structured_text import to_structured_text
from otr.programs.text import to_text

__all__ = [
    "draw_tree",
    "parse_program",
    "save_picture",
    "to_c",
    "to_dot",
    "to_json",
    "to_latex",
    "to_onnx",
    "to_python",
    "to_structured_text",
    "to_text",
]
