"""The simplex method in fractions: optima of small linear programs without rounding."""

from collections.abc import Sequence
from fractions import Fraction

Exact = Fraction


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
