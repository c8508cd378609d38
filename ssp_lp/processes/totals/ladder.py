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
from functools import cached_property

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, read_only
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph.kept import kept
from ssp_lp.processes.expectations import uniform_cost
from ssp_lp.processes.totals.lattice import common_unit, layers_of
from ssp_lp.processes.totals.step_sums import MOST_SUMS, last_steps, room_of, step_lattice, sums_in

_SUMS_PER_RUNG = 5  # sums told apart rather than so many rungs of a grid
_ULPS = 1e-15  # relative: the rounding of one sum
_SHARE = 1e-3  # of the cheapest step: less than that is none


@dataclass(frozen=True, eq=False)
class Ladder:
    """Rungs, the last of which stands for all totals beyond it as well."""

    rungs: FloatArray  # [rungs] increasing, the first is 0
    steps: FloatArray  # [steps] distinct costs of a step, increasing, the first is 0
    complete: bool = False  # known to be all sums that can occur

    @property
    def size(self) -> int:
        """Number of rungs below the last."""
        return len(self.rungs) - 1

    @cached_property
    def exact(self) -> bool:
        """Whether every sum of steps up to the ladder's last rung is a rung."""
        if self.complete:
            return True
        below, share = self.leads
        gap = np.diff(self.rungs, append=np.inf)[below]
        return bool(((share == 0.0) | ((1.0 - share) * gap <= self._room)).all())

    @cached_property
    def leads(self) -> tuple[IntArray, FloatArray]:
        """Where each step leads from each rung of the ladder.

        Returns:
            The rung below, and the share that goes to the one above that, [rungs, steps] each.
        """
        last, totals = self.size, self.rungs[:, None] + self.steps
        nearly = self._room if self.complete else _ULPS * totals
        below = np.searchsorted(self.rungs, totals + nearly, side="right") - 1
        below = np.minimum(below, last)
        below[last] = last
        gap = np.diff(self.rungs, append=2.0 * self.rungs[-1] + 1.0)[below]
        share = np.where(below < last, np.clip((totals - self.rungs[below]) / gap, 0.0, 1.0), 0.0)
        return below, np.where(share * gap <= self._room, 0.0, share)  # down: never too dear

    @property
    def _room(self) -> float:
        """Totals that differ by so little are one rung."""
        return room_of(self.steps, float(self.rungs[-1]))


_MOST_RUNGS = 1600  # of a grid, unless more are asked for
FIRST_RUNGS = 200
"""Rungs of a first grid."""

_MARGIN = 1.02  # beyond what a price asks for: the price still moves a little
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

    def ladder(self, model: SSP, first: float, room: int, *, grows: bool = True) -> Ladder:
        """The ladder for a model.

        Args:
            model: the model.
            first: the last total of a first attempt.
            room: rungs for which there is room.
            grows: whether what arriving is charged still grows there.
        """
        steps = step_lattice(model)[1]
        if self.fixed is not None:
            sums = sums_in(model, self.fixed[-1], len(self.fixed))
            known = np.array(self.fixed[:-1])
            complete = sums is not None and len(sums) == len(known) and np.allclose(sums, known)
            return Ladder(read_only(np.array(self.fixed)), steps, complete)
        cap = first if self.cap is None else self.cap
        least = _LEAST_STEPS * float(steps[-1]) if grows else _SHARE * float(steps[1:2].sum())
        cap = max(cap, least) or 1.0
        most = self.most or min(MOST_SUMS, _SUMS_PER_RUNG * self.grid)
        sums = sums_in(model, cap, min(most, room))
        if sums is not None:
            return Ladder(read_only(np.append(sums, cap)), steps, complete=True)
        moving = int(min(np.ceil(2.0 * cap / steps[1]), 1e9))  # a step must not round to nothing
        rungs = max(self.grid, min(moving, self.most or MOST_SUMS))
        return Ladder(read_only(np.linspace(0.0, cap, min(rungs, room) + 1)), steps)

    def up_to(self, total: float) -> Rungs:
        """A ladder with a cap at which failing is best, where that is known to be about there."""
        return replace(self, cap=_MARGIN * total) if self.cap is None and total > 0.0 else self

    def finer(self, ladder: Ladder, enough: float | None, most: int) -> Rungs | None:
        """A higher or a finer ladder; None: there is no room, or nothing to be gained.

        Args:
            ladder: the present one.
            enough: total from which on failing is best, 0: unknown; None: the cap loses nothing.
            most: rungs that there is room for.
        """
        cap, wanted = float(ladder.rungs[-1]), _MARGIN * (enough or 0.0)
        if enough is not None and (ladder.exact or _NEARBY * cap < wanted):
            higher = wanted if _NEARBY * cap < wanted <= 4.0 * cap else _GROWTH * cap
            return replace(self, cap=higher) if ladder.size < most else None
        finest, grid = min(self.most or _MOST_RUNGS, most), max(self.grid, ladder.size)
        if grid >= finest or ladder.exact:
            return None
        lower = enough is not None and self.turn % 3 == 2  # either of the two may lose
        higher = cap * _GROWTH if lower else cap
        return replace(self, cap=higher, grid=min(2 * grid, finest), turn=self.turn + 1)


def rungs_for(model: SSP, asked: int | None, cap: float | None, *, of_law: bool) -> Rungs | None:
    """What is asked of a ladder; None where multiples of a unit serve.

    They do not where costs that are told apart have no common unit, or one so small that the sums
    that can occur are far fewer than its multiples.

    Args:
        model: the model.
        asked: rungs at most, as a user says; None: nothing is said.
        cap: the last total, likewise.
        of_law: whether steps into the goal have to be told apart as well.
    """
    if asked is not None:
        return Rungs(cap, grid=min(int(asked), FIRST_RUNGS), most=int(asked))
    found = wanted_rungs_of_law(model) if of_law else wanted_rungs(model)
    return found if found is None or cap is None else replace(found, cap=cap)


@kept
def wanted_rungs(model: SSP) -> Rungs | None:
    """Rungs for a model, or None where the multiples of its costs' unit serve.

    Args:
        model: the model.
    """
    return _wanted_of_ladder(model, step_lattice(model)[1][:1])


@kept
def wanted_rungs_of_law(model: SSP) -> Rungs | None:
    """The same where the steps into the goal have to be told apart as well."""
    return _wanted_of_ladder(model, last_steps(model)[1])


def _wanted_of_ladder(model: SSP, last: FloatArray) -> Rungs | None:
    """What a ladder needs, beside steps that only end a run, [steps]."""
    if uniform_cost(model) is not None:
        return None
    steps = step_lattice(model)[1]
    every = np.union1d(steps, last)
    if len(every) <= 2:
        return _is_far_below_rungs(model, every)
    ahead = _STEPS_AHEAD * float(every[-1])
    try:
        unit = common_unit(every, model.exact_costs)
        per_step = int(layers_of(every[-1:], unit, model.exact_costs)[0])
    except ModelError:
        return Rungs() if sums_in(model, ahead, MOST_SUMS) is None else Rungs(most=MOST_SUMS)
    if per_step <= _FEW:
        return _is_far_below_rungs(model, every)
    layers = _STEPS_AHEAD * per_step
    if sums_in(model, ahead, min(layers // _FEWER, MOST_SUMS)) is not None:
        return Rungs(most=MOST_SUMS)
    return Rungs() if layers * model.n_pairs > _MOST_ENTRIES else None


def _is_far_below_rungs(model: SSP, steps: FloatArray) -> Rungs | None:
    """Sums, where a last step passes too many multiples of the unit and the sums are few enough."""
    ahead = _STEPS_AHEAD * float(last_steps(model)[1][-1])
    unit = float(common_unit(steps, model.exact_costs))
    if not steps[-1] > 0.0 or ahead * model.n_pairs <= _MOST_ENTRIES * unit:
        return None
    return None if sums_in(model, ahead, MOST_SUMS) is None else Rungs(most=MOST_SUMS)
