from otr.learners import CARTClassifier, LinearTreeRegressor
from pipelines.datasets.load import load_dataset
from pipelines.supervised.readable_trees import WIDTH, draw, program_of, wrapped


def test_small_trees_are_printed_with_names(tmp_path):
    dataset = load_dataset("breast_cancer")
    tree = CARTClassifier(max_depth=2, random_state=0).fit(*dataset.labelled("train")).tree_
    program = program_of(tree, dataset)
    assert "return benign 1" in program and "worst" in program
    assert draw(tree, dataset, tmp_path / "tree.png")


def test_large_trees_are_not(tmp_path):
    dataset = load_dataset("digits")
    tree = CARTClassifier(max_depth=8, random_state=0).fit(*dataset.labelled("train")).tree_
    assert program_of(tree, dataset) is None
    assert not draw(tree, dataset, tmp_path / "tree.png")


def test_long_lines_are_broken_before_an_operator_and_nothing_is_lost():
    dataset = load_dataset("diabetes")
    tree = LinearTreeRegressor(max_depth=0).fit(*dataset.labelled("train")).tree_
    program = program_of(tree, dataset)
    lines = program.splitlines()
    assert len(lines) > 1 and max(map(len, lines)) <= WIDTH
    assert all(line.strip()[0] in "+-" for line in lines[1:])
    assert wrapped("if a + b <= 0 then\n    return -1\n") == "if a + b <= 0 then\n    return -1\n"
    names = [name for name in dataset.feature_names if name not in program.replace("\n", " ").split()]
    assert names == []
