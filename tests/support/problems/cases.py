"""The published models and the values expected of them, and one model's values by hand."""

from fractions import Fraction

from examples.reference_values.published import (
    CLOSE,
    FOLDER,
    NAMES,
    PUBLISHED,
    Case,
    Transitions,
    expected,
    load_case,
    published,
    raw_case,
)

__all__ = [
    "CLOSE",
    "FOLDER",
    "NAMES",
    "PUBLISHED",
    "ROBOT_VALUES",
    "Case",
    "Transitions",
    "expected",
    "load_case",
    "published",
    "raw_case",
]

ROBOT_VALUES = [
    ("anywhere", False, Fraction(19, 12)),
    ("attention", False, Fraction(19, 12)),
    ("dead_ends", False, Fraction(151, 84)),
    ("anywhere", True, Fraction(7, 3)),
    ("attention", True, Fraction(7, 3)),
    ("dead_ends", True, Fraction(107, 42)),
]
"""prism_robot_goal1 at P(goal) >= 1/4: give_up, charge_failing_step, least cost."""
