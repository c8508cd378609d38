"""The full linear program: compile, choose a backend, check what it says."""

from ssp_lp.engines.lp.engine import BACKENDS, check_agreement, solve_program, solve_rows_program

__all__ = ["BACKENDS", "check_agreement", "solve_program", "solve_rows_program"]
