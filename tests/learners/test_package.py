import subprocess
import sys
from pathlib import Path

import pytest

from otr import control, learners


def test_importing_the_package_loads_no_learner():
    code = "import otr.learners, sys; print([m for m in ('torch', 'sklearn') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_everything_exported_exists():
    for name in learners.__all__:
        assert getattr(learners, name).__doc__
    assert set(learners.__all__) <= set(dir(learners))
    with pytest.raises(AttributeError, match="no attribute 'CHART'"):
        learners.CHART  # noqa: B018


@pytest.mark.parametrize("package", [control, learners])
def test_no_module_of_the_package_has_the_name_of_something_exported(package):
    """Importing such a module would put it in the place of what is exported."""
    assert not {path.stem for path in Path(package.__file__).parent.iterdir()} & set(package.__all__)
