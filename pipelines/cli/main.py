"""What all commands share: their arguments, their help, and one message and an exit code for every foreseen failure."""

import argparse
import importlib
import io
import os
import shlex
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from otr import MissingExtraError
from otr.extras import naming_the_extra
from pipelines.engine.wrapping import columns, fitted, fitted_help

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE, EXIT_TERMINATED = 1, 2, 130, 141, 143
HELP = Path(__file__).parent / "help"
SWEEPING = ("otr-run", "otr-plan", "otr-fit")  # commands of jobs, which can be swept


def main(program: str) -> None:
    """Do a command and end the process; `pipelines.cli.commands` has a module each, with a function `do`."""
    arguments = _arguments(program)
    with ending(program, debug="debug=true" in (override.lower() for override in arguments.overrides)):
        command = importlib.import_module(f"pipelines.cli.commands.{program.removeprefix('otr-')}")
        sys.exit(command.do(arguments))


@contextmanager
def ending(program: str, debug: bool = False) -> Iterator[None]:
    """End the process where the command in the body is stopped or fails: with one message, and with its exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))  # so that workers are ended, too
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with naming_the_extra(program):
            yield
    except KeyboardInterrupt:
        line = shlex.join([program, *sys.argv[1:]])
        print(f"\nstopped; what was finished is kept, and the same command goes on from it: {line}")
        sys.exit(EXIT_INTERRUPTED)
    except BrokenPipeError:  # the reader of the pipe has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_BROKEN_PIPE)
    except MissingExtraError as error:
        print(f"{program}: {error}", file=sys.stderr)
        sys.exit(EXIT_FAILED)
    except Exception as error:  # the last resort of a command line: no traceback without debug=true
        sys.exit(_complain(program, error, debug))


def _arguments(program: str) -> argparse.Namespace:
    text = fitted_help((HELP / f"{program}.txt").read_text(encoding="utf-8"), columns())
    parser = argparse.ArgumentParser(program, description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--version", action="version", version=f"{program} {version('otr')}")
    if program in SWEEPING:
        parser.add_argument(
            "-m", "--multirun", action="store_true", help="sweep over comma lists, range() and choice()"
        )
        parser.add_argument("--cfg", action="store_true", help="print the resolved configuration and stop")
    return parser.parse_intermixed_args()


def _complain(program: str, error: Exception, debug: bool) -> int:
    from pipelines.cli.compose import USAGE_ERRORS, message_of  # imports Hydra

    if debug:
        traceback.print_exception(error)
    print(fitted(f"{program}: {message_of(error)}", columns(sys.stderr)), file=sys.stderr)
    return EXIT_USAGE if isinstance(error, USAGE_ERRORS) else EXIT_FAILED
