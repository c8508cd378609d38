"""ssp-lp: reach the goal as cheaply as possible, and fail with probability at most epsilon.

Public names are imported on first use, the criteria of ``formulations`` included:
``from ssp_lp import SSP, MCMP, solve``.
"""

import sys
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

from ssp_lp.public_names import names_in_stub

__version__ = "0.1.0"

_ON_DEMAND = names_in_stub(__name__, __file__)
__all__ = sorted(_ON_DEMAND)


def _add_formulations() -> None:
    """Make the modules of ``formulations`` importable as ``ssp_lp.formulations``.

    A wheel contains them inside the package, and a checkout has them beside it. The modules have
    the same names in both cases. So a pickle that was written with a wheel can be read in a
    checkout, and another package called ``formulations`` does no harm.
    """
    inner = f"{__name__}.formulations"
    if find_spec(inner) is None:
        beside = Path(__file__).parents[1] / "formulations" / "__init__.py"
        spec = spec_from_file_location(inner, beside)
        if spec is None or spec.loader is None or not beside.exists():
            raise ImportError(f"{__name__} is not complete: there is no {beside}")
        sys.modules[inner] = globals()["formulations"] = module_from_spec(spec)
        spec.loader.exec_module(sys.modules[inner])


_add_formulations()


def __dir__() -> list[str]:
    """Return all public names, including names that are not imported yet."""
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    """Import a public name on first use, so that ``ssp-lp --help`` starts fast."""
    if name in _ON_DEMAND:
        globals()[name] = member = getattr(import_module(_ON_DEMAND[name]), name)
        return member
    if name.isidentifier() and name[0] != "_" and find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    if name[:1] == "_":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ssp_lp.errors import did_you_mean

    message = f"there is no {name} in {__name__}{did_you_mean(name, __all__)}"
    # ``from ssp_lp import`` replaces the text of an AttributeError, and ``hasattr`` needs one
    if sys._getframe(1).f_code.co_name == "_handle_fromlist":
        raise ImportError(message, name=__name__)
    raise AttributeError(message)
