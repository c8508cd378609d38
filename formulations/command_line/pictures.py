"""Pictures in files, drawn without a screen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ssp_lp import ModelError
from ssp_lp.errors import MissingDependencyError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure_for(path: str | None) -> Figure | None:
    """A figure that can be saved there, known before anything is solved; None: none is asked for.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: no picture has this ending.
    """
    if path is None:
        return None
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError("matplotlib", "plot") from error
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    known = figure.canvas.get_supported_filetypes()
    if Path(path).suffix.removeprefix(".") not in known:
        raise ModelError(f"a picture is written as {', '.join(sorted(known))}, not {path!r}")
    return figure
