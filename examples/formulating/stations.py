"""Stations to build: the places at which a drone can be charged, as a mixed-integer program.

A drone flies from place to place to the farm. A flight takes one unit of its battery, wind throws
it back one time in ten, and an empty battery is a crash. Charging is possible at a station, and
each station has a price: which stations minimise the cost of flights and stations together, if at
most 2 % of the drones may crash? One binary variable for each place allows charging there, at all
battery levels; the result is a policy like any other.

    python examples/formulating/stations.py
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Collection, Iterator
from itertools import combinations

import cvxpy as cp
import numpy as np

from ssp_lp import MCMP, SSP, InfeasibleError, evaluate, solve
from ssp_lp.programs.occupation_measure import OccupationMeasure

FLIGHTS = {
    "depot": ("mill", "quay"),
    "mill": ("depot", "church"),
    "church": ("mill", "farm"),
    "quay": ("depot", "lock"),
    "lock": ("quay", "tower"),
    "tower": ("lock", "farm"),
}
PRICES = {"mill": 1.5, "church": 1.5, "quay": 0.6, "lock": 0.3, "tower": 0.4}
BATTERY, WIND, CRASHES = 3, 0.1, 0.02
START = "depot", BATTERY


def country(stations: Collection[str]) -> SSP:
    """Build the model of places and battery levels, with stations at some of the places."""
    transitions: dict[object, dict[str, list[tuple[float, object, float]]]] = {"crashed": {}}
    for place, nearby in FLIGHTS.items():
        for charge in range(1, BATTERY + 1):
            left = charge - 1
            moves = {
                f"to {there}": [
                    (1.0 - WIND, there if there == "farm" else (there, left), 1.0),
                    (WIND, (place, left), 1.0),
                ]
                for there in nearby
            }
            if place in stations and charge < BATTERY:
                moves["charge"] = [(1.0, (place, BATTERY), 1.0)]
            transitions[place, charge] = moves
        transitions[place, 0] = {"land": [(1.0, "crashed", 0.0)]}
        if place in stations:
            transitions[place, 0]["charge"] = [(1.0, (place, BATTERY), 1.0)]
    return SSP.from_transitions(transitions, goal={"farm"}, treat_actionless_as_dead_ends=True)


def delivery(stations: Collection[str]) -> MCMP:
    """State the delivery from the depot to the farm with these stations."""
    return MCMP(country(stations), START, failure_budget=CRASHES, give_up="dead_ends")


def built(problem: MCMP) -> tuple[OccupationMeasure, frozenset[str]]:
    """Find the least cost of flights and stations, and the stations.

    Args:
        problem: the delivery with stations everywhere.
    """
    program = problem.program()
    convex, prices = program.to_cvxpy(), np.array(list(PRICES.values()))
    stations = cp.Variable(len(PRICES), boolean=True)
    most = program.solve().objective + prices.sum()  # a charge costs 1: no optimum has more of them
    for number, place in enumerate(PRICES):
        charged = cp.sum([convex.visits((place, k), "charge") for k in range(BATTERY)])
        convex.constraints[place] = charged <= most * stations[number]
    convex.objective = convex.objective + prices @ stations
    measure = convex.solve(cp.SCIPY, scipy_options={"mip_rel_gap": 0.0})
    return measure, frozenset(p for p, one in zip(PRICES, stations.value, strict=True) if one > 0.5)


def by_enumeration() -> Iterator[tuple[frozenset[str], float]]:
    """Yield every feasible set of stations, with the cost of flights and stations."""
    for number in range(len(PRICES) + 1):
        for stations in combinations(PRICES, number):
            try:
                flights = solve(delivery(stations)).objective
            except InfeasibleError:
                continue
            yield frozenset(stations), flights + sum(map(PRICES.__getitem__, stations))


def main() -> None:
    """Print the stations, and the best sets of all by enumeration."""
    problem = delivery(PRICES)
    measure, stations = built(problem)
    found = evaluate(measure.mixed_policy(), problem)
    print(f"stations at {', '.join(sorted(stations))}: {measure.minimised:.6f}, flights alone"
          f" {found.objective:.6f}, crashes {found.failure_probability:.6f}")  # fmt: skip
    every = sorted(by_enumeration(), key=lambda found: found[1])
    print(f"of {2 ** len(PRICES)} sets {len(every)} are within {CRASHES:g}:")
    for each, cost in every[:5]:
        print(f"  {cost:9.6f}  {', '.join(sorted(each))}")


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
