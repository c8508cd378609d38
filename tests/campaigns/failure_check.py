"""Limits on what happens after failing, against linear programs written from the definitions.

    python tests/campaigns/failure_check.py --count 1500
    python tests/campaigns/failure_check.py --count 200 --seed 5000 --criteria mcmp s3p

Models are drawn with labelled ends behind dead-ends and attention states; limits on ends, visits
and secondary costs at random. Each problem is also written down as a linear program over the
expected visits of (state, label of failing), from the definitions, with scipy's ``linprog``; it
shares nothing with the library. Values must agree to 1e-6, each answer must be certified, and the
policy is played on as a chain of its own, on (state, what it remembers), to the true ends.
"""

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import linprog

from formulations import MCMP, S3P, LeastQuantity, MaxProb
from ssp_lp import (
    SSP,
    InfeasibleError,
    MixedPolicy,
    SSPError,
    certify,
    end_probability,
    evaluate,
    secondary_cost,
    solve,
    visits,
)
from ssp_lp.formulation import Formulation
from tests.campaigns.campaign import run, smaller_tables, smallest

HORIZON = ", horizon"
CRITERIA = (
    "mcmp", "least failure", "discounted", "s3p", "maxprob", "quantity",
    *(f"{name}{HORIZON}" for name in ("mcmp", "s3p", "maxprob", "quantity")),
)  # fmt: skip
AGREES = 1e-6  # absolute and relative
ATTEMPTS = 12  # draws until one is limited by its limits
ROOM = 1e-9  # by which a limit may be broken
LEAST = 1e-9  # of failure that the second program of least failure is given
GOAL = "home"
FAILED, OPEN = "failed", "open"  # how a state of the program is labelled
Outcomes = list[tuple[float, Any, float]]
Transitions = dict[Any, dict[Any, Outcomes]]


# ----- the model, and what is drawn ------------------------------------------------------------


@dataclass
class Drawn:
    """A model in plain words, and what is asked of it."""

    moves: Transitions
    labels: dict[str, list[Any]]
    criterion: str
    give_up: str
    charged: bool
    budget: float | None
    limits: list[tuple[str, tuple[Any, ...], str, float]]  # kind, of what, sense, bound
    fuel: dict[Any, dict[Any, float]]
    asked: tuple[str, tuple[Any, ...]] | None = None  # what is minimised in place of the cost
    discount: float | None = None
    horizon: int | None = None

    @property
    def model(self) -> SSP:
        """The model for the library."""
        return SSP.from_transitions(
            self.moves, {GOAL}, state_labels=self.labels, treat_actionless_as_dead_ends=True
        )


def drawn(seed: int, criterion: str) -> Drawn:
    """A problem whose limits change something, if one of several draws is such."""
    for attempt in range(ATTEMPTS):
        found = _drawn_once(np.random.default_rng([seed, attempt]), criterion)
        free = attained(
            replace(found, limits=[(*limit[:3], _slack(limit)) for limit in found.limits])
        )
        limited = attained(found)
        if limited is None or free is None:
            if attempt % 4 == 0 and limited is None and free is not None:
                break
        elif abs(limited[0] - free[0]) > AGREES:
            break
    return found


def _slack(limit: tuple[str, tuple[Any, ...], str, float]) -> float:
    """A bound that limits nothing."""
    return 0.0 if limit[2] == ">=" else np.inf


def _drawn_once(rng: np.random.Generator, criterion: str) -> Drawn:
    """A problem: states 0 .. live - 1, then ends, some of which go on."""
    live, ends = int(rng.integers(2, 5)), int(rng.integers(2, 6))
    within, criterion = criterion.endswith(HORIZON), criterion.removesuffix(HORIZON)
    acyclic = criterion == "s3p" and not within
    moves: Transitions = {}
    for x in range(live):
        moves[x] = {}
        for action in range(int(rng.integers(1, 4))):
            later = list(range(x + 1, live)) if acyclic else list(range(live))
            lost = list(range(live, live + ends))
            near = rng.random()
            among = lost + later * 2 + [GOAL] * 2
            among = lost + [k for k in later if k > 0] if near < 0.3 else among
            moves[x][f"u{action}"] = _outcomes(rng, among, acyclic)
    for x in range(live, live + ends):
        moves[x] = {}
        if rng.random() < 0.6:
            for action in range(int(rng.integers(1, 3))):
                moves[x][f"u{action}"] = _outcomes(rng, list(range(live, live + ends)), False)
    if criterion == "least failure":  # else hardly two actions fail alike
        lost = list(range(live, live + ends))
        for us in moves.values():
            us |= {f"{u} too": _elsewhere(rng, outcomes, lost) for u, outcomes in us.items()}
    labels: dict[str, list[Any]] = {"crash": [], "fire": []}
    for x in range(live, live + ends):
        if (which := rng.random()) < 0.7:
            labels["crash" if which < 0.4 else "fire"].append(x)
    labels["zone"] = [x for x in moves if rng.random() < 0.3]
    fuel = {x: {u: float(rng.integers(0, 3)) for u in us} for x, us in moves.items()}
    give_up = ("attention", "anywhere", "dead_ends")[int(rng.integers(3))]
    asked: list[tuple[str, tuple[Any, ...], str]] = []
    for _ in range(int(rng.integers(1, 3))):
        kind = ("end", "end", "end", "visits", "visits through", "fuel", "fuel through")[
            int(rng.integers(7))
        ]
        of: tuple[Any, ...] = ()
        if kind == "end":
            names = ["crash", "crash", "fire"] + ([] if within else ["dead_end"])
            of = (names[int(rng.integers(len(names)))],)
        elif kind.startswith("visits"):
            of = (("crash", "zone", "fire")[int(rng.integers(3))],)
        sense = ">=" if kind == "end" and rng.random() < 0.3 else "<="
        asked.append((kind, of, sense))
    found = Drawn(
        moves=moves,
        labels=labels,
        criterion=criterion,
        give_up=give_up if criterion not in ("s3p", "maxprob") else "attention",
        charged=bool(rng.random() < 0.5) and criterion not in ("s3p", "maxprob"),
        budget=None if criterion == "least failure" else 1.0,
        limits=[],
        fuel=fuel,
    )
    if criterion == "discounted":
        found.discount = 0.9
    if within:
        found.horizon = int(rng.integers(2, 5))
    if criterion == "quantity":
        kinds = (("end", ("crash",)), ("visits through", ("zone",)), ("fuel through", ()))
        found.asked = kinds[int(rng.integers(3))]
    safest = attained(found, ("goal", (), ">="))
    if criterion not in ("maxprob", "least failure") and safest is not None:
        found.budget = 1.0 + safest[0] * float(rng.choice([1.0, 0.9, 0.6, 0.3]))
    for kind, of, sense in asked:  # between the least that is attainable and what comes anyhow
        found.limits.append((kind, of, sense, _slack((kind, of, sense, 0.0))))
        limited, free = attained(found, (kind, of, sense)), attained(found)
        bound = 0.1
        share = float(rng.choice([0.0, 0.3, 0.7, 1.2, -0.1], p=(0.1, 0.35, 0.35, 0.15, 0.05)))
        share = 0.1 if share == 0.0 and criterion == "least failure" else share
        if limited is not None and free is not None:
            bound = limited[-1] + share * (free[-1] - limited[-1])
        if criterion == "least failure":  # which the programs meet within their tolerance only
            bound += 1e-4 if sense == "<=" else -1e-4
        found.limits[-1] = (kind, of, sense, bound)
    return found


def _outcomes(rng: np.random.Generator, among: Sequence[Any], whole: bool) -> Outcomes:
    """Up to three outcomes; costs are small whole numbers, often 0."""
    count = int(rng.integers(1, 4))
    to = [among[int(rng.integers(len(among)))] for _ in range(count)]
    shares = rng.multinomial(10, rng.dirichlet(np.ones(count))) / 10.0
    return [
        (float(p), y, float(rng.integers(0, 3))) for p, y in zip(shares, to, strict=True) if p > 0.0
    ]


def _elsewhere(rng: np.random.Generator, outcomes: Outcomes, lost: Sequence[int]) -> Outcomes:
    """The same chances, but to other dead-ends and at other costs."""
    return [
        (p, int(rng.choice(lost)) if y in lost else y, float(rng.integers(0, 3)))
        for p, y, _ in outcomes
    ]


def stated(drawn: Drawn) -> Formulation:
    """The problem for the library."""
    made = {"end": lambda of: end_probability(*of), "visits": lambda of: visits(*of)}
    made["visits through"] = lambda of: visits(*of, through_failure=True)
    made["fuel"] = lambda of: secondary_cost(drawn.fuel)
    made["fuel through"] = lambda of: secondary_cost(drawn.fuel, through_failure=True)
    limits = {
        f"limit {k}": made[kind](of) <= bound if sense == "<=" else made[kind](of) >= bound
        for k, (kind, of, sense, bound) in enumerate(drawn.limits)
    }
    model = drawn.model
    how: dict[str, Any] = {"constraints": limits, "horizon": drawn.horizon}
    if drawn.criterion == "s3p":
        return S3P(model, 0, drawn.budget, **how)
    if drawn.criterion == "maxprob":
        return MaxProb(model, 0, **how)
    how |= {"give_up": drawn.give_up, "charge_failing_step": drawn.charged}
    if drawn.asked is not None:
        kind, of = drawn.asked
        return LeastQuantity(model, 0, made[kind](of), drawn.budget, **how)
    return MCMP(model, 0, drawn.budget, drawn.discount, **how)


# ----- the same from the definitions -------------------------------------------------------------


@dataclass
class Facts:
    """What the definitions say of a model's graph."""

    dead: set[Any]
    attention: set[Any]
    ends: set[Any]  # dead-ends in which a run is over

    def staying(self, outcomes: Outcomes) -> bool:
        """Whether an action surely avoids the goal."""
        return all(y in self.attention for _, y, _ in outcomes)


def facts(moves: Transitions, labels: Mapping[str, Sequence[Any]], asked: set[str]) -> Facts:
    reaching = {GOAL}
    while True:
        more = {
            x
            for x, us in moves.items()
            if x not in reaching and any(y in reaching for u in us.values() for _, y, _ in u)
        }
        if not more:
            break
        reaching |= more
    dead = set(moves) - reaching
    attention = set(moves)
    while True:
        kept = {
            x
            for x in attention
            if not moves[x] or any(all(y in attention for _, y, _ in u) for u in moves[x].values())
        }
        if kept == attention:
            break
        attention = kept
    first = {x: next((n for n, m in labels.items() if x in m), "dead_end") for x in dead}
    ends = {x for x in dead if not moves[x] or first[x] in asked}
    return Facts(dead, attention, ends)


@dataclass
class Columns:
    """A linear program in the making: columns with where they lead and what they count."""

    source: list[Any] = field(default_factory=list)
    leads: list[dict[Any, float]] = field(default_factory=list)
    counts: list[dict[str, float]] = field(default_factory=list)

    def add(self, source: Any, leads: dict[Any, float], counts: dict[str, float]) -> None:
        """One more column."""
        self.source.append(source)
        self.leads.append(leads)
        self.counts.append(counts)


def unrolled(drawn: Drawn) -> tuple[Transitions, dict[str, list[Any]], Any, dict[Any, Any]]:
    """Moves, labels, start and fuel, with a horizon on (state, steps taken)."""
    if drawn.horizon is None:
        return drawn.moves, drawn.labels, 0, drawn.fuel
    moves: Transitions = {}
    for t in range(drawn.horizon + 1):
        for x, us in drawn.moves.items():
            moves[x, t] = {
                u: [(p, y if y == GOAL else (y, t + 1), c) for p, y, c in outcomes]
                for u, outcomes in us.items()
                if t < drawn.horizon
            }
    labels = {n: [(x, t) for x, t in moves if x in m] for n, m in drawn.labels.items()}
    fuel = {(x, t): drawn.fuel[x] for x, t in moves}
    late = facts(moves, {}, set()).dead - {
        (x, t) for x, t in moves if x in facts(drawn.moves, {}, set()).dead
    }
    return moves, {"out of time": sorted(late), **labels}, (0, 0), fuel


def program(drawn: Drawn) -> tuple[Columns, dict[Any, float], float]:
    """All columns, the start, and the factor of each step."""
    moves, labels, begin, fuel = unrolled(drawn)
    asked = {n for kind, of, _, _ in drawn.limits if kind == "end" for n in of}
    if drawn.asked is not None and drawn.asked[0] == "end":
        asked |= set(drawn.asked[1])
    known = facts(moves, labels, asked)
    first = {x: next((n for n, m in labels.items() if x in m), "dead_end") for x in known.dead}
    anywhere, gamma = drawn.give_up == "anywhere", drawn.discount or 1.0
    columns, total = Columns(), drawn.criterion == "s3p"
    costs = {x: {u: [c for _, _, c in o] for u, o in us.items()} for x, us in moves.items()}
    fuels = {x: {u: [fuel[x][u]] * len(o) for u, o in us.items()} for x, us in moves.items()}

    def mean(cost: dict[Any, Any], x: Any, u: Any) -> float:
        return sum(p * c for (p, _, _), c in zip(moves[x][u], cost[x][u], strict=True))

    def charge(cost: dict[Any, Any], x: Any) -> float:
        among = [
            mean(cost, x, u)
            for u, o in moves[x].items()
            if x in known.dead or anywhere or known.staying(o)
        ]
        return min(among, default=0.0) if drawn.charged else 0.0

    def arrival(y: Any, label: str, paid: float) -> tuple[Any, dict[str, float]]:
        """Where a step leads that ends in y, and what counts there, the factor included."""
        counts: dict[str, float] = defaultdict(float)
        for name, members in labels.items():
            if y in members:
                counts[f"visits through {name}"] += gamma
                counts[f"visits {name}"] += gamma * (label == OPEN)
        if y == GOAL:
            counts["goal"] += gamma
            counts["paid"] += gamma * paid
            return None, counts
        if y in known.dead and label == OPEN:
            counts["cost"] += gamma * charge(costs, y)
            counts["fuel"] += gamma * charge(fuels, y)
            counts["fuel through"] += gamma * charge(fuels, y) * (y in known.ends)
        if y in known.ends:
            counts[f"end {first[y]}"] += gamma
            return None, counts
        there = FAILED if y in known.dead else label
        return (y, there, paid if total and there == OPEN else 0.0), counts

    def step(node: Any, u: Any) -> None:
        x, label, paid = node
        leads: dict[Any, float] = defaultdict(float)
        counts: dict[str, float] = defaultdict(float)
        counts["fuel through"] += mean(fuels, x, u)
        if label == OPEN:
            counts["cost"] += mean(costs, x, u)
            counts["fuel"] += mean(fuels, x, u)
        for p, y, c in moves[x][u]:
            to, there = arrival(y, label, paid + c if label == OPEN else 0.0)
            for name, value in there.items():
                counts[name] += p * value
            if to is not None:
                leads[to] += gamma * p
                if to not in seen:
                    seen.add(to)
                    queue.append(to)
        columns.add(node, leads, counts)

    start, at_once = arrival(begin, OPEN, 0.0)
    at_once = {name: value / gamma for name, value in at_once.items()}
    columns.add("source", {} if start is None else {start: 1.0}, at_once)
    queue = [] if start is None else [start]
    seen = set(queue)
    while queue:
        node = queue.pop()
        x, label, _ = node
        for u, outcomes in moves[x].items():
            if label == OPEN or x in known.dead or known.staying(outcomes):
                step(node, u)
        if label == FAILED or drawn.give_up == "dead_ends":
            continue
        given = {"cost": charge(costs, x), "fuel": charge(fuels, x)}
        if x in known.attention:
            columns.add(node, {(x, FAILED, 0.0): 1.0}, given)
            if (x, FAILED, 0.0) not in seen:
                seen.add((x, FAILED, 0.0))
                queue.append((x, FAILED, 0.0))
        elif anywhere:
            columns.add(node, {}, given | {"fuel through": charge(fuels, x)})
    return columns, {"source": 1.0}, gamma


def wanderers(columns: Columns, counted: set[str]) -> set[Any]:
    """Nodes of end components in which nothing counts."""
    inside = {
        k
        for k, leads in enumerate(columns.leads)
        if leads
        and abs(sum(leads.values()) - 1.0) < 1e-12
        and not any(value > 0.0 for n, value in columns.counts[k].items() if n in counted)
    }
    while True:
        ahead: dict[Any, set[Any]] = defaultdict(set)
        for k in inside:
            ahead[columns.source[k]] |= set(columns.leads[k])
        reach = {x: _reached(ahead, x) for x in ahead}
        kept = {
            k
            for k in inside
            if all(y in reach and columns.source[k] in reach[y] for y in columns.leads[k])
        }
        if kept == inside:
            return {columns.source[k] for k in inside}
        inside = kept


def _reached(ahead: Mapping[Any, set[Any]], x: Any) -> set[Any]:
    found, queue = {x}, [x]
    while queue:
        for y in ahead.get(queue.pop(), set()):
            if y not in found:
                found.add(y)
                queue.append(y)
    return found


def reference(drawn: Drawn) -> float | None:
    """The optimal value by the definitions, None where no policy keeps to the limits."""
    found = attained(drawn)
    return None if found is None else found[0]


def attained(
    drawn: Drawn, instead: tuple[str, tuple[Any, ...], str] | None = None
) -> list[float] | None:
    """The optimal value and what each limit's quantity is there, None if nothing is feasible.

    Args:
        drawn: the problem.
        instead: a quantity that is made small ("<=") or large in place of the objective.
    """
    columns, start, _ = program(drawn)
    aim = {"s3p": "paid", "maxprob": "goal"}.get(drawn.criterion, "cost")
    if drawn.asked is not None:
        aim = _counted(*drawn.asked)
    rows = [(_counted(kind, of), sense, bound) for kind, of, sense, bound in drawn.limits]
    # what makes a loop dear; a probability of an end never does
    dear = {name for name, _, _ in rows if not name.startswith("end")}
    if aim not in ("paid", "goal") and not aim.startswith("end"):
        dear.add(aim)
    if aim == "paid":
        dear.add("cost")  # totals are told apart: such a loop leads on to greater ones
    if drawn.discount is None:
        for node in wanderers(columns, dear):
            columns.add(node, {}, {})
    nodes = list(dict.fromkeys([*columns.source, *(y for to in columns.leads for y in to)]))
    place = {node: k for k, node in enumerate(nodes)}
    balance = np.zeros((len(nodes), len(columns.source)))
    for k, (source, leads) in enumerate(zip(columns.source, columns.leads, strict=True)):
        balance[place[source], k] += 1.0
        for y, p in leads.items():
            balance[place[y], k] -= p
    begin = np.array([start.get(node, 0.0) for node in nodes])

    def row(name: str) -> np.ndarray:
        return np.array([counts.get(name, 0.0) for counts in columns.counts])

    upper, bounds = [], []
    for name, sense, bound in rows:
        sign = 1.0 if sense == "<=" else -1.0
        if np.isfinite(bound):
            upper.append(sign * row(name))
            bounds.append(sign * bound)

    def least(objective: np.ndarray, goal: float | None, limited: bool = True) -> Any:
        extra = [] if goal is None else [-row("goal")]
        left = np.array([*(upper if limited else []), *extra]).reshape(-1, len(objective))
        right = np.array([*(bounds if limited else []), *([] if goal is None else [-goal])])
        return linprog(objective, left, right, balance, begin, method="highs")

    def answered(value: float, answer: Any) -> list[float]:
        return [value, *(float(row(name) @ answer.x) for name, _, _ in rows)]

    if drawn.criterion == "maxprob" and instead is None:
        answer = least(-row("goal"), None)
        return None if answer.status == 2 else answered(-float(answer.fun), answer)
    if drawn.budget is None:
        safest = least(-row("goal"), None, limited=False)
        if safest.status == 2:  # what is counted grows without end
            return None
        goal = -float(safest.fun) - LEAST
    else:
        goal = 1.0 - drawn.budget
    if instead is not None:
        aim = _counted(*instead[:2])
        answer = least(row(aim) * (1.0 if instead[2] == "<=" else -1.0), goal)
        return None if answer.status else answered(float(answer.fun), answer)
    if aim != "paid":
        answer = least(row(aim), goal)
        return None if answer.status == 2 else answered(float(answer.fun), answer)
    ratio = 1e6
    for _ in range(60):  # Dinkelbach's iteration
        answer = least(row("paid") - ratio * row("goal"), goal)
        if answer.status == 2 or row("goal") @ answer.x <= 1e-12:
            return None
        better = float(row("paid") @ answer.x / (row("goal") @ answer.x))
        if better >= ratio - 1e-12:
            break
        ratio = better
    return answered(ratio, answer)


def _counted(kind: str, of: tuple[Any, ...]) -> str:
    return " ".join((kind, *map(str, of)))


# ----- the policy, played on ---------------------------------------------------------------------


def played(policy: MixedPolicy, drawn: Drawn, asked: set[str]) -> dict[str, float]:
    """How runs of a policy end, by its chain on (state, what it remembers), undiscounted."""
    model = policy.model
    ends: dict[str, float] = defaultdict(float)
    first = {
        k: next((n for n, m in model.state_labels.items() if k in m.tolist()), "dead_end")
        for k in range(model.n_states)
    }
    for member, weight in zip(policy.policies, policy.weights, strict=True):
        begin = np.array([model.index_of(0)])
        node = int(begin[0]), int(member.start_memory(begin)[0])
        index, moves, queue = {node: 0}, [], [node]
        while queue:
            here = queue.pop()
            for p, to in _played_moves(member, model, here):
                if not isinstance(to, str) and to not in index:
                    index[to] = len(index)
                    queue.append(to)
                moves.append((index[here], p, to))
        names = list(dict.fromkeys(to for _, _, to in moves if isinstance(to, str)))
        chain, hits = np.eye(len(index)), np.zeros((len(index), len(names)))
        for source, p, to in moves:
            if isinstance(to, str):
                hits[source, names.index(to)] += p
            else:
                chain[source, index[to]] -= p
        back: dict[Any, set[Any]] = defaultdict(set)
        for source, _, to in moves:
            back["over" if isinstance(to, str) else index[to]].add(source)
        settling = sorted(_reached(back, "over") - {"over"})  # the others wander for ever
        settled = np.zeros_like(hits)
        settled[settling] = np.linalg.solve(chain[np.ix_(settling, settling)], hits[settling])
        for name, share in zip(names, settled[0], strict=True):
            ends[name] += float(weight) * float(share)
    told: dict[str, float] = defaultdict(float)
    for name, share in ends.items():
        told[first[int(name)] if name.isdigit() else name] += share
    return told


def _played_moves(member: Any, model: SSP, node: tuple[int, int]) -> Iterator[tuple[float, Any]]:
    """What happens next: a node with its probability, or the name of an end."""
    state, memory = node
    here, kept = np.array([state]), np.array([memory])
    if model.goal_mask[state]:
        yield 1.0, "goal"
        return
    if member.ended[state]:
        yield 1.0, str(state)
        return
    found = member.branches(here, kept)
    columns = found.pair, found.probability, found.kept(kept)
    for pair, chance, own in zip(*(column.tolist() for column in columns), strict=True):
        if pair == -1:
            yield chance, "gave_up"
            continue
        some = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
        successors, costs = model.successors[some].astype(np.int64), model.costs[some]
        taken = np.full(successors.size, pair)
        over = member.ended[successors]
        moved = np.zeros(successors.size, dtype=np.int64)
        step = taken[~over], successors[~over], costs[~over]
        moved[~over] = member.remember(np.full((~over).sum(), own), *step)
        chances = model.probabilities[some].tolist()
        for p, y, after in zip(chances, successors.tolist(), moved.tolist(), strict=True):
            yield chance * p, (y, after)


# ----- the check ---------------------------------------------------------------------------------


def wrong(drawn: Drawn, counts: Counter[str], *, by_program: bool = False) -> list[str]:
    """What is wrong with the library's answer; nothing if it is right."""
    problem, expected = stated(drawn), reference(drawn)
    try:
        solution = solve(problem)
    except InfeasibleError as error:
        counts["infeasible"] += 1
        return [] if expected is None else [f"infeasible ({error}), but {expected!r} is attained"]
    if expected is None:
        return [f"{solution.objective!r}, but no policy keeps to the limits"]
    told = []
    if abs(solution.objective - expected) > AGREES * max(1.0, abs(expected)):
        told.append(f"{solution.objective!r}, by the definitions {expected!r}")
    if not (proof := certify(solution)).accepted:
        told.append(f"not certified: {proof.reason}")
    evaluation = evaluate(solution.policy, problem)
    counts["with a price on what is limited"] += any(
        price > 0.0 for name, price in solution.prices.items() if name != "failure"
    )
    for k, (_, _, sense, bound) in enumerate(drawn.limits):
        value = evaluation.secondary_costs[f"limit {k}"]
        if (value > bound + ROOM) if sense == "<=" else (value < bound - ROOM):
            told.append(f"limit {k} {sense} {bound} is broken: {value!r}")
    if drawn.budget is not None and evaluation.limited_failure > drawn.budget + ROOM:
        told.append(f"fails with {evaluation.limited_failure!r}, {drawn.budget} allowed")
    afresh = evaluate(solution.policy, replace(problem))  # on another product with the label
    for name, value in {**evaluation.ends, **evaluation.secondary_costs}.items():
        other = afresh.ends.get(name, afresh.secondary_costs.get(name))
        if other is None or abs(other - value) > AGREES:
            told.append(f"{name} is {value!r}, evaluated afresh {other!r}")
    if abs(afresh.objective - evaluation.objective) > AGREES * max(1.0, abs(expected)):
        told.append(f"{evaluation.objective!r}, evaluated afresh {afresh.objective!r}")
    if by_program:
        other = solve(problem, "lp").objective
        counts["by the full program"] += 1
        if abs(other - expected) > AGREES * max(1.0, abs(expected)):
            told.append(f"by the full program {other!r}, by the definitions {expected!r}")
    asked = {n for kind, of, _, _ in drawn.limits if kind == "end" for n in of}
    ends = played(solution.policy, drawn, asked)
    for name in ("goal", *asked):
        if abs(ends.get(name, 0.0) - evaluation.ends[name]) > AGREES:
            told.append(f"{name} {evaluation.ends[name]!r}, played on {ends.get(name, 0.0)!r}")
    return told


def smaller(case: Drawn) -> Iterator[Drawn]:
    """The same with a limit, a horizon or a discount less, or a smaller model."""
    for k in range(len(case.limits)):
        yield replace(case, limits=case.limits[:k] + case.limits[k + 1 :])
    if case.horizon is not None:
        yield replace(case, horizon=None)
    if case.discount is not None:
        yield replace(case, discount=None)
    for table in smaller_tables(case.moves):
        left = {
            s: {a: fuel for a, fuel in case.fuel[s].items() if a in table[s]} for s in case.fuel
        }
        yield replace(case, moves=table, fuel=left)


def shrunk(case: Drawn, *, by_program: bool) -> Drawn:
    """The smallest problem that is told wrongly, as this one is."""

    def fails(other: Drawn) -> bool:
        try:
            return bool(wrong(other, Counter(), by_program=by_program))
        except (SSPError, KeyError):
            return False  # a question that is none any more

    return smallest(case, smaller, fails)


def main(arguments: Sequence[str] | None = None) -> int:
    """Check problems from the command line; 1 if anything was found."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--criteria", nargs="+", choices=CRITERIA, default=list(CRITERIA))

    def case(seed: int, asked: argparse.Namespace) -> Drawn:
        return drawn(seed, asked.criteria[seed % len(asked.criteria)])

    def check(seed: int, counts: Counter[str], asked: argparse.Namespace) -> list[str]:
        problem = case(seed, asked)
        counts["past failing"] += stated(problem).unrolled.model.failure_label is not None
        return wrong(problem, counts, by_program=seed % 3 == 0)

    return run(
        __doc__, check, arguments, count=100, options=options,
        shrink=lambda seed, asked: shrunk(case(seed, asked), by_program=seed % 3 == 0),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
