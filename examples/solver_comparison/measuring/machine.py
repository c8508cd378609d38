"""The machine and the versions that a comparison ran with."""

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from examples.solver_comparison.measuring.memory import physical_memory, usable_cores

_PACKAGES = (
    "ssp-lp", "numpy", "scipy", "numba", "clarabel", "cvxpy", "highspy", "highspy-extras",
    "stormpy", "scikit-decide",
)  # fmt: skip


def describe_machine() -> dict[str, Any]:
    """Return cores, memory and versions as a JSON object."""
    return {
        "cores": usable_cores(),
        "memory_gb": round(physical_memory() / 1e9, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def machine_text(machine: dict[str, Any]) -> str:
    """Return a machine in one line."""
    found = ", ".join(f"{n} {v}" for n, v in machine["packages"].items() if v)
    return (
        f"{machine['cores']} cores, {machine['memory_gb']:g} GB, {machine['system']}, "
        f"Python {machine['python']}; {found}"
    )


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
