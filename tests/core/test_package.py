import ast
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import otr


def modules_after(code: str) -> set[str]:
    code = f"import sys\n{code}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(done.stdout.split())


def test_a_module_is_imported_when_one_of_its_names_is_first_used() -> None:
    assert not {"numpy", "scipy", "otr.core.tree"} & modules_after("import otr; dir(otr); otr.__version__")
    assert not {"scipy", "otr.proof.certify"} & modules_after("import otr; otr.map_network; from otr import load")
    heavy = {"scipy.optimize", "torch", "sklearn", "stable_baselines3", "gymnasium", "pandas", "matplotlib", "onnx"}
    assert not heavy & modules_after("from otr import *; certify, simplify, to_onnx, from_sb3")


def test_subpackages_that_the_documents_name_are_there_after_import_otr_alone() -> None:
    for name in ("learners.from_sklearn_tree", "importers.read_policy", "control.pid_observation"):
        subpackage, attribute = name.split(".")
        code = f"import otr; assert {subpackage!r} in dir(otr); assert otr.{name}.__name__ == {attribute!r}"
        assert f"otr.{subpackage}" in modules_after(code)
    assert not {"otr.learners", "otr.importers", "otr.control"} & modules_after("import otr; dir(otr)")


def test_type_checkers_know_every_exported_name_from_the_module_that_it_is_loaded_from() -> None:
    (block,) = (node for node in ast.parse(Path(otr.__file__).read_text()).body if isinstance(node, ast.If))
    told = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name  # else mypy calls it private
            told[alias.name] = node.module
    subpackages = dict.fromkeys(otr._SUBPACKAGES, "otr")
    assert told == {name: f"otr.{module}" for name, module in otr._MODULES.items()} | subpackages


@pytest.mark.parametrize("package", [otr, otr.control, otr.learners])
def test_everything_exported_exists_and_hides_no_module(package: ModuleType) -> None:
    assert all(getattr(package, name).__doc__ for name in package.__all__) and set(package.__all__) <= set(dir(package))
    assert package.__file__
    assert not {path.stem for path in Path(package.__file__).parent.iterdir()} & set(package.__all__)
    with pytest.raises(AttributeError, match="no attribute 'CHART'"):
        package.CHART  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'map_netwrok'; did you mean map_network\?$"):
        otr.map_netwrok  # type: ignore[attr-defined]  # noqa: B018
    errors = [getattr(otr, name) for name in otr.__all__ if name.endswith("Error")]
    assert len(errors) > 4 and all(issubclass(error, otr.OtrError) for error in errors)
