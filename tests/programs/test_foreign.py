"""What others print is read: C and Python functions, trees of scikit-learn and dtControl."""

import numpy as np
import pytest
from sklearn.datasets import load_diabetes, load_iris
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor, export_graphviz, export_text

import otr

GRID = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2) * 1.0
NAMES = ["sepal length (cm)", "colour == red", "x", "petal > 2"]
CLASSES = ["setosa", "the other", "2"]
# Of dtControl 2.1: its C template with one output, and what `Node.print_dot` writes of the same tree.
DTCONTROL_C = """\
#include <stdio.h>

float classify(const float x[]);

int main() {
    float x[] = {1.0f, 2.0f};
    float result = classify(x);
    return 0;
}

float classify(const float x[]) {
\tif (1.5*x[0]-2.0*x[1]+3.25 <= 0) {
\t\treturn 5.0f;
\t}
\telse {
\t\tif (x[1] <= 2.5) {
\t\t\treturn -1.0f;
\t\t}
\t\telse {
\t\t\treturn 2e-05f;
\t\t}

\t}

}
"""
DTCONTROL_DOT = r"""digraph {
0 [label="1.5*x[0]\n-2.0*x[1]\n+3.25 <= 0"];
1 [label="5.0"];
0 -> 1 [label="True"];
2 [label="x[1] <= 2.5"];
3 [label="-1.0"];
2 -> 3 [label="True"];
4 [label="2e-05"];
2 -> 4 [style="dashed", label="False"];
0 -> 2 [style="dashed", label="False"];

}"""
TRUE = '0 -> 1 [label="True"];\n'
VALUES = ("5.0", "-1.0", "2e-05")


def parse(text: str, **options: object) -> otr.ObliqueTree:
    return otr.parse_program(text, ["a", "b"], **options)


def dtcontrols_answers() -> np.ndarray:
    x, y = GRID.T
    return np.where(1.5 * x - 2 * y + 3.25 <= 0, 5.0, np.where(y <= 2.5, -1.0, 2e-05))


NAMED_DOT = DTCONTROL_DOT.replace("x[0]", "a").replace("x[1]", "b")
TRUE_LAST = DTCONTROL_DOT.replace(TRUE, "").replace("\n\n}", f"\n{TRUE}}}")


@pytest.mark.parametrize("text", [DTCONTROL_C, DTCONTROL_DOT, NAMED_DOT, TRUE_LAST])
def test_dtcontrols_trees(text):
    np.testing.assert_array_equal(parse(text).predict(GRID)[:, 0], dtcontrols_answers())


def test_dtcontrols_trees_of_several_outputs():
    code = DTCONTROL_C.replace("float classify(const float x[])", "void classify(const float x[], float result[])")
    code = code.replace("float result = classify(x)", "float result[2];\n    classify(x, result)")
    graph = DTCONTROL_DOT
    for value in VALUES:
        code = code.replace(f"return {value}f;", f"result[0] = {value}f; result[1] = 1.0f;")
        graph = graph.replace(f'"{value}"', f'"({value}, 1.0)"')
    for text, options in ((code, {}), (code, {"output_names": ["u", "w"]}), (graph, {})):
        answers = parse(text, **options).predict(GRID)
        np.testing.assert_array_equal(answers, np.column_stack((dtcontrols_answers(), np.ones(len(GRID)))))


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    "export",
    [
        lambda model, **names: export_text(model, decimals=15, **names),
        lambda model, **names: export_text(model, decimals=15, show_weights=True, **names),
        lambda model, **names: export_graphviz(model, precision=15, **names),
        lambda model, **names: export_graphviz(
            model, precision=15, special_characters=True, filled=True, node_ids=True, proportion=True, **names
        ),
    ],
    ids=["text", "weights", "dot", "html"],
)
def test_scikit_learns_classifiers(export, named):
    X, y = load_iris(return_X_y=True)
    model = DecisionTreeClassifier(max_depth=4, random_state=0).fit(X, y)
    text = export(model, **({"feature_names": NAMES, "class_names": CLASSES} if named else {}))
    tree = otr.parse_program(text, NAMES, output_names=CLASSES, labels=True)
    np.testing.assert_array_equal(tree.predict(X), model.predict(X))
    assert tree.n_leaves > 4


@pytest.mark.parametrize("n_outputs", [1, 2])
@pytest.mark.parametrize(("export", "digits"), [(export_text, "decimals"), (export_graphviz, "precision")])
def test_scikit_learns_regressors(export, digits, n_outputs):
    X, y = load_diabetes(return_X_y=True)
    model = DecisionTreeRegressor(max_depth=3, random_state=0).fit(X, np.column_stack((y, -X[:, 2]))[:, :n_outputs])
    tree = otr.parse_program(export(model, **{digits: 15}), [f"x{i}" for i in range(10)])
    np.testing.assert_allclose(tree.predict(X), model.predict(X).reshape(len(X), -1), atol=1e-12)


@pytest.mark.parametrize("classes", [[-1, 1], ["0.5", "1.0", "1e-05"], [1, 2, 4], [1, 0]])
@pytest.mark.parametrize("export", [export_text, export_graphviz])
def test_scikit_learns_classes_that_are_numbers(export, classes):
    X = np.random.default_rng(0).normal(size=(200, 2))
    y = np.digitize(X[:, 0] + X[:, 1], [0, 1][: len(classes) - 1])
    model = DecisionTreeClassifier(max_depth=3, random_state=0).fit(X, np.array(classes)[y])
    names = [str(each) for each in model.classes_]
    text = export(model, feature_names=["x", "v"], class_names=None if export is export_text else names)
    tree = otr.parse_program(text, ["x", "v"], labels=True, output_names=names)
    assert np.mean(model.classes_[tree.predict(X)] == model.predict(X)) > 0.98  # of tests that are printed rounded


@pytest.mark.parametrize("names", [["x", "x ", " x", "x  "], ["x  ", " x", "x ", "x"]])
@pytest.mark.parametrize("export", [export_text, export_graphviz])
def test_scikit_learns_names_that_differ_by_spaces(export, names):
    X = np.random.default_rng(0).normal(size=(200, 4))
    model = DecisionTreeRegressor(max_leaf_nodes=8, random_state=0).fit(X, X @ [1.0, 2.0, 3.0, 4.0])
    tree = otr.parse_program(export(model, feature_names=names), names)
    used, counts = np.unique(model.tree_.feature[model.tree_.feature >= 0], return_counts=True)
    assert len(used) > 1
    np.testing.assert_array_equal((tree.P != 0).sum(axis=0)[used], counts)


@pytest.mark.parametrize(
    "text",
    [
        'def policy(obs: list) -> float:\n    """What x[9] is."""\n    u = 2 * obs[0]  # and not obs[9]\n'
        "    if obs[1] > 0 and u < 1:\n        return [1.0, 2.5,]\n    return (0.0, -1.0,)\n",
        "void f(double *s, double *out) {\n double u;\n u = 2.f * s[0];\n double w = s[1];\n"
        " if (w > 0 && u < 1) {out[0] = 1; out[1] = 2.5F;}\n else { out[0] = 0; out[1] = -1; }}",
        "if x[1] > 0:\n    if max(2 x[0], -1e9,) < 1:\n        return 1, 2.5,\nreturn 0, -1,",
        "if `b` > 0 and 2 a < 1 then\n    out[0] = 1\n    out[1] = 2.5\nelse\n    out[0] = 0\n    out[1] = -1",
    ],
)
def test_functions_of_python_and_c(text):
    x, y = GRID.T
    expected = np.where(((y > 0) & (2 * x < 1))[:, None], [1.0, 2.5], [0.0, -1.0])
    np.testing.assert_array_equal(parse(text).predict(GRID), expected)


def test_an_inputs_name_comes_before_what_its_text_means():
    tree = otr.parse_program("return 2f + `x[1]` + `4f`", ["f", "x[1]", "4f"])
    assert tree.predict([[1.0, 10.0, 100.0]]).tolist() == [[112.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("return 1 +\n  x[5]", r"line 2, column 3: there is no x\[5\]: the inputs are 2, from x\[0\] on"),
        ("return x[0] + y[1]", r"y\[1\], where x\[...\] was an array before; give one"),
        ("def f(x):\n    return 1\ndef g(x):\n    return 2", "line 3, column 1: a second function; give"),
        (DTCONTROL_DOT.replace('"5.0"', '"[5.0, 6.0]"'), "line 3.*a leaf allows several answers"),
        (DTCONTROL_DOT.replace("0 -> 1", "2 -> 1"), "the graph has|a test has two"),
        (DTCONTROL_DOT.replace("2 -> 4", "2 -> 3"), "the graph has 2 nodes that no edge leads to"),
        (DTCONTROL_DOT.replace("0 -> 2", "0 -> 1"), "the graph has 2 nodes that no edge leads to"),
        (DTCONTROL_DOT.replace('"-1.0"', '"(...)"'), "line 6, column 1: node 3 is cut"),
        ("|--- feature_0 <= 1.0\n|   |--- truncated branch of depth 2\n|--- feature_0 >  1.0\n|   |--- value: [1.0]",
         "line 2, column 1: the tree was cut when it was printed"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_at_its_place(text, message):
    with pytest.raises(otr.ProgramError, match=message):
        parse(text)
