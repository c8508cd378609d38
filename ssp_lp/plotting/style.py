"""How every picture looks: colours that all can tell apart, and a second sign beside each."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ssp_lp.errors import ModelError, optional_module

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, PALE = "#333333", "#777777"


class Look(NamedTuple):
    """How one of several things in a picture is drawn: never by its colour alone."""

    colour: str
    line: str | tuple[int, tuple[int, ...]]
    marker: str
    hatch: str


LOOKS = (
    Look("#0072B2", "-", "o", "////"),
    Look("#D55E00", "--", "X", "\\\\\\\\"),
    Look("#009E73", "-.", "^", "...."),
    Look("#CC79A7", ":", "s", "xxxx"),
    Look("#000000", (0, (5, 1, 1, 1, 1, 1)), "D", "||||"),
)
"""Okabe and Ito's colours, which people with any colour vision can tell apart."""


def axes_or_new(ax: Axes | None, width: float = 6.4, height: float = 4.2) -> Axes:
    """The axes, or those of a new figure of pyplot's of this size in inches.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: these are no axes.
    """
    if ax is not None and not hasattr(ax, "plot"):
        raise ModelError(f"ax must be axes of matplotlib, or None for a new figure, not {ax!r}")
    if ax is not None:
        return ax
    pyplot = optional_module("matplotlib.pyplot", "plot")
    found: Axes = pyplot.subplots(figsize=(width, height), layout="constrained")[1]
    return found


def dress_axes(ax: Axes, x: str, y: str) -> None:
    """Give axes their style: name both, and leave out what says nothing."""
    ax.set(xlabel=x, ylabel=y)
    ax.set_axisbelow(True)
    ax.grid(color="#e5e5e5", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
