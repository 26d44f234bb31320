"""Names that try to be more than names, and small trees that are printed with them."""

from __future__ import annotations

import keyword

import numpy as np
from hypothesis import strategies as st

import otr
from otr.control import pid_network
from tests.core.strategies import make_network

# What ends, opens or joins lines, comments, strings and formulas in one of the languages, or is a word of it.
PIECES = [
    "coding: unicode_escape", "\\u000aimport os; os.abort()", "-*- coding: latin-1 -*-", "#!/bin/sh", "vim: set enc=x",
    "\n", "\r", "\r\n", "\f", "\v", "\0", "\x1a", "\x1b[2J", "\x85", "\u2028", "\u2029", "\u202e", "\ufeff", "\u200b",
    "\ud800", "\udfff", "\u00a0", "\t", " ", "'", '"', "'''", '"""', "\\", "\\\n", "`", "``", "\\u{a}", "/*", "*/", "*",
    "/", "//", "??/", "???/", "??/\n", "(*", "*)", "(*)", ")", "(", "{", "}", "{*", "$", "$$", "%", "#", "&", "&amp;",
    "_", "^", "^^M", "~", "\\end{document}", "\\par", "<", ">", "<B>", "</TABLE>", "<!--", "-->", "--", "]]>", "|", "[",
    "]", ";", ":", ":=", "=", "==", "<= 0 then", "->", "@", "+ 1", "- 2 x0", "2", "1e5", "x0", "y0", "x1 + x2", "é",
    "\u0301", "ﬁ", "ｉｆ", "٣", "²", "λ", "漢字", "🙂", "class", "if", "else", "return", "then", "end", "and", "int",
    "IF", "END_IF;", "VAR", "LREAL", "tanh", "max", "clip", "state", "outputs", "label", "policy", "None", "match",
]  # fmt: skip
WORDS = [*keyword.kwlist, *keyword.softkwlist, "exp", "abs", "limit", "end_if", "tests", "node", "decay", "x0", "y0"]


def names() -> st.SearchStrategy[str]:
    """Names of up to 200 characters."""
    pieces = st.lists(st.sampled_from(PIECES), max_size=12).map("".join)
    long_words = st.builds(lambda letter, n: letter * n, st.sampled_from("xlI_é"), st.integers(25, 200))
    any_text = st.text(st.characters(), max_size=12)
    mixed = st.builds(lambda a, b, c: (a + b + c)[:200], pieces, any_text, pieces)
    return st.one_of(pieces, mixed, long_words, any_text, st.sampled_from([*PIECES, *WORDS]))


@st.composite
def named_trees(draw: st.DrawFn) -> tuple[otr.ObliqueTree, list[str], list[str]]:
    """A tree, distinct names of its inputs and its answers; some may be equal in one line, or as identifiers."""
    tree = draw(st.sampled_from(list(TREES.values())))
    n = tree.n_inputs + 2
    alike = names().map(lambda name: [name + " " * i for i in range(n)])
    given = draw(st.one_of(st.lists(names(), min_size=n, max_size=n, unique=True), alike))
    return tree, given[: tree.n_inputs], given[tree.n_inputs :]


def trees() -> dict[str, otr.ObliqueTree]:
    """Small trees of two inputs, or four, and two answers: with several kinds of heads, and with labels."""
    rng = np.random.default_rng(7)
    shape = ([1, ~0], [~2, ~1], [[1.5, -0.25], [-1.0, 3.0]], [0.5, -0.125])
    M, c = rng.integers(-4, 5, (3, 2, 2)) / 4, rng.integers(-4, 5, (3, 2)) / 4
    made = {
        name: otr.ObliqueTree(*shape, M, c, head=head)
        for name, head in {
            "plain": otr.Identity(),
            "clipped": otr.ClipBox([-1.0, -0.5], [0.5, 1.0]),
            "squashed": otr.TanhBox([-1.0, 0.0], [1.0, 4.0]),
            "largest": otr.Argmax(),
        }.items()
    }
    made["labels"] = otr.ObliqueTree(*shape, M, c, labels=[1, 0, 1], head=otr.Argmax())
    made["constant"] = otr.ObliqueTree(*shape, np.zeros((3, 2, 2)), c)
    made["pid"] = otr.map_network(
        pid_network(make_network(rng, (1,), n_inputs=1, n_outputs=6), [-1.0, 0.0], [1.0, 4.0])
    )
    return made


TREES = trees()
