"""Random small models with exact probabilities, drawn from a seed and a number.

A model holds fractions. The library is given the nearest floats: of every row but its remainder
(the outcome that is 1 minus the others) the floats of a `loops` model are the fractions themselves.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

Outcome = tuple[Fraction, str, Fraction]  # probability, successor, cost
Rows = Mapping[str, Mapping[str, tuple[Outcome, ...]]]

START, GOAL, DEAD = "s0", "goal", "dead"
MOST_POLICIES = 600  # decisions to stop included
COSTS = tuple(Fraction(c) for c in ("0", "0.1", "0.3", "1", "2"))
SMALL_COSTS = tuple(Fraction(c) for c in (0, 1, 1, 2, 3))


@dataclass(frozen=True)
class Model:
    """Non-goal states with their actions, and a second cost for each action."""

    rows: Rows
    second: Mapping[str, Mapping[str, int]]
    family: str
    index: int

    def transitions(self) -> dict[str, dict[str, list[tuple[float, str, float]]]]:
        """What the library is given, which is also how the model is printed."""
        return {
            state: {
                action: [(float(p), successor, float(cost)) for p, successor, cost in outcomes]
                for action, outcomes in actions.items()
            }
            for state, actions in self.rows.items()
        }


def draw_model(family: str, seed: int, index: int) -> Model:
    """Model number `index` of a seed: small enough, and its goal hardly ever out of reach."""
    rng = np.random.default_rng([seed, index])
    draw = _loops if family == "loops" else _ordinary
    while True:
        rows = draw(rng)
        decisions = 1
        for actions in rows.values():
            decisions *= len(actions) + 1
        if decisions <= MOST_POLICIES and (_leads_home(rows) or rng.random() < 0.02):
            break
    second = {s: {a: int(rng.integers(0, 3)) for a in actions} for s, actions in rows.items()}
    return Model(rows, second, family, index)


def _leads_home(rows: Rows) -> bool:
    """Whether some path leads from the start to the goal."""
    found = [START]
    for state in found:
        for outcomes in rows.get(state, {}).values():
            found += [t for _, t, _ in outcomes if t not in found]
    return GOAL in found


def _pick(rng: np.random.Generator, items: tuple | list):
    """One of the items, as it is."""
    return items[int(rng.integers(len(items)))]


def _names(rng: np.random.Generator) -> list[str]:
    """Two to five live states, fewer ones more often."""
    return [f"s{k}" for k in range(_pick(rng, (2, 2, 3, 3, 3, 4, 4, 5)))]


# Loops that are hardly ever left ------------------------------------------------------------


def _loops(rng: np.random.Generator) -> Rows:
    """Rows of loops with tiny exits, some sure and coin-flip actions, and ties."""
    names = _names(rng)
    rows: dict[str, dict[str, tuple[Outcome, ...]]] = {}
    for k, state in enumerate(names):
        ahead = names[(k + 1) % len(names)]
        count = _pick(rng, (1, 1, 2, 2, 3))
        rows[state] = {f"a{j}": _loop_action(rng, names, state, ahead) for j in range(count)}
    for state in names:
        if rng.random() < 0.35 and len(rows[state]) < 3:
            rows[state][f"a{len(rows[state])}"] = _twin(rng, rows[state])
    rows[DEAD] = {}
    return rows


def _loop_action(
    rng: np.random.Generator, names: list[str], state: str, ahead: str
) -> tuple[Outcome, ...]:
    """A loop with exits (most often), a sure step, or a coin."""
    kind, cost = rng.random(), _pick(rng, COSTS)
    if kind < 0.12:
        target = _pick(rng, [*names, ahead, GOAL] if rng.random() < 0.5 else [ahead])
        return ((Fraction(1), target, cost),)
    if kind < 0.27:
        left, right = _pick(rng, [*names, GOAL]), _pick(rng, [*names, *names, DEAD])
        return ((Fraction(1, 2), left, cost), (Fraction(1, 2), right, cost))
    back = _pick(rng, (state, state, ahead, ahead, _pick(rng, names)))
    ends = _pick(rng, ([GOAL], [DEAD], [GOAL, DEAD], [GOAL, DEAD], [_pick(rng, names)]))
    paid = cost if rng.random() < 0.8 else _pick(rng, COSTS)
    exits = [(Fraction(float(10.0 ** -rng.uniform(3, 12))), end, paid) for end in ends]
    return _with_remainder(rng, exits, back, cost, names)


def _with_remainder(
    rng: np.random.Generator, exits: list[Outcome], back: str, cost: Fraction, names: list[str]
) -> tuple[Outcome, ...]:
    """The exits, and all that is left: to one state, or by halves to two."""
    left = 1 - sum(p for p, _, _ in exits)
    if rng.random() < 0.85:
        return ((left, back, cost), *exits)
    half = Fraction(1, 2)
    return ((half, _pick(rng, names), cost), (left - half, back, cost), *exits)


def _twin(
    rng: np.random.Generator, actions: Mapping[str, tuple[Outcome, ...]]
) -> tuple[Outcome, ...]:
    """An action that ties with one that is there: the same, or its exits at another speed."""
    outcomes, cost = _pick(rng, list(actions.values())), _pick(rng, COSTS)
    if rng.random() < 0.3 or outcomes[0][0] < Fraction(3, 4):
        return tuple((p, successor, cost) for p, successor, _ in outcomes)
    scale = Fraction(2) ** -int(rng.integers(0, 12))  # a power of two: the ratio stays exact
    exits = [(p * scale, successor, cost) for p, successor, _ in outcomes[1:]]
    return ((1 - sum(p for p, _, _ in exits), outcomes[0][1], cost), *exits)


# Ordinary models ----------------------------------------------------------------------------


def _ordinary(rng: np.random.Generator) -> Rows:
    """Rows with quarters, fifths and tenths, small costs, dead-ends and waiting loops."""
    names = _names(rng)
    rows: dict[str, dict[str, tuple[Outcome, ...]]] = {}
    for state in names:
        count = _pick(rng, (1, 2, 2, 3))
        rows[state] = {f"a{j}": _ordinary_action(rng, names) for j in range(count)}
        if rng.random() < 0.15 and count < 3:
            rows[state]["wait"] = ((Fraction(1), state, _pick(rng, SMALL_COSTS)),)
    rows[DEAD] = {}
    if rng.random() < 0.2:
        rows[DEAD] = {"stay": ((Fraction(1), DEAD, _pick(rng, SMALL_COSTS)),)}
    return rows


def _ordinary_action(rng: np.random.Generator, names: list[str]) -> tuple[Outcome, ...]:
    """One to three outcomes over a common denominator."""
    size, count = _pick(rng, (4, 5, 10)), int(rng.integers(1, 4))
    cuts = sorted(int(c) for c in rng.choice(size - 1, count - 1, replace=False) + 1)
    shares = [b - a for a, b in zip([0, *cuts], [*cuts, size], strict=True)]
    cost, alike = _pick(rng, SMALL_COSTS), rng.random() < 0.7
    ends = [*names, *names, GOAL, GOAL, DEAD]
    return tuple(
        (Fraction(k, size), _pick(rng, ends), cost if alike else _pick(rng, SMALL_COSTS))
        for k in shares
    )
