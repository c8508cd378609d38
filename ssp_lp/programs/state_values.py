"""The value function of a program: the duals of its balance, by state and action."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram


@dataclass(frozen=True, eq=False)
class StateValues:
    """The least that can follow, what each row counts charged at its price.

    ``values["depot"]`` is a state's value. Over the start they sum to c* plus price times bound of
    each row. In case S what follows is the cost less c* times the goal's probability, so that the
    sum is price times bound alone.
    """

    program: OccupationProgram
    states: FloatArray  # [process states]
    reduced_costs: FloatArray  # [pairs] what each costs more than the best of its state

    def __getitem__(self, state: Hashable) -> float:
        """A state's value."""
        return self.at(state)

    def at(
        self, state: Hashable, action: Hashable | None = None, cost: float | None = None
    ) -> float:
        """A state's value; with an action, the least that follows where that is taken first.

        Args:
            state: a state in which the problem is open.
            action: one of its actions, ``GIVE_UP`` or ``"stay for ever"``.
            cost: in case S the cost paid before, one that the program tells apart.

        Raises:
            ModelError: no such state or action, or none that the program has.
        """
        if action is not None:
            return self.at(state, cost=cost) + self.advantage(state, action, cost)
        program = self.program
        columns = [k for k in program.columns(state) if cost in (None, program.label(k).cost)]
        rows = np.unique(program.process.pair_state[columns].astype(np.int64))
        if len(rows) != 1:
            like = map(program.label, columns[:1])
            such = "".join(f", such as that of {label.state!r}{label.paid}" for label in like)
            told = f"state {state!r} has {len(rows):,} rows of balance at this cost"
            raise ModelError(f"{told}: one is asked for{such}")
        return float(self.states[rows[0]])

    def advantage(self, state: Hashable, action: Hashable, cost: float | None = None) -> float:
        """What an action costs more than the best one of its state: 0 of those that are optimal.

        Raises:
            ModelError: no such column, or several.
        """
        return float(self.reduced_costs[self.program.column(state, action, cost)])
