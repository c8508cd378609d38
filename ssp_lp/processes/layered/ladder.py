"""The totals that are told apart, and where each step leads from each of them.

A ladder has one rung per total. Where the sums of step costs that can occur are few, they are the
rungs, and every step leads from rung to rung. Where they are too many, the rungs are a grid, and a
step that ends between two of them leads to both, in shares that keep its mean: as the value at a
price is concave in the cost already paid (each policy's is affine, and the best one's is the least
of them), interpolating it between rungs never exceeds it. So the process on a grid bounds the
optimum of case S from below (paper, section 3.1.1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.chunks import chunks
from ssp_lp.model.graph.kept import kept
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.processes.expectations import uniform_cost
from ssp_lp.processes.layered.lattice import Lattice, common_unit, layers_of

_SUMS_PER_RUNG = 5  # sums told apart rather than so many rungs of a grid
_ULPS = 1e-15  # relative: the rounding of one sum
_SAME = 1e-11
"""Totals this near to each other, relative to the cap, are one summed in two ways."""


@dataclass(frozen=True, eq=False)
class Ladder:
    """Rungs, the last of which stands for all totals beyond it as well."""

    rungs: FloatArray  # [rungs] increasing, the first is 0
    steps: FloatArray  # [steps] distinct costs of a step, increasing, the first is 0

    @property
    def size(self) -> int:
        """Number of rungs below the last."""
        return len(self.rungs) - 1

    @cached_property
    def exact(self) -> bool:
        """Whether every sum of steps up to the last rung is a rung."""
        below, share = self.leads
        gap = np.diff(self.rungs, append=np.inf)[below]
        return bool(((share == 0.0) | ((1.0 - share) * gap <= self._room)).all())

    @cached_property
    def leads(self) -> tuple[IntArray, FloatArray]:
        """Where each step leads from each rung.

        Returns:
            The rung below, and the share that goes to the one above that, [rungs, steps] each.
        """
        last, totals = self.size, self.rungs[:, None] + self.steps
        below = np.searchsorted(self.rungs, totals * (1.0 + _ULPS), side="right") - 1
        below = np.minimum(below, last)
        below[last] = last
        gap = np.diff(self.rungs, append=2.0 * self.rungs[-1] + 1.0)[below]
        share = np.where(below < last, np.clip((totals - self.rungs[below]) / gap, 0.0, 1.0), 0.0)
        return below, np.where(share * gap <= self._room, 0.0, share)  # down: never too dear

    @property
    def _room(self) -> float:
        """Totals that differ by so little are one."""
        return float(_SAME * self.rungs[-1])


_MOST_RUNGS = 1600  # of a grid, unless more are asked for
FIRST_RUNGS = 200
"""Rungs of a first grid."""

_MOST_SUMS = 20_000  # rungs up to which all sums are told apart, where there is room
_TYPICAL = 2.5  # cap of a first attempt, in costs given success of the safest policy
_MARGIN = 1.02  # beyond what a price asks for: the price still moves a little
_PRODUCTS = 50  # sums that are formed at once, times those that may be kept
_FEW = 16  # layers that a step may pass before sums are thought of
_STEPS_AHEAD = 32  # steps whose sums are counted
_FEWER = 4  # times as many layers as sums make the sums worth while
_LEAST_STEPS = 4.0  # a cap allows for, of the dearest kind
_MOST_ENTRIES = 200_000_000  # layers times pairs beyond which a grid is taken
_NEARBY = 1.1  # times a cap: no reason to move it by less
_GROWTH = 2.0  # of a cap that loses something


@dataclass(frozen=True)
class Rungs:
    """What is asked of a ladder."""

    cap: float | None = None  # the last total; None: a first guess
    grid: int = FIRST_RUNGS  # rungs, where the sums are too many
    most: int = 0  # sums that are told apart rather than taking a grid; 0: by the grid's size
    turn: int = 0  # of refining
    fixed: tuple[float, ...] | None = None  # the totals themselves

    def ladder(self, model: SSP, typical: float, room: int) -> Ladder:
        """The ladder for a model.

        Args:
            model: the model.
            typical: a cost given success.
            room: rungs for which there is room.
        """
        steps = step_lattice(model)[1]
        if self.fixed is not None:
            return Ladder(read_only(np.array(self.fixed)), steps)
        cap = _TYPICAL * typical if self.cap is None else self.cap
        cap = max(cap, _LEAST_STEPS * float(steps[-1])) or 1.0
        most = self.most or min(_MOST_SUMS, _SUMS_PER_RUNG * self.grid)
        sums = sums_of(steps, cap, min(most, room))
        if sums is not None:
            return Ladder(read_only(np.append(sums, cap)), steps)
        moving = int(min(np.ceil(2.0 * cap / steps[1]), 1e9))  # a step must not round to nothing
        rungs = max(self.grid, min(moving, self.most or _MOST_SUMS))
        return Ladder(read_only(np.linspace(0.0, cap, min(rungs, room) + 1)), steps)

    def up_to(self, price: float) -> Rungs:
        """With a cap at which failing is best, at a price that is about right."""
        return replace(self, cap=_MARGIN * price) if self.cap is None and price > 0.0 else self

    def finer(self, ladder: Ladder, price: float, most: int) -> Rungs | None:
        """A higher or a finer ladder.

        Args:
            ladder: the present one.
            price: what failing is worth.
            most: rungs that there is room for.
        """
        cap, wanted = float(ladder.rungs[-1]), _MARGIN * price
        if ladder.exact or _NEARBY * cap < wanted:
            higher = wanted if _NEARBY * cap < wanted <= 4.0 * cap else _GROWTH * cap
            return replace(self, cap=higher) if ladder.size < most else None
        finest, grid = min(self.most or _MOST_RUNGS, most), max(self.grid, ladder.size)
        if grid >= finest:
            return None
        higher = cap * _GROWTH if self.turn % 3 == 2 else cap  # either of the two may lose
        return replace(self, cap=higher, grid=min(2 * grid, finest), turn=self.turn + 1)


@kept
def wanted_rungs(model: SSP) -> Rungs | None:
    """Rungs for a model, or None where the multiples of its costs' unit serve.

    Args:
        model: the model.
    """
    if uniform_cost(model) is not None:
        return None
    steps = step_lattice(model)[1]
    if len(steps) <= 2:
        return None
    try:
        unit = common_unit(steps, model.exact_costs)
        per_step = int(layers_of(steps[-1:], unit, model.exact_costs)[0])
    except ModelError:
        return Rungs()
    if per_step <= _FEW:
        return None
    layers = _STEPS_AHEAD * per_step
    sums = sums_of(steps, _STEPS_AHEAD * float(steps[-1]), min(layers // _FEWER, _MOST_SUMS))
    if sums is not None:
        return Rungs(most=_MOST_SUMS)
    return Rungs() if layers * model.n_pairs > _MOST_ENTRIES else None


@kept
def step_lattice(model: SSP) -> tuple[Lattice, FloatArray]:
    """The model's distinct step costs in place of layers: each outcome's position among them.

    Args:
        model: the model.

    Returns:
        A lattice of one layer per distinct cost, and the costs, the first of which is 0.
    """
    going_on = ~(dead_ends(model) | model.goal_mask)
    found = [np.zeros(1)]
    for some in chunks(model.n_outcomes):
        moving = going_on[model.successors[some]] & (model.probabilities[some] > 0)
        found.append(np.unique(model.costs[some][moving]))
    steps = np.unique(np.concatenate(found))
    ahead = np.zeros(model.n_outcomes, dtype=np.int32)
    for some in chunks(model.n_outcomes):
        moving = going_on[model.successors[some]] & (model.probabilities[some] > 0)
        ahead[some] = np.where(moving, np.searchsorted(steps, model.costs[some]), 0)
    return Lattice(Fraction(1), ahead, len(steps)), read_only(steps)


def sums_of(steps: FloatArray, cap: float, most: int) -> FloatArray | None:
    """The sums of steps below a cap, increasing; None: there are more than so many."""
    moves, found = steps[1:], np.zeros(1)
    fresh, chunk = found, max(_PRODUCTS * (most + 1) // max(moves.size, 1), 1)
    while fresh.size:
        together = found
        for begin in range(0, fresh.size, chunk):
            reached = (fresh[begin : begin + chunk, None] + moves).ravel()
            reached = reached[reached < cap * (1.0 - _SAME)]
            together = np.unique(np.concatenate([together, reached]))
            together = together[np.diff(together, prepend=-np.inf) > _SAME * cap]
            if together.size > most:
                return None
        near = np.searchsorted(found, together - _SAME * cap)
        known = np.append(found, np.inf)[np.minimum(near, found.size)] - together <= _SAME * cap
        fresh, found = together[~known], together
    return found
