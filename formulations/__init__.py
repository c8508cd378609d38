"""Formulations: one criterion of the literature per file, all solved by ``ssp_lp.solve``.

They are imported from ``ssp_lp``, whose wheel contains this folder: ``from ssp_lp import MCMP``.
"""

import sys
from importlib import import_module

from ssp_lp.public_names import names_in_stub

_ON_DEMAND = names_in_stub(__name__, __file__)
PAGES = {
    name: module.rpartition(".")[2]
    for name, module in _ON_DEMAND.items()
    if module not in (f"{__name__}.comparison", "ssp_lp.formulation")
}
"""Module of each criterion, imported on first use."""

__all__ = sorted(_ON_DEMAND)


def __getattr__(name: str) -> object:
    """Import a criterion's module on first use, so that the command line starts at once."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    member = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = member
    return member


if __name__ == "formulations":  # a checkout's folder by its bare name: the same modules, not twins
    for _page in {*PAGES.values(), "comparison", "command_line.arguments", "command_line.commands"}:
        import_module(f"ssp_lp.formulations.{_page}")
    for _name in [name for name in sys.modules if name.startswith("ssp_lp.formulations")]:
        sys.modules[_name.removeprefix("ssp_lp.")] = sys.modules[_name]
