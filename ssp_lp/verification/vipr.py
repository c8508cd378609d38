"""Lower bounds of certificates in the VIPR format 1.1, which `viprchk` verifies.

The file states the certificate's last program. Variables are the columns x >= 0; constraints are a
flow balance for each node, and the rows. The bound is a linear combination of the constraints. The
multipliers are v for the balance of each node, minus the price for each row, and the slack of the
column's inequality for each x >= 0. If the objective is a ratio N / (1 - F) of cost and goal
probability, the program minimises N + r F, since N + r F >= r says that the ratio is at least r.
The format is that of Cheung, Gleixner and Steffy, "Verifying Integer Programming Results", IPCO
2017.
"""

from __future__ import annotations

from collections import defaultdict
from fractions import Fraction
from operator import mul
from pathlib import Path

from ssp_lp.model.arguments import explained
from ssp_lp.solution import Solution
from ssp_lp.verification.certificate_file import certificate_of
from ssp_lp.verification.certificate_lines import proved_steps, read_question


@explained
def to_vipr(solution: Solution, path: str | Path) -> Fraction:
    """Write the lower bound of a solution's certificate as a VIPR file.

    Args:
        solution: a solution of ``solve`` for a criterion that certificate files cover.
        path: path of the file, which is plain text; ``viprchk FILE`` verifies it.

    Returns:
        The bound that the file proves. It is a lower bound of the objective; for a maximisation
        problem, minus the upper bound; for a ratio N / (1 - F) with the proved lower bound r, a
        lower bound of N + r F, at least r.

    Raises:
        ModelError: the criterion is not covered.
        SolverError: the solution is not proved.
    """
    lines = certificate_of(solution)
    rest = iter(lines)
    question, _, answer = read_question(rest)
    *_, (program, proof, _, _) = proved_steps(lambda: iter(lines), rest, question, answer)
    unit, ratio = Fraction(1, proof.unit), proof.ratio or Fraction(0)
    prices = [proof.prices[0] - ratio, *proof.prices[1:]]
    limits = [row.most for row in program.rows]
    flow, rows = defaultdict[int, list[str]](list), [list[str]() for _ in limits]
    objective, spare, count = list[str](), list[str](), 0
    for node, _, total, moves, counts in program.columns():
        if node not in proof.v:
            continue
        entries = defaultdict[int, Fraction](Fraction, {node: Fraction(1)})
        for a, i in moves:
            entries[i] -= Fraction(a, total)
        left = Fraction(0)
        for i, share in entries.items():
            flow[i] += [f"{count} {share}"] if share else []
            left += share * proof.v[i] * unit
        for row, c in zip(rows, counts[1:], strict=True):
            row += [f"{count} {c}"] if c else []
        cost = counts[0] + ratio * counts[1]
        objective += [f"{count} {cost}"] if cost else []
        paid = sum(map(mul, prices, counts[1:]), Fraction(0))
        spare += [f"{count} {cost + paid - left}"] if cost + paid != left else []
        count += 1
    bound = proof.v[0] * unit - sum(map(mul, prices, limits), Fraction(0))
    nodes = sorted(proof.v)
    terms = [f"{count + k} {proof.v[i] * unit}" for k, i in enumerate(nodes) if proof.v[i]]
    terms += [f"{count + len(nodes) + k} {-p}" for k, p in enumerate(prices) if p]
    terms += spare
    with open(path, "w", encoding="ascii") as file:
        print(
            "VER 1.1\nVAR", count, *(f"x{j}" for j in range(count)), "\nINT 0\nOBJ min", file=file
        )
        print(len(objective), *objective, file=file)
        print("CON", count + len(nodes) + len(rows), count, file=file)
        file.writelines(f"B{j} G 0 1 {j} 1\n" for j in range(count))
        for i in nodes:
            print(f"F{i} E {int(i == 0)} {len(flow[i])}", *flow[i], file=file)
        for k, (row, most) in enumerate(zip(rows, limits, strict=True)):
            print(f"R{k} L {most} {len(row)}", *row, file=file)
        print(f"RTP range {bound} inf\nSOL 0\nDER 1", file=file)
        print(f"D G {bound} OBJ {{ lin {len(terms)}", *terms, "} -1", file=file)
    return bound
