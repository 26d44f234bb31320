r"""A tree as an algorithm in LaTeX, for a paper: nested if-then-else whose formulas break at the line's end."""

from __future__ import annotations

import re
from collections.abc import Sequence

from otr.core.tree import ObliqueTree
from otr.programs.merging import merge_equal_leaves
from otr.programs.names import check_tree, shown_names
from otr.programs.notation import Notation, Program
from otr.programs.walk import summary_of

_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': "''",
}  # fmt: skip
# A line's indentation is counted in steps of 1.2 em; a formula that goes on is indented by two more.
_PROLOGUE = r"""
\begingroup
\setlength{\parindent}{0pt}\setlength{\parskip}{0pt}\raggedright
\newcommand{\otrline}[2]{\par\hangindent=\dimexpr 1.2em*#1+2.4em\relax\hangafter=1\hspace*{\dimexpr 1.2em*#1\relax}#2}%
""".strip()


def to_latex(
    tree: ObliqueTree,
    *,
    feature_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    precision: int = 4,
) -> str:
    r"""Return the program of `tree` (Orfanos 2023, Fig. 4.2) to be read into a LaTeX document that loads amsmath.

    Every line of the program is a paragraph with hanging indentation, so that long formulas break at plus and minus.
    ``\input`` it in the text, or in a figure or minipage.

    Args:
        tree: any tree.
        feature_names, output_names: as in `to_text`; x0 is set with an index, other names of several letters upright
            in one piece, special characters as they are.
        precision: significant digits, at least 1.

    Raises:
        TypeError: `tree` is no ObliqueTree.
        ValueError: the wrong number of names, names that are not distinct, precision < 1, or a PID policy whose terms
            differ between leaves.

    Examples:
        >>> tree = otr.parse_program("if x <= 0: -x else: x", ["x"])
        >>> otr.to_latex(tree).count("otrline{")
        4
    """
    check_tree(tree)
    tree = merge_equal_leaves(tree)
    features, answers = shown_names(tree, feature_names, output_names)
    inputs, outputs = ([math_name(name) for name in given] for given in (features, answers))
    program = Program(tree, _LATEX, inputs, outputs, list(map(escaped, answers)), precision)
    lines = [f"% {summary_of(tree)[3:].capitalize()}. Needs \\usepackage{{amsmath}}.", _PROLOGUE]
    lines += [rf"\otrline{{{depth}}}{{{line}}}" for depth, line in program.lines()]
    return "\n".join([*lines, r"\par\endgroup"]) + "\n"


def math_name(name: str) -> str:
    """Return a name of one line for use in a formula: z as it is, x0 with an index, others as one word."""
    if re.fullmatch(r"[A-Za-z]", name):
        return name
    indexed = re.fullmatch(r"([A-Za-z])_?([0-9]+)", name)
    if indexed:
        return f"{indexed[1]}_{{{indexed[2]}}}"
    return rf"\textit{{{escaped(name)}}}"


def escaped(text: str) -> str:
    """Return text with LaTeX's special characters escaped."""
    return "".join(_SPECIAL.get(character, character) for character in text)


def _number(value: float, precision: int) -> str:
    mantissa, _, exponent = f"{value:.{precision}g}".partition("e")
    return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if exponent else mantissa


def _vector(name: str, entries: Sequence[str], one_a_line: bool) -> list[str]:
    listed = r",\; ".join(entries)
    return [rf"${name} \gets ({listed})$"]


_LATEX = Notation(
    number=_number,
    vector=_vector,
    times=r"\,",
    test=r"\textbf{if} $%s \le\nobreak 0$~\textbf{then}",
    otherwise=r"\textbf{else}",
    returned=r"\textbf{return} $%s$",
    label=r"\textbf{return} \textit{%s}",
    sign=r"\textbf{return} $1$ \textbf{if} $%s > 0$ \textbf{else} $0$",
    argmax=r"\textbf{return} $\operatorname{arg\,max}(%s)$",
    assigned=r"$%s \gets %s$",
    clip=r"\operatorname{clip}(%s,\, %s,\, %s)",
    exp=r"\exp(%s)",
    tanh=r"\tanh(%s)",
    product=r"%s \cdot %s",
    gain=r"\theta_{%s}",
    gain_of=r"\theta_{%s,\,%s}",
)
