"""``ssp-lp program``: the linear program of a criterion, shown or written."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable

from formulations.command_line.criteria import problem_of
from formulations.command_line.models import setting_of
from ssp_lp.methods.program import program_of


def run(asked: Namespace) -> Iterable[str]:
    """What is printed."""
    program = program_of(problem_of(asked, setting_of(asked)))
    if asked.out is not None:
        program.write(asked.out)
    return [repr(program)]
