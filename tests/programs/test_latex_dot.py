"""LaTeX and DOT are read by people: their text is checked here, and rendered where the programs are installed."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import otr
from otr.programs.latex import math_name
from tests.programs.policies import chain, committed, policies

POLICIES = policies()
CAR = otr.ObliqueTree([~0], [~1], [[-3.8, 114.3]], [-2.2], [[[0.0, 0.0]], [[-169.8, 5.1165e7]]], [[-6.1], [-102.3]],
                      head=otr.ClipBox(-1, 1))  # fmt: skip
# Characters that mean something to one of the two, and some that look like it.
HARD_NAMES = ["a_b", "50%", "$x$", "{}", "a&b", "x^2", "c\\d", "~", "<i>", '"q"', "#1", "a|b", "ü", "x0", "y_12"]


def lines_of(text: str) -> list[str]:
    return re.findall(r"^\\otrline\{\d+\}\{.*\}$", text, re.M)


def test_the_program_of_the_thesis_in_latex() -> None:
    assert lines_of(otr.to_latex(CAR, feature_names=["x", "speed_x"])) == [
        r"\otrline{0}{\textbf{if} $-2.2 - 3.8\,x + 114.3\,\textit{speed\_x} \le\nobreak 0$~\textbf{then}}",
        r"\otrline{1}{\textbf{return} $\operatorname{clip}(-6.1,\, -1,\, 1)$}",
        r"\otrline{0}{\textbf{else}}",
        r"\otrline{1}{\textbf{return} $\operatorname{clip}(-102.3 - 169.8\,x "
        r"+ 5.116 \cdot 10^{7}\,\textit{speed\_x},\, -1,\, 1)$}",
    ]
    assert "5.1165 \\cdot 10^{7}" in otr.to_latex(CAR, precision=5)


@pytest.mark.parametrize(
    ("name", "last"),
    [
        ("argmax_without_labels", r"\textbf{return} $\operatorname{arg\,max}(y_{0}, y_{1}, y_{2})$"),
        ("sign_of_one_leaf", r"\textbf{return} \textit{1}"),
        ("wide_tanh", r"\textbf{return} $2 + 2\,\tanh(1 - 900\,x_{0})$"),
        ("labels", r"\textbf{return} \textit{3000000000}"),
        ("pid", r"\textbf{return} $2\,\tanh(\theta_{P} \cdot P + \theta_{I} \cdot I + \theta_{D} \cdot D)$"),
        (
            "pid_of_two_actions",
            r"y_{1} \gets 2 + 2\,\tanh(\theta_{P,\,y_{1}} \cdot P + \theta_{I,\,y_{1}} \cdot I "
            r"+ \theta_{D,\,y_{1}} \cdot D)",
        ),
        ("stairs", r"y_{1} \gets \operatorname{clip}(-20,\, -8,\, -1)"),
    ],
)
def test_heads_in_latex(name: str, last: str) -> None:
    assert last in lines_of(otr.to_latex(POLICIES[name]))[-1]


def test_names_in_latex() -> None:
    assert [math_name(name) for name in ("z", "x0", "y_12", "x_velocity", "50%")] == [
        "z", "x_{0}", "y_{12}", r"\textit{x\_velocity}", r"\textit{50\%}",
    ]  # fmt: skip


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles_with_amsmath_alone(tmp_path: Path) -> None:
    n = len(HARD_NAMES)
    hard = otr.ObliqueTree([~0], [~1], np.arange(1.0, n + 1)[None], [1e-9], np.ones((2, n, n)), np.ones((2, n)))
    programs = [otr.to_latex(hard, feature_names=HARD_NAMES, output_names=HARD_NAMES)]
    programs += [otr.to_latex(tree) for tree in (*POLICIES.values(), committed("hopper"), committed("lander"))]
    document = "\n\n".join(programs)
    (tmp_path / "all.tex").write_text(
        f"\\documentclass{{article}}\n\\usepackage{{amsmath}}\n\\begin{{document}}\n{document}\n\\end{{document}}\n"
    )
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "all.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout.decode(errors="replace")[-1500:]


def test_the_graph_is_the_tree() -> None:
    tree = committed("hopper")
    text = otr.to_dot(tree, max_terms=2)
    assert text.startswith("digraph policy {") and text.endswith("}\n")
    nodes, edges = [0], []  # level by level, a test's own number or ~leaf
    for number, node in enumerate(nodes):
        if node >= 0:
            for child, answer in ((tree.children_left[node], "yes"), (tree.children_right[node], "no")):
                edges.append((f"n{number}", f"n{len(nodes)}", answer))
                nodes.append(child)
    assert re.findall(r"^    (n\d+) \[", text, re.M) == [f"n{number}" for number in range(len(nodes))]
    assert re.findall(r"(n\d+) -> (n\d+) \[label=\"(\w+)\"\]", text) == edges
    assert text.count("+ …") == tree.n_leaves - 1 + 3 * tree.n_leaves
    assert 'label="formulas go through tanh, scaled to [−1, 1]"' in text


def test_boxes_of_the_graph() -> None:
    text = otr.to_dot(committed("lander"), output_names=["coast", "<left>", "main", "right"], max_depth=1)
    assert text.count("shape=folder") == 2 and "leaves</B>" in text
    assert "&lt;left&gt;" in otr.to_dot(committed("lander"), output_names=["coast", "<left>", "main", "right"])
    one_input = otr.ObliqueTree([~0], [~1], [[2.0]], [1.0], np.zeros((2, 1, 1)), [[3.0], [4.0]])
    assert "height ≤ −0.5" in otr.to_dot(one_input, feature_names=["height"])


def test_a_large_graph_is_written() -> None:
    assert otr.to_dot(chain(3000)).count("->") == 6000


@pytest.mark.parametrize("write", [otr.to_latex, otr.to_dot])
def test_bad_arguments_are_refused(write) -> None:
    with pytest.raises(ValueError, match="precision is 0, expected at least 1"):
        write(CAR, precision=0)
    with pytest.raises(ValueError, match="output_names has 2 names, expected 1"):
        write(CAR, output_names=["a", "b"])
    with pytest.raises(ValueError, match="max_terms is 0"):
        otr.to_dot(CAR, max_terms=0)
