"""Any charge of the total cost, compiled: bounded reach, utilities, and risk given success."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import FloatArray, read_only
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    MOST_ENTRIES,
    CompiledLayered,
    LeastFailure,
    check_compiled_table,
)
from ssp_lp.compiled.deadline import check_time
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.processes.goal_reach import (
    ReachPolicy,
    goal_directed,
)
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost, accumulate_cost
from ssp_lp.processes.layered.charges import Charge, ExponentialCharge, TailValues
from ssp_lp.processes.layered.exponential_utility import MomentReach, cost_horizon, greatest_moment
from ssp_lp.processes.layered.layered_process import LayeredProcess, LayeredTails
from ssp_lp.processes.totals.ladder import Ladder
from ssp_lp.processes.totals.lattice import layers_within
from ssp_lp.processes.totals.step_sums import MOST_SUMS, step_lattice, sums_in

_FIRST_LAYERS = 64  # of a first attempt where nothing says how many are needed
_NEARLY = 1.25  # costs given success of a way to the goal: from there on failing may be best
_TYPICAL = 2.5  # layers of a first attempt, in costs given success of the safest policy

_MOST_LAYERS = 100_000
"""Layers of a charge that does not settle, after which the gap that is left is left."""

_DOUBLINGS = 60  # of a cap, if all sums that there are lie below it
_LOWER = 0.5  # cap, times the one whose sums are too many
_BEYOND = 1e-9  # relative distance of a total that lies beyond another
_MARGIN = 1.02  # layers beyond what a price asks for: the price still moves a little
_LEAST = 1e-12  # relative room below the goal probability of policies that all attain it


@dataclass(frozen=True, eq=False)
class CompiledArrivalCost(CompiledLayered):
    """Minimise E[charge(total cost); goal], or its ratio to Pr(goal), failure limited; exact.

    The table of accumulated costs ends where the charge has become affine: what is best beyond it
    follows in closed form, or, where the charge still grows, as in case S from the price on at
    which it is best to fail. A charge that never settles is cut and refined.
    """

    model: SSP
    start: FloatArray  # [states]
    charge: Charge
    ratio: bool = False
    safest_only: bool = False  # only policies of least failure
    cap: float | None = None  # total at which the table ends, in units; None: as the charge asks
    by_sums: bool = False  # totals are the sums of steps that can occur, and a unit is 1
    discount: None = None

    @property
    def is_trial(self) -> bool:
        """Whether the cap is a guess, to learn the price from: sums become many as it grows."""
        grows = self.charge.slope > 0.0 and not self.safest_only
        return self.by_sums and self.cap is None and grows

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process."""
        usable = self.greatest.usable if self.safest_only else None
        return accumulate_cost(
            self.model, self.start, None, arrivals=True, usable=usable, by_steps=self.by_sums
        )

    @cached_property
    def _moments(self) -> MomentReach | None:
        """The tail of an exponential utility."""
        if not isinstance(self.charge, ExponentialCharge):
            return None
        usable = self.greatest.usable if self.charge.bonus > 0.0 else None
        return greatest_moment(self.model, self.charge.rate, usable)

    @cached_property
    def cost_horizon(self) -> float:
        """Accumulated cost from which a stationary policy is optimal; 0 for other charges."""
        charge, moments = self.charge, self._moments
        if moments is None or not isinstance(charge, ExponentialCharge) or charge.bonus == 0.0:
            return 0.0
        return cost_horizon(self.model, self.greatest, moments, charge.rate, charge.bonus)

    @cached_property
    def process(self) -> LayeredProcess:
        """The process cut at the cap."""
        cap = self._first_guess() if self.cap is None else self.cap
        if self.by_sums:
            ladder = self._ladder(cap)
            while ladder is None:  # as far as there is room: the gap will tell
                check_time()
                cap *= _LOWER
                ladder = self._ladder(cap)
            return LayeredProcess(self.base, ladder.size, self._tails, self.charge, ladder)
        check_compiled_table(int(cap), self.base, "bound on them")
        return LayeredProcess(self.base, int(cap), self._tails, self.charge)

    def _ladder(self, cap: float) -> Ladder | None:
        """The sums of steps below a cap; None: there are too many."""
        room = min(MOST_SUMS, MOST_ENTRIES // max(self.base.n_nodes, 1))
        sums, steps = sums_in(self.model, cap, room), step_lattice(self.model)[1]
        if sums is None:
            return None
        return Ladder(read_only(np.append(sums, cap)), steps, complete=True)

    def _units(self, total: float) -> float:
        """A total in units, whole ones where layers are their multiples."""
        return total if self.by_sums else int(min(np.ceil(total / self.base.unit), 1e15))

    def _settled_units(self) -> float:
        """Where the charge has become affine, or the tail optimal; small where it never does."""
        settled = self.charge.settled or 0.0
        if isinstance(self.charge, ExponentialCharge):
            return max(self._units(self.cost_horizon), self._least_units)
        if self.base.width == 1 and not self.by_sums:
            return 1  # no step costs anything: nothing is ever paid
        if not self.by_sums:
            return max(layers_within(settled, self.base.exact_unit), 1)
        return max(settled * (1.0 + _BEYOND), self._least_units)

    @property
    def _least_units(self) -> float:
        """One layer; of sums, a table without any but that of nothing."""
        return _BEYOND * float(step_lattice(self.model)[1].max()) or 1.0 if self.by_sums else 1

    def _first_guess(self) -> float:
        """As many layers as are surely needed, and some more where that is not enough."""
        if self.is_trial:
            directed = goal_directed(self.model)
            cost, goal = float(self.start @ directed.cost), float(self.start @ directed.goal)
            return self._settled_units() + _NEARLY * cost / max(goal, 1e-300)
        goal = float(self.base.start @ self._tails.goal[0])
        cost = float(self.base.start @ self._tails.first.cost)
        typical = self._units(_TYPICAL * cost / max(goal, 1e-300))
        width = float(step_lattice(self.model)[1][-1]) if self.by_sums else self.base.width
        if self.charge.settled is None:
            first = typical if self.by_sums else _FIRST_LAYERS
            return max(first + width, self._least_units)
        if self.charge.slope == 0.0 or self.safest_only:
            return self._settled_units()
        return self._settled_units() + typical + width

    @cached_property
    def _tails(self) -> LayeredTails:
        """The tail policies that are followed, and charged, beyond the cap."""
        at, moments = self.base.quotient.least_over_members, self._moments
        first: ReachPolicy | MomentReach = self.safest_policy if moments is None else moments
        last, least_goal, least_cost = first, np.zeros(self.base.n_nodes), None
        if self.safest_only:
            least_goal = at(self.greatest.goal) * (1.0 - _LEAST)
            least_cost = at(self.safest_policy.cost_bound)
        elif self.ratio:  # else an arrival is never worse than failing
            least, last = self.riskiest
            least_goal = at(least.bound)
        both = (first, last)
        return LayeredTails(
            decisions=np.stack([p.decision for p in both]).astype(np.int32),
            values=TailValues.stacked([p.values for p in both], at),
            greatest_goal=-at(-self.greatest.bound),
            least_goal=least_goal,
            least_cost=least_cost,
            greatest_moment=None if moments is None else -at(-moments.bound),
        )

    @property
    def lowest(self) -> float:
        """No objective is less."""
        return self.charge.lowest

    def least_failure(self) -> LeastFailure:
        """The least charged of the policies that fail least, which may remember the cost."""
        pricing = self.safest().pricing()
        best = pricing.minimise(0.0)
        policy = pricing.policy(best)
        bound = pricing.prove(0.0, best).bound
        greatest = min(float(self.start @ self.greatest.bound), 1.0)
        if self.ratio:
            bound = bound / greatest if greatest > 0.0 else 0.0
        return LeastFailure(policy, replace(best, choice=None, policy=policy), bound)

    def lossless_units(self, price: float) -> float:
        """Where it is best to fail from then on at this price of failure, with some room.

        As many units as the charge needs to settle where it grows no more from there.
        """
        charge, settled = self.charge, self._settled_units()
        if charge.slope == 0.0:
            return settled
        room = 0 if self.by_sums else 1
        return max(settled, self._units(_MARGIN * charge.lossless(price)) + room)

    def refined(self, price: float) -> CompiledArrivalCost | None:
        """More layers: as the price asks where the charge grows, else twice as many."""
        here, charge = self.process.end, self.charge
        wanted = 2 * here
        if charge.settled is None:
            wanted = wanted if self.by_sums else min(wanted, _MOST_LAYERS)
        elif charge.slope == 0.0 or self.safest_only:
            return None
        else:
            lossless = self.lossless_units(price)
            near = self.is_trial or here < lossless
            wanted = lossless if near and lossless <= 4 * here else wanted
        if self.by_sums:
            fits = self._ladder(wanted) is not None
            if not fits and not self.is_trial:
                return None
            return self.charging(charge, wanted if fits else here)  # a trial's table, for good
        too_large = (wanted + self.base.width) * self.base.n_nodes > MOST_ENTRIES
        if too_large or wanted <= here:
            return None
        return self.charging(charge, wanted)

    def charging(self, charge: Charge, cap: float | None = None) -> CompiledArrivalCost:
        """The same process with another charge and cap; what charges share is worked out once.

        An exponential reward has tails of its own.
        """
        kept: tuple[str, ...] = ("base",)
        exponential = (isinstance(c, ExponentialCharge) for c in (charge, self.charge))
        if charge == self.charge or not any(exponential):
            vars(self)["_tails"] = self._tails
            kept = ("base", "_tails", "_moments", "cost_horizon")
        return self._handing_on(replace(self, charge=charge, cap=cap), *kept)

    def safest(self) -> CompiledArrivalCost:
        """The same among the policies of least failure."""
        return self._handing_on(replace(self, safest_only=True, cap=None))

    def for_program(self) -> CompiledArrivalCost:
        """Itself: its tails are optimal beyond the cap."""
        return self

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledArrivalCost:
        """The same problem with as many layers as the value function, [layers, nodes].

        Args:
            values: the value function.
            levels: totals of a policy found beside it, the last of which is the cap.

        Raises:
            ModelError: the array has fewer layers than the charge needs to settle.
        """
        least = self._settled_units()
        if values.ndim != 2 or values.shape[0] < (1 if self.by_sums else least):
            raise ModelError(f"a value function of {least} or more layers is needed")
        if not self.by_sums:
            return self.charging(self.charge, values.shape[0])
        cap, n_layers, found = least, values.shape[0], None
        if levels is not None and levels[-1] >= least:
            known = self.charging(self.charge, float(levels[-1]))
            if known.process.cap == n_layers:
                return known
        for _ in range(_DOUBLINGS):
            if (ladder := self._ladder(cap)) is None:
                break
            if ladder.size >= n_layers:  # the greatest cap below which there are so many sums
                found = float(ladder.rungs[n_layers])
            if ladder.size > n_layers:
                break
            cap *= 2.0
        if found is None:
            raise ModelError("a value function of fewer layers is needed")
        return self.charging(self.charge, found)
