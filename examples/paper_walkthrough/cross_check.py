"""The paper's robot by three methods: the linear program, column generation, and the paper's game.

For both cases prints the results of the methods, alpha* as computed from c* and the price, and the
mixture of section 3.4 as delta goes to 0.

    python examples/paper_walkthrough/cross_check.py

Case S's linear program on the default grid has a million columns, too many to solve by default:
there two methods run. A coarse grid (``--segments 5 --headings 5 --budget 0.9``) allows all three.
"""

import argparse
import time
from collections.abc import Sequence

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from ssp_lp import MCMP, S3P, cross_check
from ssp_lp.game import GameSolution, delta_mixture, stationary_game

DELTAS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


def main(arguments: Sequence[str] | None = None) -> None:
    """Cross-check both cases from the command line."""
    options = _parse(arguments)
    grid = RobotGrid(segments=options.segments, headings=options.headings)
    model, start = grid_model(grid), start_state(grid)
    for criterion in (MCMP, S3P):
        problem = criterion(
            model, start=start, failure_budget=options.budget, discount=options.discount
        )
        began = time.perf_counter()
        agreement = cross_check(problem)
        print(f"\n{criterion.__name__}: cross-check in {time.perf_counter() - began:.1f} s")
        print(agreement.summary())
        print(identity(stationary_game(problem)))
        print(delta_table(stationary_game(problem)))


def identity(game: GameSolution) -> str:
    """Compare alpha* with its value computed from c* and the price (mathematics, section 6)."""
    share = 1.0 - game.spent if game.problem.ratio else 1.0
    mine, other = game.objective * share, game.price * game.spent
    return f"alpha* = {game.alpha:.12f}, from c* and the price {mine / (mine + other):.12f}"


def delta_table(game: GameSolution) -> str:
    """Return cost and failure of z*_delta, relative to c* and to the budget."""
    inner, ratio = game.threshold.game.game, game.problem.ratio
    share = 1.0 - game.spent if ratio else 1.0
    rows = ["  delta     cost above c*   failure above the budget   weight of pi_+"]
    for delta in DELTAS:
        mixed = delta_mixture(game.player, inner, game.alpha, delta)
        cost = mixed.objective / share / game.objective - 1.0
        failure = mixed.condition / inner.budget - 1.0
        rows.append(f"  {delta:.0e}  {cost:14.1e}  {failure:25.1e}  {mixed.weight:15.6f}")
    return "\n".join(rows)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Plain)
    parser.add_argument("--segments", type=int, default=20, help="cells along each side")
    parser.add_argument("--headings", type=int, default=12, help="cells of the heading")
    parser.add_argument("--budget", type=float, default=0.05, help="failure budget")
    parser.add_argument("--discount", type=float, default=0.999, help="gamma")
    return parser.parse_args(arguments)


class _Plain(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Formatter of the help: line breaks as in the docstring, and the defaults of options."""


if __name__ == "__main__":
    main()
