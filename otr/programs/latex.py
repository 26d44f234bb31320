r"""A tree as an algorithm in LaTeX, for a paper: nested if-then-else whose formulas break at the line's end."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from otr.core.arrays import FloatArray
from otr.core.head import Argmax, ClipBox, PidBox, Sign, TanhBox
from otr.core.tree import ObliqueTree
from otr.programs.names import label_name, names_for
from otr.programs.pid_gains import gain_vectors, term_vectors
from otr.programs.walk import box_limits, summary_of, walk

__all__ = ["to_latex"]

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
        ValueError: the wrong number of names, precision < 1, or a PID policy whose terms differ between leaves.
    """
    names = names_for(tree, feature_names, output_names)
    if precision < 1:
        raise ValueError(f"precision is {precision}, expected at least 1 significant digit")
    features = [math_name(name) for name in names.features]
    lines = [f"% {summary_of(tree)[3:].capitalize()}. Needs \\usepackage{{amsmath}}.", _PROLOGUE]
    if isinstance(tree.head, PidBox):
        terms = term_vectors(tree, lambda row, offset: _affine(row, offset, features, precision))
        lines += [_line(0, f"${_vector(term, entries)}$") for term, entries in terms]
    for what, index, depth in walk(tree):
        if what == "if":
            test = _affine(tree.P[index], float(tree.v[index]), features, precision)
            lines.append(_line(depth, rf"\textbf{{if}} ${test} \le\nobreak 0$~\textbf{{then}}"))
        elif what == "else":
            lines.append(_line(depth, r"\textbf{else}"))
        elif what == "leaf":
            lines += [_line(depth, text) for text in _leaf(tree, index, features, names.answers, precision)]
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
    """Return text with the characters that mean something to LaTeX written so that they are printed."""
    return "".join(_SPECIAL.get(character, character) for character in text)


def _line(depth: int, text: str) -> str:
    return rf"\otrline{{{depth}}}{{{text}}}"


def _leaf(tree: ObliqueTree, leaf: int, features: Sequence[str], answers: Sequence[str], precision: int) -> list[str]:
    """Return the lines that state a leaf's answer."""
    if tree.labels is not None:
        return [rf"\textbf{{return}} \textit{{{escaped(label_name(int(tree.labels[leaf]), answers))}}}"]
    outputs = [math_name(answer) for answer in answers]
    if isinstance(tree.head, PidBox):
        gains, values = _gains(tree, leaf, features, outputs, precision)
    else:
        gains = []
        maps = zip(tree.M[leaf], tree.c[leaf].tolist(), strict=True)
        values = [_affine(row, offset, features, precision) for row, offset in maps]
    if isinstance(tree.head, Sign):
        return [rf"\textbf{{return}} $1$ \textbf{{if}} ${values[0]} > 0$ \textbf{{else}} $0$"]
    if isinstance(tree.head, Argmax):
        assigned = [f"${output} \\gets {value}$" for output, value in zip(outputs, values, strict=True)]
        return [*assigned, rf"\textbf{{return}} $\operatorname{{arg\,max}}({', '.join(outputs)})$"]
    values = [_through_head(tree, output, value, precision) for output, value in enumerate(values)]
    if len(values) == 1:
        return [*gains, rf"\textbf{{return}} ${values[0]}$"]
    return [*gains, *(f"${output} \\gets {value}$" for output, value in zip(outputs, values, strict=True))]


def _gains(
    tree: ObliqueTree, leaf: int, features: Sequence[str], outputs: Sequence[str], precision: int
) -> tuple[list[str], list[str]]:
    """Return the lines that state a leaf's gains, and what each action is before the tanh."""
    lines, controls = [], []
    for action, output in enumerate(outputs):
        vectors = gain_vectors(tree, leaf, action, lambda row, offset: _affine(row, offset, features, precision))
        suffix = rf",\,{output}" if len(outputs) > 1 else ""
        named = [(rf"\theta_{{{term}{suffix}}}", term, gains) for term, gains in vectors]
        lines += [f"${_vector(name, gains)}$" for name, _, gains in named]
        controls.append(" + ".join(rf"{name} \cdot {term}" for name, term, _ in named))
    return lines, controls


def _vector(name: str, entries: Sequence[str]) -> str:
    listed = r",\; ".join(entries)
    return rf"{name} \gets ({listed})"


def _through_head(tree: ObliqueTree, output: int, value: str, precision: int) -> str:
    if not isinstance(tree.head, TanhBox | ClipBox | PidBox):
        return value
    low, high = (float(limit[output]) for limit in box_limits(tree.head, tree.n_outputs))
    if isinstance(tree.head, ClipBox):
        return rf"\operatorname{{clip}}({value},\, {_number(low, precision)},\, {_number(high, precision)})"
    return _affine(np.array([(high - low) / 2]), (high + low) / 2, [rf"\tanh({value})"], precision)


def _affine(coefficients: FloatArray, offset: float, names: Sequence[str], precision: int) -> str:
    r"""Return ``offset + coefficients @ names``, constant first, zeros left out."""
    terms = [] if offset == 0 else [(float(offset), "")]
    terms += [(float(coefficients[i]), names[i]) for i in np.flatnonzero(coefficients).tolist()]
    text = ""
    for position, (value, name) in enumerate(terms):
        size = _number(abs(value), precision)
        word = name if name and size == "1" else rf"{size}\,{name}" if name else size
        sign = ("-" if value < 0 else "") if position == 0 else (" - " if value < 0 else " + ")
        text += sign + word
    return text or "0"


def _number(value: float, precision: int) -> str:
    mantissa, _, exponent = f"{value:.{precision}g}".partition("e")
    return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if exponent else mantissa
