"""The base of all formulations: what every criterion can do once it is stated."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from ssp_lp.problem import Problem
    from ssp_lp.programs.occupation_program import OccupationProgram


class Formulation:
    """A criterion on a model with a start, see :class:`ssp_lp.problem.Problem`."""

    def program(self) -> OccupationProgram:
        """The linear program over expected visits whose optimum is the problem's.

        Raises:
            ModelError: the criterion is no linear program.
            InfeasibleError: the failure budget is below the least failure.
        """
        from ssp_lp.methods.program import program_of

        return program_of(cast("Problem", self))
