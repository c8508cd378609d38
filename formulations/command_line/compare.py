"""``ssp-lp compare``: the criteria of the literature side by side."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable

from formulations.command_line.models import setting_of
from formulations.command_line.tables import as_json
from formulations.comparison import compare_criteria

_PLURAL = {
    "failure_budget": "failure_budgets",
    "penalty": "penalties",
    "reach_fraction": "reach_fractions",
    "cost_bound": "cost_bounds",
    "level": "levels",
}
_COLUMNS = ("objective", "expected_cost", "conditional_cost", "failure_probability", "price")


def run(asked: Namespace) -> Iterable[str]:
    """What is printed."""
    setting = setting_of(asked)
    given = {
        plural: getattr(asked, one)
        for one, plural in _PLURAL.items()
        if getattr(asked, one) is not None
    }
    compared = compare_criteria(setting.model, setting.start, **given)
    if not asked.json:
        return [compared.summary()]
    return as_json(
        [
            {"criterion": row.criterion, **dict(zip(_COLUMNS, row.numbers, strict=True)),
             "note": row.note}
            for row in compared.rows
        ]
    )  # fmt: skip
