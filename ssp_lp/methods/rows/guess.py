"""Where a search on many totals begins: ratio and prices of one on few."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.constrained_search import Pace, Rows
from ssp_lp.methods.rows.opening import Opening, opening
from ssp_lp.methods.rows.ratio import generated
from ssp_lp.options import SolveOptions
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.processes.totals.ladder import Rungs

_COARSE_RUNGS = 64  # of the grid that a search on totals begins with
_COARSE_GAP = 1e-4  # and how exactly it is solved


def by_name(compiled: CompiledConstrained, rows: Rows, values: FloatArray) -> dict[str, float]:
    """A value of each limited row, by its name."""
    names = [compiled.names[index - 1] for index in rows.index.tolist()]
    return dict(zip(names, values.tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Guess:
    """Where a finer search may begin."""

    ratio: float
    prices: dict[str, float]  # by name

    @property
    def kappa(self) -> float:
        """What failing is worth."""
        return self.ratio + self.prices.get(FAILURE_ROW, 0.0)

    def of(self, compiled: CompiledConstrained, opened: Opening) -> tuple[Opening, FloatArray]:
        """The ratio to begin with, and the prices of the limited rows."""
        named = by_name(compiled, opened.rows, np.zeros(len(opened.rows.index)))
        prices = np.array([self.prices.get(name, 0.0) for name in named])
        return replace(opened, rows=replace(opened.rows, ratio=self.ratio)), prices


def coarse_guess(stated: CompiledConstrained, options: SolveOptions) -> Guess:
    """Ratio and prices on a coarse grid of totals: from these the true ones are near."""
    coarse = replace(stated, rungs=Rungs(grid=_COARSE_RUNGS, most=_COARSE_RUNGS)).settled()
    pace = Pace(_COARSE_GAP, options.deadline)
    opened = opening(coarse, stated, pace)
    centre = np.zeros(len(opened.asked)), opened.unlimited
    found, ratio = generated(coarse, opened, pace, centre)
    return Guess(ratio, by_name(coarse, opened.rows, found.prices))
