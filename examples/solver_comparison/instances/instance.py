"""The instances of the comparison by name, such as ``robot-20x12-M`` or ``random-5000-M``.

    robot-SEGMENTSxHEADINGS-CASE     the paper's robot, refined
    random-STATES-CASE               a random sparse model
    grid-300-M, layered-1000x100-M   ... a family of `families`
    triangle-30-M, navigation-20x20-M  ... a published domain of `examples/domains`

CASE is M or S, with a cap on accumulated cost as S80, or a discount as M@0.999; P asks for the
greatest goal probability (`MaxProb`), C for the least cost of reaching the goal surely (`MinCost`).
"""

import re
from dataclasses import dataclass, replace

from examples.solver_comparison.instances.families import WARM_UP_SIZES

FAILURE_BUDGET = 0.05

QUICK_INSTANCES = (
    "robot-20x12-M@0.999",
    "robot-20x12-P",
    "triangle-30-M",
    "rectangle-60x60-M",
    "inventory-20x20-M",
    "navigation-60x60-P",
    "triangle-30-C",
    "rectangle-60x60-C",
)
"""The paper's robot, with a discount so that the paper's method takes part; published domains."""

FULL_INSTANCES = (
    "robot-20x12-M",
    "robot-40x24-M",
    "robot-80x36-M",
    "robot-20x12-S80",
    "robot-40x24-S80",
    "robot-80x36-S80",
    "random-5000-M",
    "random-20000-M",
)

STRUCTURES = (
    "layered-1000x100-M",
    "layered-100x1000-M",
    "river-1000x100-M",
    "river-100x1000-M",
    "grid-300-M",
    "corridor-10000-M",
    "scattered-100000-M",
    "rooms-250x20-M",
    "ring-10000-M",
    "holes-100-M",
    "headings-60-M",
    "racetrack-38-P",
    "tandem-100-M",
    "inventory-80x100-M",
    "sysadmin-11-M",
    "factored-13-M",
    "blocks-5-M",
    "robot-40x24-M",
)
"""One instance of each structure."""

_WARM_UP_SIZE: dict[str, tuple[int, ...]] = {
    "robot": (20, 12),
    "random": (5_000,),
    "triangle": (10,),
    "rectangle": (20, 20),
    "navigation": (20, 20),
    **WARM_UP_SIZES,
}
_PATTERN = re.compile(
    rf"(?P<family>{'|'.join(_WARM_UP_SIZE)})-(?P<size>\d+(x\d+)?)"
    r"-(?P<case>[MSPC])(?P<cap>\d+)?(@(?P<discount>.+))?"
)


@dataclass(frozen=True)
class Instance:
    """A model of a family together with the criterion asked of it."""

    family: str  # "robot", "random", or one of `families`
    size: tuple[int, ...]  # (segments, headings), (states,), or as the family has it
    case: str  # "M", "S", "P" or "C"
    cost_cap: float | None = None  # case S: the cap on accumulated cost
    discount: float | None = None
    failure_budget: float = FAILURE_BUDGET

    @property
    def group(self) -> str:
        """The instance's name without its size."""
        cap = "" if self.cost_cap is None else f"{self.cost_cap:g}"
        discount = "" if self.discount is None else f"@{self.discount:g}"
        return f"{self.family} {self.case}{cap}{discount}"

    @property
    def name(self) -> str:
        """The name that :func:`parse_instance` reads."""
        family, case = self.group.split()
        return f"{family}-{'x'.join(map(str, self.size))}-{case}"

    @property
    def warm_up(self) -> "Instance":
        """A small instance of the same family, or the instance itself if it is small."""
        return min(self, replace(self, size=_WARM_UP_SIZE[self.family]), key=lambda i: i.size)


def parse_instance(name: str) -> Instance:
    """Return the instance of a name.

    Raises:
        ValueError: the name is of no known form.
    """
    found = _PATTERN.fullmatch(name)
    if found is None or len(_WARM_UP_SIZE[found["family"]]) != 1 + ("x" in found["size"]):
        raise ValueError(f"{name!r} is no instance: robot-20x12-M, robot-20x12-S80, random-5000-M")
    return Instance(
        family=found["family"],
        size=tuple(int(part) for part in found["size"].split("x")),
        case=found["case"],
        cost_cap=float(found["cap"]) if found["cap"] else None,
        discount=float(found["discount"]) if found["discount"] else None,
    )
