"""The command ``ssp-lp``: models in files, the best policies in them, and what those do.

``ssp-lp --help`` lists the commands, ``ssp-lp solve --help`` says with examples what one takes. It
ends with 0, with 2 for wrong arguments or models, with 3 where no policy keeps to the budget, with
1 where a method failed, and with 130 or 141 where it was interrupted or nobody reads on.

The commands are imported once the arguments are parsed: the library takes longer to load than most
commands take, and help is to come at once.
"""

from __future__ import annotations

import os
import sys
import warnings
from argparse import Namespace
from collections.abc import Sequence

from .arguments import argument_parser

FAILED, WRONG_INPUT, INFEASIBLE, INTERRUPTED, UNREAD = 1, 2, 3, 130, 141
"""Exit codes besides 0; the last two are a shell's for SIGINT and SIGPIPE."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code.

    Args:
        arguments: those of the command line, if left out.
    """
    try:
        return _run_command(argument_parser().parse_args(arguments))
    except KeyboardInterrupt as stop:
        return _tell(str(stop) or "interrupted before there was an answer", INTERRUPTED)
    except BrokenPipeError:  # what is left would be flushed at exit, and complained of
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD


def _run_command(asked: Namespace) -> int:
    """Run the command that the command line asks for; its exit code."""
    from ssp_lp import progress_shown
    from ssp_lp.errors import InfeasibleError, MissingDependencyError, SolverError, SSPError

    from .commands import COMMANDS, with_options

    try:
        shown = asked.verbose or (sys.stderr.isatty() and not asked.quiet)
        with warnings.catch_warnings(), progress_shown(shown, lasting=asked.verbose):
            warnings.showwarning = _warn_on_command_line
            for line in COMMANDS[asked.command](asked):
                print(line)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except SSPError as error:
        failed = FAILED if isinstance(error, (SolverError, MissingDependencyError)) else WRONG_INPUT
        code = INFEASIBLE if isinstance(error, InfeasibleError) else failed
        return _tell(with_options(error), code)
    except OSError as error:
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        return _tell(message, WRONG_INPUT)
    return 0


def _warn_on_command_line(message: Warning | str, *_: object, **__: object) -> None:
    """Write a warning on the standard error of the command line."""
    _tell(f"warning: {message}")


def _tell(words: str, code: int = 0) -> int:
    """Print a message that is no answer on the command line; its exit code."""
    print(f"ssp-lp: {words}", file=sys.stderr)
    return code
