"""Why no lottery keeps to all rows: the smallest set of rows that contradict each other.

That rows cannot be kept is proved by prices z >= 0 at which every policy's ``z @ activity`` exceeds
``z @ bounds`` (Farkas), never by the status of a program. Sets of rows are tried by size; where
there are too many, rows are taken away from a conflicting set as long as it stays one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import ATTAINABLE
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.pool import Pool, Rows
from ssp_lp.column_generation.stabilised_master import violation
from ssp_lp.options import SolveOptions

_MOST_SETS = 200


@dataclass(frozen=True, eq=False)
class Conflict:
    """Rows that no lottery keeps to together, with the proof."""

    rows: tuple[int, ...]  # positions
    shares: FloatArray  # [rows] > 0, sum 1: of each row in the sum that is too large
    least: float  # certified: the sum is at least this under every policy
    allowed: float  # the sum that the bounds allow

    def told(self, names: list[str], bounds: FloatArray, every: str) -> str:
        """The proof in words.

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


def proved_conflict(pool: Pool, rows: Rows, found: Generated) -> Conflict | None:
    """The conflict that phase 1 ended with, if its bound can be certified.

    Args:
        pool: the policies that it found.
        rows: the rows that it was about.
        found: how it ended.
    """
    sizes = pool.sizes(rows)
    prices = np.where(found.prices * sizes > ATTAINABLE, found.prices, 0.0)
    total = float(prices.sum())
    if total <= 0.0:
        return None
    shares = prices / total
    least = pool.proved(rows.weights(shares, 0.0)).bound
    allowed = float(shares @ rows.bounds)
    room = ATTAINABLE * allowed + 4.0 * len(shares) * MACHINE_EPSILON * allowed
    if least <= allowed + room:
        return None
    kept = tuple(np.flatnonzero(shares).tolist())
    return Conflict(kept, shares[list(kept)], least, allowed)


def smallest_conflict(pool: Pool, rows: Rows, first: Conflict, options: SolveOptions) -> Conflict:
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
                return _thinned(pool, rows, first, options)
            found = _conflict_among(pool, rows, some, options)
            if found is not None:
                return found
    return first


def _conflict_among(
    pool: Pool, rows: Rows, some: tuple[int, ...], options: SolveOptions
) -> Conflict | None:
    """A conflict among some rows, by position among all; None where they can be kept together."""
    part = rows.among(some)
    ended = generate(violation(pool, part), options)
    found = None if kept_to(ended, part) else proved_conflict(pool, part, ended)
    if found is None:
        return None
    return Conflict(tuple(some[k] for k in found.rows), found.shares, found.least, found.allowed)


def _thinned(pool: Pool, rows: Rows, first: Conflict, options: SolveOptions) -> Conflict:
    """A conflict none of whose rows can be left out."""
    conflict = first
    for row in first.rows:
        rest = tuple(k for k in conflict.rows if k != row)
        found = (
            _conflict_among(pool, rows, rest, options) if rest and row in conflict.rows else None
        )
        conflict = conflict if found is None else found
    return conflict


def kept_to(ended: Generated, rows: Rows) -> bool:
    """Whether phase 1 ended with every row kept, but for an excess that counts as none."""
    return bool((ended.excess * rows.scales <= ATTAINABLE * rows.bounds).all())
