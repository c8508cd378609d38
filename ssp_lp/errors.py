"""The error tree: one class per remedy, all under :class:`SSPError`."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


class SSPError(Exception):
    """Root of every error that this library raises on purpose."""


class ModelError(SSPError, ValueError):
    """The model or the problem is stated wrongly; the message names the place and the remedy."""


class InfeasibleError(SSPError):
    """No policy respects the failure budget and the limits.

    Attributes:
        failure_budget: the budget that was asked for (``None``: none was).
        least_failure: the least failure probability that any policy attains.
        least_discounted_failure: the least discounted failure, ``None`` in the exact setting. The
            surrogate can be infeasible where the real problem is not (paper, Theorem t2-2).
        conflicting_rows: names of the fewest rows found that contradict each other: limits, and
            "failure" for the budget; empty where no rows were looked for.
    """

    def __init__(
        self,
        message: str,
        *,
        failure_budget: float | None,
        least_failure: float,
        least_discounted_failure: float | None = None,
        conflicting_rows: tuple[str, ...] = (),
    ) -> None:
        super().__init__(message)
        self.failure_budget = failure_budget
        self.least_failure = least_failure
        self.least_discounted_failure = least_discounted_failure
        self.conflicting_rows = conflicting_rows


class SolverError(SSPError, RuntimeError):
    """A method did not deliver an answer that passes its check; says what was tried."""


class OutOfTimeError(SolverError):
    """The time limit passed before any policy that keeps to the limits was found."""


class MissingDependencyError(SSPError, ImportError):
    """An optional package is not installed; the message carries the pip line.

    Args:
        package: the package that could not be imported.
        extra: the extra of ``ssp-lp`` that brings it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed: pip install 'ssp-lp[{extra}]'")
        self.package = package
        self.extra = extra


def optional_module(name: str, extra: str) -> ModuleType:
    """Import a module of an optional package.

    Args:
        name: of the module, with that of the package in front ("matplotlib.pyplot").
        extra: the extra of ``ssp-lp`` that brings the package.

    Raises:
        MissingDependencyError: the package is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError(name.partition(".")[0], extra) from error
