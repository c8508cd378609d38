"""Phase 1: a lottery that keeps to all rows, or the smallest set of rows that none keeps to.

That rows cannot be kept is proved by prices z >= 0 at which every policy's ``z @ activity`` exceeds
``z @ bounds`` (Farkas), never by the status of a program. Sets of rows are tried by size; where
there are too many, rows are taken away from a conflicting set as long as it stays one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import ATTAINABLE, CompiledConstrained
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.stabilised_master import StabilisedMaster, violation_in_master
from ssp_lp.compiled.deadline import Stop, closing
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.methods.assembling import Found
from ssp_lp.methods.full_program import ProgramOptimum, solve_rows_program
from ssp_lp.options import LinearProgramming, SolveOptions
from ssp_lp.processes.failure_semantics import survival_of
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.quantities.conditions import FAILURE_ROW


def phase_one_opening(
    compiled: CompiledConstrained, stated: CompiledConstrained, options: SolveOptions
) -> StabilisedMaster:
    """The cheapest policy of all, and more until some lottery keeps to all rows (phase 1).

    Args:
        compiled: at least failure, where the stated budget is equal to that.
        stated: the problem with the budget that was stated.
        options: tolerance and limits.

    Returns:
        The search for the least cost to begin with: its rows raised where they lie below what is
        attainable by rounding, and in case S with the ratio of some lottery.
    """
    pricing = compiled.pricing
    pool = Pool(pricing, [pricing.first()])
    cheapest = pool.priced(np.eye(1, pricing.rewards.shape[1])[0])
    pool.add(cheapest)
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    rows = pool.rows(1 + limited, compiled.bounds[limited])
    ended = generate(violation_in_master(pool, rows), options)
    if _kept_to(ended, rows):
        raised = rows.relaxed(ended.excess)
        ratio = _first_ratio(pool, ended) if compiled.ratio else 0.0
        at_none = np.zeros(len(limited)), cheapest.cost
        return StabilisedMaster(pool, replace(raised, ratio=ratio), *at_none)
    if compiled.budget is None and stated.budget is not None:
        anyhow = replace(stated, budget=1.0)
        phase_one_opening(
            anyhow, anyhow, options
        )  # raises where the limits contradict each other anyhow
    with closing():
        first = _proved_conflict(pool, rows, ended)
    if first is None and not ended.finished:
        raise Stop
    if first is None:
        raise SolverError(
            "no policy within all limits was found, and it was not proved that there is none: "
            "rounding ended the search"
        )
    conflict = _smallest_conflict(pool, rows, first, options)
    raise _refusal_in_phase_one(compiled, stated, conflict, rows)


def _first_ratio(pool: Pool, ended: Generated) -> float:
    """A ratio for phase 1 to begin with: that of the known lottery, or some policy's."""
    attained = ended.ratio
    if np.isfinite(attained) and attained > 0.0:
        return attained
    with np.errstate(divide="ignore", invalid="ignore"):
        known = pool.figures[0] / (1.0 - pool.figures[1])
    known = known[np.isfinite(known) & (known > 0.0)]
    return float(known.max()) if known.size else 1.0


def _refusal_in_phase_one(
    compiled: CompiledConstrained, stated: CompiledConstrained, conflict: _Conflict, rows: Rows
) -> InfeasibleError:
    """The conflict as an error, with the least failure of all policies."""
    at_least, budget = compiled.budget is None, stated.budget
    places = [int(rows.index[k]) - 1 for k in conflict.rows]
    named = [compiled.names[k] for k in places]
    every = "every policy of least failure" if at_least else "every policy"
    told = conflict.told(
        [compiled.told[k] for k in places], rows.bounds[list(conflict.rows)], every
    )
    if at_least and budget is not None:
        told = f"no policy keeps to {FAILURE_ROW!r} <= {budget:.12g} and the limits: {told}"
        named = [FAILURE_ROW, *named]
    discount = compiled.discount
    return InfeasibleError(
        told,
        failure_budget=budget,
        least_failure=_least_failure_in_phase_one(compiled, None),
        least_discounted_failure=None
        if discount is None
        else _least_failure_in_phase_one(compiled, discount),
        conflicting_rows=tuple(named),
    )


def _least_failure_in_phase_one(compiled: CompiledConstrained, discount: float | None) -> float:
    """The least failure of all policies, for phase 1."""
    reach = greatest_goal_reach(compiled.model, survival_of(discount), compiled.start).goal
    return max(1.0 - float(compiled.start @ reach), 0.0)


_MOST_SETS = 200


@dataclass(frozen=True, eq=False)
class _Conflict:
    """Rows that no lottery keeps to together, with the proof."""

    rows: tuple[int, ...]  # positions
    shares: FloatArray  # [rows] > 0, sum 1: of each row in the sum that is too large
    least: float  # certified: the sum is at least this under every policy
    allowed: float  # the sum that the bounds allow

    def told(self, names: list[str], bounds: FloatArray, every: str) -> str:
        """The proof of phase 1's conflict in words.

        Args:
            names: of the rows of the conflict.
            bounds: of the same, [rows].
            every: which policies there are, such as "every policy".
        """
        digits = next(
            (d for d in (6, 9, 12) if f"{self.least:.{d}g}" != f"{self.allowed:.{d}g}"), 17
        )
        least, allowed = f"{self.least:.{digits}g}", f"{self.allowed:.{digits}g}"
        if len(names) == 1:
            return f"{names[0]!r} is at least {least} under {every}, {allowed} allowed"
        asked = [f"{name!r} <= {bound:.12g}" for name, bound in zip(names, bounds, strict=True)]
        together = f"{', '.join(asked[:-1])} and {asked[-1]}"
        terms = zip(self.shares, names, strict=True)
        total = " + ".join(f"{share:.{digits}g} {name}" for share, name in terms)
        return (
            f"no policy keeps to {together} together: {total} is at least {least} under {every}, "
            f"{allowed} allowed"
        )


def _proved_conflict(pool: Pool, rows: Rows, found: Generated) -> _Conflict | None:
    """The conflict that phase 1 ended with, if its bound can be certified.

    Args:
        pool: the policies that it found.
        rows: the rows that it was about.
        found: how it ended.
    """
    sizes = pool.sizes(rows)
    matters = found.prices * sizes > ATTAINABLE * min(found.objective, 1.0)
    prices = np.where(matters, found.prices, 0.0)
    total = float(prices.sum())
    if total <= 0.0:
        return None
    shares = prices / total
    least = pool.proved(rows.weights(shares, 0.0)).bound
    allowed = float(shares @ rows.bounds)
    room = (ATTAINABLE + 4.0 * len(shares) * MACHINE_EPSILON) * max(allowed, 0.0)
    if least <= allowed + room:
        return None
    kept = tuple(np.flatnonzero(shares).tolist())
    return _Conflict(kept, shares[list(kept)], least, allowed)


def _smallest_conflict(
    pool: Pool, rows: Rows, first: _Conflict, options: SolveOptions
) -> _Conflict:
    """The smallest conflict that can be found.

    Args:
        pool: policies to begin with; what is found is added.
        rows: all rows.
        first: a conflict among them.
        options: tolerance and limits.
    """
    tried = 0
    for size in range(1, len(first.rows)):
        for some in combinations(range(len(rows.index)), size):
            tried += 1
            if tried > _MOST_SETS:
                return _thinned_conflict(pool, rows, first, options)
            found = _conflict_among(pool, rows, some, options)
            if found is not None:
                return found
    return first


def _conflict_among(
    pool: Pool, rows: Rows, some: tuple[int, ...], options: SolveOptions
) -> _Conflict | None:
    """A conflict among some rows, by position among all; None where they can be kept together."""
    part = rows.among(some)
    ended = generate(violation_in_master(pool, part), options)
    found = None if _kept_to(ended, part) else _proved_conflict(pool, part, ended)
    if found is None:
        return None
    return _Conflict(tuple(some[k] for k in found.rows), found.shares, found.least, found.allowed)


def _thinned_conflict(pool: Pool, rows: Rows, first: _Conflict, options: SolveOptions) -> _Conflict:
    """A conflict none of whose rows can be left out."""
    conflict = first
    for row in first.rows:
        rest = tuple(k for k in conflict.rows if k != row)
        found = (
            _conflict_among(pool, rows, rest, options) if rest and row in conflict.rows else None
        )
        conflict = conflict if found is None else found
    return conflict


def _kept_to(ended: Generated, rows: Rows) -> bool:
    """Whether phase 1 ended with every row kept, but for an excess that counts as none."""
    return bool((ended.excess * rows.scales <= ATTAINABLE * rows.bounds).all())


def begun_at_guess(
    compiled: CompiledConstrained, opened: StabilisedMaster, guess: Found
) -> StabilisedMaster:
    """The same search, begun at the ratio and the prices of another one."""
    ratio = guess.value if compiled.ratio else 0.0
    rows = replace(opened.rows, ratio=ratio or opened.rows.ratio)
    named = by_name(compiled, rows, np.zeros(len(rows.index)))
    prices = np.array([guess.prices.get(name, 0.0) for name in named])
    return replace(opened, rows=rows, prices=prices, bound=0.0)


def begun_at_duals(
    compiled: CompiledConstrained,
    opened: StabilisedMaster,
    asked: LinearProgramming,
    deadline: float,
) -> tuple[ProgramOptimum, StabilisedMaster]:
    """The optimum of the full linear program, and the search begun at its duals."""
    pricing, rows = compiled.pricing, opened.rows
    limits = {
        compiled.names[index - 1]: (pricing.rewards[:, index], float(bound))
        for index, bound in zip(rows.index.tolist(), rows.bounds, strict=True)
    }
    process = replace(pricing.process, cost=np.ascontiguousarray(pricing.rewards[:, 0]))
    program = solve_rows_program(process, limits, asked.backend, deadline, ratio=compiled.ratio)
    prices = np.array([program.prices[name] for name in limits])
    if compiled.ratio:
        rows = replace(rows, ratio=program.objective or rows.ratio)
    weights = rows.weights(prices)
    found = opened.pool.priced(weights)
    opened.pool.add(found)
    bound = float(found.figures @ weights) - float(prices @ rows.bounds)
    return program, replace(opened, rows=rows, prices=prices, bound=bound)


def by_name(compiled: CompiledConstrained, rows: Rows, values: FloatArray) -> dict[str, float]:
    """A value of phase 1 for each limited row, by its name."""
    names = [compiled.names[index - 1] for index in rows.index.tolist()]
    return dict(zip(names, values.tolist(), strict=True))
