"""The law of success costs by a plain dynamic programme over (state, total cost), in fractions."""

from collections.abc import Mapping
from fractions import Fraction

from references.chain import STOP, Outcome, PlainModel, State, reaching

Moves = dict[State, list[tuple[Fraction, State, Fraction]]]


def exact(number: float | Fraction) -> Fraction:
    """A float as its shortest decimal, a fraction as it is."""
    return number if isinstance(number, Fraction) else Fraction(repr(number))


def moves_of(model: PlainModel, decisions: Mapping[State, Mapping[object, float]]) -> Moves:
    """The outcomes of a randomised stationary policy at each state, in fractions."""
    return {
        state: [
            (exact(weight) * exact(p), successor, exact(cost))
            for action, weight in decisions.get(state, {}).items()
            if action != STOP
            for p, successor, cost in actions[action]
        ]
        for state, actions in model.choices.items()
    }


def law(
    model: PlainModel, start: Mapping[State, float], moves: Moves, most: Fraction
) -> dict[Fraction, Fraction]:
    """Pr(goal, total cost = c) for each total cost c of at most ``most`` that occurs."""
    live = reaching(moves, model.goals)
    waiting = {Fraction(0): {s: exact(p) for s, p in start.items()}}
    found: dict[Fraction, Fraction] = {}
    while waiting and min(waiting) <= most:
        paid = min(waiting)
        entered = waiting.pop(paid)
        arrived = sum((entered.get(g, Fraction(0)) for g in model.goals), Fraction(0))
        for state, visits in _visits(moves, live, entered).items():
            for p, successor, cost in moves[state]:
                if successor in model.goals and cost == 0:
                    arrived += visits * p
                elif successor in model.goals or (cost > 0 and successor in live):
                    there = waiting.setdefault(paid + cost, {})
                    there[successor] = there.get(successor, Fraction(0)) + visits * p
        if arrived > 0:
            found[paid] = arrived
    return found


def _visits(
    moves: Moves, live: frozenset[State], entered: Mapping[State, Fraction]
) -> dict[State, Fraction]:
    """Visits of the live states at one total cost: x = entered + x F, F the free moves."""
    order = [s for s in moves if s in live]
    rows = []
    for state in order:
        row = [Fraction(int(state == other)) for other in order]
        for i, other in enumerate(order):
            row[i] -= sum(o[0] for o in moves[other] if o[1] == state and o[2] == 0)
        rows.append([*row, entered.get(state, Fraction(0))])
    return dict(zip(order, _solved(rows), strict=True))


def _solved(rows: list[list[Fraction]]) -> list[Fraction]:
    """Gauss and Jordan's elimination of a square system with its right side as last column."""
    for i in range(len(rows)):
        pivot = next(k for k in range(i, len(rows)) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [entry / rows[i][i] for entry in rows[i]]
        for k, row in enumerate(rows):
            if k != i and row[i] != 0:
                rows[k] = [a - row[i] * b for a, b in zip(row, rows[i], strict=True)]
    return [row[-1] for row in rows]


def member_moves(chain: PlainModel, played: Mapping[State, object]) -> Moves:
    """The outcomes of a member that was played through its (state, memory)."""
    listed: dict[State, list[Outcome]] = {
        node: list(actions[played[node]]) if node in played else []
        for node, actions in chain.choices.items()
    }
    return {
        node: [(exact(p), s, exact(float(cost))) for p, s, cost in outcomes]
        for node, outcomes in listed.items()
    }
