"""The command ``ssp-lp``: solve, check, draw and simulate models in files.

``ssp-lp --help`` lists the commands, ``ssp-lp solve --help`` explains one of them with examples.
The exit code is 0 for success, 1 if a method failed, 2 for wrong arguments or models, 3 if the
problem is infeasible, 130 after Ctrl-C, and 141 if the reader of the output closed it.

The commands are imported once the arguments are parsed: the library takes longer to load than most
commands take, and help should appear at once.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from .arguments import argument_parser

FAILED, WRONG_INPUT, INFEASIBLE, INTERRUPTED, UNREAD = 1, 2, 3, 130, 141
"""Exit codes of failures; the last two are those of shells after SIGINT and SIGPIPE."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        arguments: words of the command line; None: those of the process.
    """
    try:
        return _run_command(vars(argument_parser().parse_args(arguments)))
    except KeyboardInterrupt as stop:
        return _tell(str(stop) or "interrupted before there was an answer", INTERRUPTED)
    except BrokenPipeError:  # flushing the rest at exit would print a complaint
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD


def _run_command(asked: Mapping[str, Any]) -> int:
    """Run the command that parsed arguments name, and return its exit code."""
    from ssp_lp import progress_shown
    from ssp_lp.errors import InfeasibleError, MissingDependencyError, SolverError, SSPError

    from .commands import COMMANDS, with_options, with_property

    try:
        shown = asked["verbose"] or (sys.stderr.isatty() and not asked["quiet"])
        with warnings.catch_warnings(), progress_shown(shown, lasting=asked["verbose"]):
            warnings.showwarning = _warn_on_command_line
            for line in COMMANDS[asked["command"]](with_property(asked)):
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
    """Write a warning to standard error in the form of the command's own messages."""
    _tell(f"warning: {message}")


def _tell(words: str, code: int = 0) -> int:
    """Print a message to standard error, and return ``code``, the exit code."""
    print(f"ssp-lp: {words}", file=sys.stderr)
    return code
