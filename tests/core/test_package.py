import subprocess
import sys

import otr


def test_importing_the_library_imports_nothing_heavy() -> None:
    code = (
        "import sys, otr\n"
        "heavy = {'torch', 'sklearn', 'stable_baselines3', 'gymnasium', 'pandas', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_everything_exported_exists() -> None:
    for name in otr.__all__:
        assert getattr(otr, name).__doc__


def test_errors_share_a_base() -> None:
    for error in (
        otr.ArtefactError,
        otr.InvalidNetworkError,
        otr.InvalidTreeError,
        otr.ProgramError,
        otr.TreeTooLargeError,
    ):
        assert issubclass(error, otr.OtrError)
