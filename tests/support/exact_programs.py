"""Occupation measures of small models as linear programs in fractions: optima without rounding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

Exact = Fraction
QUIT = "give up"


def simplex(
    cost: Sequence[Exact], rows: Sequence[Sequence[Exact]], right: Sequence[Exact]
) -> Exact | None:
    """Least ``cost @ x`` with ``rows @ x == right``, x >= 0, by Bland's rule; None: infeasible."""
    n, zero, one = len(cost), Fraction(0), Fraction(1)
    units = [[one if i == k else zero for i in range(len(rows))] for k in range(len(rows))]
    table = [
        [*(row if b >= 0 else [-a for a in row]), *unit, abs(b)]
        for row, unit, b in zip(rows, units, right, strict=True)
    ]
    basis = list(range(n, n + len(rows)))

    def optimise(costs: list[Exact], usable: int) -> None:
        """Pivot until no usable variable is worth entering."""
        reduced = [*costs, zero]
        for k, j in enumerate(basis):
            if factor := reduced[j]:
                reduced = [r - factor * a for r, a in zip(reduced, table[k], strict=True)]
        while (entering := next((j for j in range(usable) if reduced[j] < 0), None)) is not None:
            ratios = [
                (row[-1] / row[entering], basis[k], k)
                for k, row in enumerate(table)
                if row[entering] > 0
            ]
            if not ratios:
                raise ArithmeticError("unbounded")
            _, _, k = min(ratios)
            head = table[k][entering]
            table[k] = [a / head if a else a for a in table[k]]
            for i, row in enumerate(table):
                if i != k and (factor := row[entering]):
                    table[i] = [
                        a - factor * b if b else a for a, b in zip(row, table[k], strict=True)
                    ]
            factor = reduced[entering]
            reduced = [r - factor * b if b else r for r, b in zip(reduced, table[k], strict=True)]
            basis[k] = entering

    optimise([zero] * n + [one] * len(rows), n + len(rows))
    if any(table[k][-1] for k, j in enumerate(basis) if j >= n):
        return None
    for k, j in enumerate(basis):  # what is basic at 0 must not grow again
        if j >= n and (other := next((i for i in range(n) if table[k][i]), None)) is not None:
            head = table[k][other]
            table[k] = [a / head for a in table[k]]
            for i, row in enumerate(table):
                if i != k and (factor := row[other]):
                    table[i] = [a - factor * b for a, b in zip(row, table[k], strict=True)]
            basis[k] = other
    kept = [k for k, j in enumerate(basis) if j < n]
    table[:] = [table[k] for k in kept]
    basis[:] = [basis[k] for k in kept]
    optimise([*cost, *[zero] * len(rows)], n)
    return sum((cost[j] * table[k][-1] for k, j in enumerate(basis)), zero)


@dataclass
class ExactModel:
    """Outcomes (probability, successor, cost) by state and action; ends have no actions.

    Numbers are taken as the floats that the library gets.
    """

    table: Mapping[object, Mapping[object, Sequence[tuple[float, object, float]]]]
    goal: object
    begin: object
    quits: str = ""  # "anywhere" or "attention": states that may give up, at no cost
    discount: float = 1.0  # of every transition; costs are paid when an action is taken
    pairs: list[tuple[object, object]] = field(init=False)

    def __post_init__(self) -> None:
        """Number the pairs."""
        self.pairs = [(s, a) for s, actions in self.table.items() for a in actions]
        acting = {s for s, actions in self.table.items() if actions}
        quitting = self._avoiding(acting - self.hopeful)  # to stay there for ever
        if self.quits:
            anywhere = self.quits == "anywhere"
            quitting |= acting if anywhere else self._avoiding(set(self.table) - {self.goal})
        self.pairs += [(s, QUIT) for s in self.table if s in quitting & acting]

    def _avoiding(self, avoiding: set[object]) -> set[object]:
        """The states among some from which these need never be left."""
        while True:
            kept = {
                s
                for s in avoiding
                if not self.table[s]
                or any(all(to in avoiding for _, to, _ in m) for m in self.table[s].values())
            }
            if kept == avoiding:
                return kept
            avoiding = kept

    def outcomes(self, pair: tuple[object, object]) -> list[tuple[Exact, object, Exact]]:
        """Outcomes of a pair, probabilities divided by their sum."""
        state, action = pair
        if action == QUIT:
            return []
        moves = [(Fraction(p), to, Fraction(c)) for p, to, c in self.table[state][action]]
        total = sum(p for p, _, _ in moves)
        return [(p / total, to, c) for p, to, c in moves]

    @property
    def survival(self) -> Exact:
        """The discount as a fraction."""
        return Fraction(self.discount)

    @cached_property
    def hopeful(self) -> set[object]:
        """States from which the goal can be reached; elsewhere a run has failed, at no cost."""
        known = {self.goal}
        while more := {
            s
            for s, actions in self.table.items()
            if s not in known
            and any(to in known for moves in actions.values() for _, to, _ in moves)
        }:
            known |= more
        return known

    @property
    def cost(self) -> list[Exact]:
        """Expected cost of each pair until failing."""
        return [
            sum((p * c for p, _, c in self.outcomes(u)), Fraction(0)) * (u[0] in self.hopeful)
            for u in self.pairs
        ]

    def into(self, ends: Sequence[object]) -> list[Exact]:
        """Probability of stepping into some ends with each pair."""
        return [
            self.survival * sum((p for p, to, _ in self.outcomes(u) if to in ends), Fraction(0))
            for u in self.pairs
        ]

    def spread(self, values: Mapping[object, Mapping[object, float]]) -> list[Exact]:
        """A cost by state and action at each pair, until failing."""
        return [
            Fraction(values.get(s, {}).get(a, 0.0)) * (s in self.hopeful) for s, a in self.pairs
        ]

    def least(
        self,
        objective: Sequence[Exact],
        limits: Sequence[tuple[Sequence[Exact], str, float]],
        *,
        given_success: bool = False,
    ) -> Exact | None:
        """Least objective of all occupation measures within limits; None: there is none.

        Args:
            objective: of each pair.
            limits: coefficients of each pair, "<=", ">=" or "==", and the bound.
            given_success: divide the objective by the goal probability (Charnes and Cooper).
        """
        states = [s for s, actions in self.table.items() if actions]
        n, goal = len(self.pairs), self.into([self.goal])
        scale = [Fraction(0)] * given_success
        slacks = sum(kind != "==" for _, kind, _ in limits)
        rows, right, number = [], [], 0
        for state in states:
            row = [
                Fraction(int(s == state))
                - self.survival * sum(p for p, to, _ in self.outcomes((s, a)) if to == state)
                for s, a in self.pairs
            ]  # fmt: skip
            start = Fraction(int(state == self.begin))
            rows.append([*row, *([-start] if given_success else []), *[Fraction(0)] * slacks])
            right.append(Fraction(0) if given_success else start)
        for coefficients, kind, bound in limits:
            slack = [Fraction(0)] * slacks
            if kind != "==":
                slack[number], number = Fraction(1 if kind == "<=" else -1), number + 1
            rows.append([*coefficients, *([-Fraction(bound)] if given_success else []), *slack])
            right.append(Fraction(0) if given_success else Fraction(bound))
        if given_success:
            rows.append([*goal, *scale, *[Fraction(0)] * slacks])
            right.append(Fraction(1))
        assert all(len(row) == n + len(scale) + slacks for row in rows)
        return simplex([*objective, *scale, *[Fraction(0)] * slacks], rows, right)

    def by_total(self) -> ExactModel:
        """The model of (state, total cost so far), if that is finite; the goal is one place."""
        table: dict[object, dict[object, list[tuple[float, object, float]]]] = {}
        waiting = [(self.begin, 0.0)]
        while waiting:
            state, paid = node = waiting.pop()
            if node in table:
                continue
            table[node] = {}
            for action, moves in self.table[state].items():
                table[node][action] = [
                    (p, to, paid + c) if to == self.goal else (p, (to, paid + c), 0.0)
                    for p, to, c in moves
                ]
                waiting += [(to, paid + c) for _, to, c in moves if to != self.goal]
        return ExactModel(
            {**table, self.goal: {}}, self.goal, (self.begin, 0.0), self.quits, self.discount
        )
