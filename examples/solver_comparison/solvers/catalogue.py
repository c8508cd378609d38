"""The solvers of the comparison: this library's methods and its peers, by name.

Nothing heavy is imported here: a solver's own module is imported in the process that runs it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

LIBRARY, HIGHS, STORM, SEARCH = (
    f"{__package__}.{name}" for name in ("library", "highs", "storm", "scikit_decide")
)
PLAIN = {"SSP_LP_ACCELERATOR": "none"}
"""Without numba: a peer's memory is then its own, not that of compiling our model building."""
COMPILED = {"SSP_LP_ACCELERATOR": "numba"}
"""Compiled by the warm-up, whatever numba's cache holds, so that runs are independent."""


@dataclass(frozen=True)
class Solver:
    """A way to solve an instance."""

    name: str
    module: str  # its `prepare(ready, order, **options)` makes an instance ready for the solver
    package: str  # what it needs; its import is timed
    pip: str = ""  # how that is installed
    also_needs: str = ""  # a second package that must be there
    options: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    cases: str = "MSPC"  # what it is asked
    discounted: bool = False  # whether it needs a discount


@dataclass(frozen=True)
class Order:
    """The task of a process of the comparison."""

    instance: str
    solver: str
    time_limit: float  # seconds for one call
    repeat: int  # calls, where a call is short
    tolerance: float  # relative gap asked of this library


def _method(
    name: str, method: str, backend: str | None = None, environment: Mapping[str, str] | None = None
) -> Solver:
    return Solver(
        name,
        LIBRARY,
        package="ssp_lp",
        pip="pip install .",
        options={"method": method, "backend": backend},
        environment=environment or {},
        discounted=name == GAME,
    )


def _highs(method: str, also_needs: str = "", pip: str = "pip install highspy") -> Solver:
    return Solver(
        f"highs-{method}",
        HIGHS,
        package="highspy",
        pip=pip,
        also_needs=also_needs,
        options={"method": method},
        environment=PLAIN,
        cases="MS",
    )


def _storm(name: str, sound: bool, precision: str | None = None) -> Solver:
    return Solver(
        name,
        STORM,
        package="stormpy",
        pip="pip install 'stormpy>=2'",
        options={"sound": sound, "precision": precision},
        environment=PLAIN,
    )


GAME = "value iteration (game)"
"""The paper's own method, which needs a discount."""

QUICK_SOLVERS = (
    "columns",
    GAME,
    "lp-cvxpy",
    "highs-ipx",
    "storm",
    "storm-sound",
    "scikit-decide",
)
"""Solvers of the comparison of a minute: one of each kind, and Storm with proved bounds."""

SOLVERS = (
    _method("columns", "columns", environment=COMPILED),
    _method("columns-numpy", "columns", environment=PLAIN),
    _method(GAME, "game", environment=COMPILED),
    _method("lp-simplex", "lp", "highs-simplex"),
    _method("lp-ipx", "lp", "highs-ipx"),
    _method("lp-cvxpy", "lp", "cvxpy"),
    _highs("ipx"),
    _highs("hipo", also_needs="highspy_extras", pip="pip install highspy-extras"),
    _highs("pdlp"),
    _highs("hipdlp"),
    _storm("storm", sound=False),
    _storm("storm-sound", sound=True),
    _storm("storm-1e-9", sound=False, precision="1/1000000000"),
    Solver(
        "scikit-decide",
        SEARCH,
        package="skdecide",
        pip="pip install scikit-decide",
        environment=PLAIN,
        cases="MPC",
    ),
)
"""The solvers that are always compared; the methods of a later release join them."""


def solver_named(name: str) -> Solver:
    """Return the solver of a name; a name that is not in SOLVERS is taken as a method."""
    return next((s for s in SOLVERS if s.name == name), _method(name, name))


def solver_names() -> tuple[str, ...]:
    """Return the names of all solvers, including further methods of `solve`."""
    return (*(s.name for s in SOLVERS), "deterministic")
