"""The chapter "The program" as scripts: what each finds against brute force or the definition."""

import re

import cvxpy as cp
import numpy as np
import pytest

from examples.formulating import (
    convex_objectives,
    files,
    one_action,
    rows_of_ones_own,
    stations,
    sweep,
    two_robots,
)
from ssp_lp import DeterministicPolicies, evaluate, failure_probability, solve, trace_frontier

PROBLEMS = list(files.problems())
BY_CLARABEL = {"rel": 1e-6, "abs": 1e-6}


class Definition:
    """Least cost over the visits of a model, by its arrays; failing is to arrive at no goal.

    Every step costs something, and nobody gives up: nothing else can happen.
    """

    def __init__(self, model, start):
        self.model, rows = model, model.outcome_offsets[:-1]
        self.x = cp.Variable(model.n_pairs, nonneg=True)
        acting = np.unique(model.pair_state)
        lost = ~model.goal_mask & ~np.isin(np.arange(model.n_states), acting)
        self.cost = np.add.reduceat(model.probabilities * model.costs, rows)
        self.failing = np.add.reduceat(model.probabilities * lost[model.successors], rows)
        pair = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
        balance = np.zeros((model.n_states, model.n_pairs))
        balance[model.pair_state, np.arange(model.n_pairs)] = 1.0
        np.add.at(balance, (model.successors, pair), -model.probabilities)
        begun = np.arange(model.n_states) == model.index_of(start)
        self.rows = [balance[acting] @ self.x == begun[acting].astype(float)]

    def visits(self, state, action=None):
        """How often a state acts, or acts so."""
        pairs = np.flatnonzero(self.model.pair_state == self.model.index_of(state))
        return cp.sum(self.x[[k for k in pairs if action in (None, self.model.action_of(k))]])

    def expression(self, quantity):
        """The probability of failing, the only quantity that the scripts ask for."""
        assert repr(quantity) == repr(failure_probability())
        return self.failing @ self.x

    def least(self):
        """The optimum."""
        return float(cp.Problem(cp.Minimize(self.cost @ self.x), self.rows).solve(cp.CLARABEL))


def test_rows_of_ones_own_are_those_of_the_definition():
    problem = rows_of_ones_own.crossing()
    defined = Definition(problem.model, problem.start)
    defined.rows.append(defined.failing @ defined.x <= problem.failure_budget)
    rows, costs = iter(rows_of_ones_own.rows(defined)), []
    for name, measure in rows_of_ones_own.crossings(problem).items():
        if name != "none":
            added, row = next(rows)
            assert added == name
            defined.rows.append(row)
        assert measure.objective == pytest.approx(defined.least(), **BY_CLARABEL), name
        found = evaluate(measure.randomised_policy(), problem)
        assert found.objective == pytest.approx(measure.objective, rel=1e-9)
        assert found.failure_probability == pytest.approx(measure.activity["failure"], abs=1e-9)
        costs.append(measure.objective)
    assert not list(rows)
    assert np.all(np.diff(costs) > 1e-3)  # each of them matters


def test_a_congested_fleet_has_equal_marginal_costs():
    measure, theory = convex_objectives.fleet()
    for road, share in theory.items():
        taken = measure.program.visits("depot", road) @ measure.visits
        assert taken == pytest.approx(share, **BY_CLARABEL)
    assert measure.activity["failure"] == pytest.approx(convex_objectives.LOST_LORRIES)
    assert measure.duals["failure"] > 1.0
    assert sum(theory.values()) == pytest.approx(1.0)


def test_entropy_is_soft_value_iteration():
    measure, value = convex_objectives.robot()
    assert measure.minimised == pytest.approx(value, rel=1e-6)
    assert measure.activity["failure"] == pytest.approx(convex_objectives.LOST_ROBOTS, abs=1e-6)


def test_the_stations_are_the_best_of_all_sets():
    problem = stations.delivery(stations.PRICES)
    measure, chosen = stations.built(problem)
    costs = dict(stations.by_enumeration())
    assert 1 < len(costs) < 2 ** len(stations.PRICES)
    assert measure.minimised == pytest.approx(min(costs.values()), rel=1e-7)
    assert measure.minimised == pytest.approx(costs[chosen], rel=1e-7)
    found = evaluate(measure.mixed_policy(), problem)
    assert found.failure_probability <= stations.CRASHES + 1e-9
    prices = sum(map(stations.PRICES.__getitem__, chosen))
    assert found.objective + prices == pytest.approx(costs[chosen], rel=1e-7)


@pytest.mark.parametrize("budget", one_action.BUDGETS)
def test_one_action_a_state_is_the_best_of_all_policies(budget):
    model, start = one_action.river(4, 3)
    problem = one_action.MCMP(model, start, failure_budget=budget, give_up="dead_ends")
    measure, way = one_action.deterministic(problem)
    best = solve(problem, DeterministicPolicies()).objective
    assert measure.objective == pytest.approx(best, rel=1e-6)
    assert len(measure.mixed_policy().weights) == 1
    assert len(way) == np.count_nonzero(measure.visits > one_action.TAKEN)


def test_two_robots_share_as_their_frontiers_do():
    problems = two_robots.robots()
    frontiers = trace_frontier(problems[0]), trace_frontier(problems[1])
    defined = [Definition(problem.model, problem.start) for problem in problems]
    lost, costs = (sum(getattr(d, what) @ d.x for d in defined) for what in ("failing", "cost"))
    rows = [row for d in defined for row in d.rows]
    for budget in two_robots.BUDGETS:
        first, second, price = two_robots.shared(problems, budget)
        cost = first.objective + second.objective
        known = float(cp.Problem(cp.Minimize(costs), [*rows, lost <= budget]).solve(cp.CLARABEL))
        assert cost == pytest.approx(known, **BY_CLARABEL)
        assert cost == pytest.approx(two_robots.merged(frontiers, budget), **BY_CLARABEL)
        taken = [measure.activity["failure"] for measure in (first, second)]
        assert sum(taken) == pytest.approx(budget, abs=1e-6)
        less, more = (two_robots.merged(frontiers, budget + step) for step in (-1e-4, 1e-4))
        assert (cost - more) / 1e-4 - 0.05 <= price <= (less - cost) / 1e-4 + 0.05


@pytest.mark.parametrize("swept", [sweep.least_cost, sweep.cost_given_success])
def test_a_sweep_walks_along_the_frontier(swept):
    found = [(budget, measure.objective, known) for budget, measure, known in swept()]
    assert [budget for budget, _, _ in found] == list(sweep.BUDGETS)
    for _, objective, known in found:
        assert objective == pytest.approx(known, **BY_CLARABEL)


@pytest.mark.parametrize(("name", "problem"), PROBLEMS, ids=[name for name, _ in PROBLEMS])
def test_files_are_solved_elsewhere_and_read_back(name, problem, tmp_path):
    known = solve(problem).objective
    highs, clarabel = files.round_trip(problem, tmp_path)
    for measure in (highs, clarabel):
        assert measure.objective == pytest.approx(known, **BY_CLARABEL), name
        assert measure.residual <= 1e-6


SCRIPTS = {
    convex_objectives: "by soft value iteration",
    one_action: "the way",
    rows_of_ones_own: "spread",
    stations: "stations at",
    sweep: "given success",
    two_robots: "halves",
}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.__name__)
def test_the_script_prints_what_it_finds(script, capsys):
    script.main()
    printed = capsys.readouterr().out
    assert SCRIPTS[script] in printed
    assert len(printed.splitlines()) >= 5
    assert not re.search(r"\bnan\b", printed)


def test_the_script_of_files_leaves_them(tmp_path, capsys):
    files.main(["--output", str(tmp_path)])
    assert "CostBoundedReach" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*/program.mps"))) == len(PROBLEMS)
