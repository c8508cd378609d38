"""Hypothesis strategies: small stochastic shortest path problems, degenerate on purpose.

Drawn from few probabilities and small integer costs, so that ties, duplicate actions, duplicate
successors with different costs, free cycles, classes that never pay and sure failure all come up
often. Live states are called "a", "b", ..., goals "G0", "G1", dead-ends "d0" (free self-loop),
"d1" (paying self-loop), "d2" (no action at all), "d3" and "d4" (a cycle of two with a choice).
"""

from dataclasses import dataclass

from hypothesis import settings, strategies as st

SPLITS = (
    (1.0,),
    (1.0,),
    (0.5, 0.5),
    (0.25, 0.75),
    (0.75, 0.25),
    (0.2, 0.8),
    (0.9, 0.1),
    (0.25, 0.25, 0.5),
    (0.5, 0.25, 0.25),
    (1.0, 0.0),
)
"""How the probability of an action is shared out; no positive share is below 1/10."""

DEAD_ENDS = {
    "d0": {"stuck": [(1.0, "d0", 0)]},
    "d1": {"stuck": [(1.0, "d1", 2)]},
    "d2": {},
    "d3": {"left": [(1.0, "d4", 3)], "right": [(0.5, "d3", 1), (0.5, "d4", 2)]},
    "d4": {"back": [(1.0, "d3", 1)]},
}


@dataclass(frozen=True)
class Draw:
    """One drawn problem: nested-dict choices, goals, and a start state or distribution."""

    choices: dict
    goals: frozenset
    start: object


@st.composite
def problems(draw, most_live=4, most_actions=3, most_cost=3, attention=False):
    """A problem with 1 to `most_live` live states; with `attention`, all of them can wait."""
    live = "abcdef"[: draw(st.sampled_from([n for n in (3, 2, 4, 3, 2, 1) if n <= most_live]))]
    goals = ["G0", "G1"][: draw(st.integers(1, 2))]
    dead = draw(st.sampled_from([("d1",), ("d0",), ("d2",), (), ("d0", "d1"), ("d3", "d4")]))
    targets = st.sampled_from([*live, *goals, *dead, *goals, *dead[:1]])
    costs = st.sampled_from([1, 0, *range(most_cost + 1)])
    choices = {}
    for state in live:
        count = draw(st.sampled_from([n for n in (2, 3, 2, 1) if n <= most_actions]))
        listed = [draw(_outcomes(targets, costs)) for _ in range(count)]
        choices[state] = {f"u{k}": outcomes for k, outcomes in enumerate(listed)}
        if attention:
            choices[state]["wait"] = [(1.0, state, draw(costs))]
    choices |= {state: DEAD_ENDS[state] for state in dead}
    return Draw(choices, frozenset(goals), draw(_starts(live, [*live, *goals, *dead])))


@st.composite
def _outcomes(draw, targets, costs):
    """The outcomes of one action; a successor may come twice, at different costs."""
    return [(p, draw(targets), draw(costs)) for p in draw(st.sampled_from(SPLITS))]


@st.composite
def _starts(draw, live, every):
    """The first live state, or a distribution over two states of any kind and the first."""
    if draw(st.booleans()):
        return live[0]
    start = {}
    for weight in draw(st.sampled_from(SPLITS)):
        state = draw(st.sampled_from(every)) if start else live[0]
        start[state] = start.get(state, 0.0) + weight
    return start


def acyclic_problems(most_live=3, most_actions=3):
    """Problems whose live states only move on, so that every run ends within a few steps."""
    return problems(most_live=most_live, most_actions=most_actions).map(_forward)


def _forward(drawn):
    """Send every step back, or in place, to the goal instead."""
    live = [state for state in drawn.choices if not state.startswith("d")]
    onward = {
        state: {
            action: [
                (p, "G0" if s in live and live.index(s) <= rank else s, cost)
                for p, s, cost in outcomes
            ]
            for action, outcomes in drawn.choices[state].items()
        }
        for rank, state in enumerate(live)
    }
    return Draw({**drawn.choices, **onward}, drawn.goals, drawn.start)


budgets = st.sampled_from([0.1, 0.0, 0.25, 1 / 3, 0.5, 0.75, 0.95, 1e-3, "kink", "below"])
"""Where the budget lies between the least failure (0) and sure failure (1), or a named place."""

discounts = st.sampled_from([None, 0.5, 0.9, 0.99])
meanings = st.sampled_from(["anywhere", "attention", "dead_ends"])
semantics = st.fixed_dictionaries({"give_up": meanings, "charge_failing_step": st.booleans()})


def often(examples):
    """The settings of every test on draws; only the number of examples differs."""
    return settings(max_examples=examples, deadline=None, derandomize=True)
