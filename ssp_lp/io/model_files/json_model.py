"""Models in JSON files: transitions by names of states, or lists of choices by state number."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ssp_lp.errors import Argument, ModelError, did_you_mean
from ssp_lp.io.model_files.raw_model import FIRST_COST, opened_text
from ssp_lp.model import SSP
from ssp_lp.model.ssp import DeadEnds

_EXPLICIT = "explicit-mdp-v1"
"""Prefix of the "format" of files that list the choices of numbered states."""

_LONGEST = 1 << 30  # characters of a file, so that a packed one cannot fill all memory


def read_json(
    path: Path, goal: Sequence[str], cost: str | None = None, dead_ends: DeadEnds | None = None
) -> StatedModel:
    """Read a model from a JSON file, plain or gzip; see :func:`parse_json`.

    Raises:
        ModelError: the file contains no model.
        OSError: the file cannot be read.
    """
    with opened_text(path, "JSON") as file:
        text = file.read(_LONGEST)
    return parse_json(text, path.name, goal, cost, dead_ends)


def parse_json(
    text: str,
    source: str,
    goal: Sequence[str],
    cost: str | None = None,
    dead_ends: DeadEnds | None = None,
) -> StatedModel:
    """Return the model in a JSON text.

    The text is a table ``{state: {action: [[probability, successor, cost], ...]}}``, alone or as
    "transitions" beside "goal", "start", "labels" and "dead_ends". Names are strings, a cost is a
    number or ``{name: number}``, and a number may be a fraction as a string, "1/3". A text with the
    "format" "explicit-mdp-v1" instead lists the choices of each state, by number.

    Args:
        text: the JSON.
        source: name of the text in errors.
        goal: names of the goal states, or labels of sets of states; empty: the text's "goal".
        cost: name of the cost; None: the only one.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate.
            None: the text's "dead_ends", or not checked if ``goal`` differs from the text's "goal".

    Raises:
        ModelError: the text has another form, repeats a name, has no goal, or has a goal that is no
            state.
    """
    try:
        table = json.loads(text, object_pairs_hook=_without_repetition)
    except ModelError:
        raise
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{source} is not JSON: {error}") from error
    if not isinstance(table, dict):
        raise ModelError(f"{source} must contain {_TABLE}")
    if isinstance(table.get("format"), str):
        return _stated_model(_explicit_json(table, source, goal, cost), source, (), cost, dead_ends)
    if not isinstance(table.get("goal"), list):
        table = {"goal": [], "transitions": table}
    return _stated_model(table, source, goal, cost, dead_ends)


def _explicit_json(
    table: Mapping[str, Any], source: str, goal: Sequence[str], cost: str | None
) -> dict[str, Any]:
    """Convert a file of choices, listed by state index, to transitions by state name."""
    if not str(table["format"]).startswith(_EXPLICIT):
        raise ModelError(f"{source}: the format {table['format'][:40]!r} is unknown")
    try:
        choices, labels = table["choices"], dict(table.get("labels", {}))
        goals = {g for one in goal for g in labels.get(one, [one])} or set(table["goal"] or ())
        names = {name for listed in choices for one in listed for name in one["rewards"]}
        none_given = dict.fromkeys(sorted(names), 0) or {UNIT: 1}
        if cost != UNIT:
            _counted_cost(source, none_given, cost)
        transitions: dict[str, dict[str, Any]] = {}
        for state, listed in enumerate(choices):
            known = Counter(one["name"] for one in listed)
            transitions[str(state)] = actions = {}
            for at, one in enumerate(listed):
                paid = {**none_given, **one["rewards"]}
                name = str(one["name"]) if known[one["name"]] == 1 else f"{at}:{one['name']}"
                actions[name] = [[chance, successor, paid] for successor, chance in one["to"]]
        return {
            "goal": [str(g) for g in goals],
            "start": str(table["init"]),
            "labels": {k: v for k, v in labels.items() if k not in {"goal", "init", "deadlock"}},
            "transitions": transitions,
        }
    except ModelError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(f"{source} is no {_EXPLICIT} file: {error!r}") from error


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object, or raise :class:`ModelError` for a repeated name."""
    members = dict(pairs)
    if len(members) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in members if names.count(name) > 1)
        raise ModelError(f"{twice!r} occurs twice in one object")
    return members


UNIT = "unit"
"""Name of the cost of 1 for each step, which files do not contain."""

_TABLE = "{state: {action: [[probability, successor, cost], ...]}}"
_FRACTION = re.compile(r"-?\d{1,300}([./]\d{1,300})?")


class StatedModel(NamedTuple):
    """A model in a file, with its start if the file states one."""

    model: SSP
    start: Hashable | Mapping[Hashable, float] | None = None


def _stated_model(
    table: Mapping[str, Any],
    source: str,
    goal: Sequence[str],
    cost: str | None,
    dead_ends: DeadEnds | None,
) -> StatedModel:
    """Return the model of a JSON document: transitions by state and action, goal, start and labels.

    Raises:
        ModelError: see :func:`parse_json`.
    """
    listed, labels, start = table.get("transitions"), table.get("labels", {}), table.get("start")
    for what, found in (("transitions", listed), ("labels", labels)):
        if not isinstance(found, dict):
            raise ModelError(f"{source}: {what!r} must be an object")
    listed_ends = table.get("dead_ends")
    for name, members in {**labels, "dead_ends": listed_ends or []}.items():
        if not isinstance(members, list):
            raise ModelError(f"{source}: the label {name!r} must be a list of states")
    labels = {name: [str(state) for state in members] for name, members in labels.items()}
    own_goal = [str(name) for name in table["goal"]]
    if dead_ends is None and listed_ends is not None and set(goal or own_goal) == {*own_goal}:
        dead_ends = [*map(str, listed_ends)]  # for another goal they need not be dead-ends
    goal = goal or own_goal
    if not goal:
        message = f"{source} does not list the goal states: name them by "
        raise ModelError(message, Argument("goal"))
    transitions: dict[Hashable, Any] = {}
    counted = set[str]()
    for state, actions in (listed or {}).items():
        if not isinstance(actions, dict):
            message = f"state {state!r} needs {{action: [[probability, successor, cost], ...]}}"
            raise ModelError(message)
        transitions[state] = {
            name: [
                _json_outcome(f"action {name!r} of state {state!r}", outcome, cost, counted)
                for outcome in (outcomes if isinstance(outcomes, list) else [outcomes])
            ]
            for name, outcomes in actions.items()
        }
    # a name that an outcome lacks costs nothing there
    named = [paid for acts in transitions.values() for some in acts.values() for *_, paid in some]
    unpaid = {name: 0.0 for paid in named if isinstance(paid, dict) for name in paid}
    for paid in named:
        if isinstance(paid, dict):
            paid |= {**unpaid, **paid}
    met = {to for actions in transitions.values() for some in actions.values() for _, to, _ in some}
    goals = [name for one in goal for name in labels.get(one, [one])]
    for name in goals:
        if name not in transitions and name not in met:
            names = [*transitions, *(to for to in met if to not in transitions)]
            raise ModelError(
                f"the goal {name!r} does not occur{did_you_mean(name, names, 'the states:')}"
            )
    model = SSP.from_transitions(
        transitions,
        goals,
        cost=next(iter(counted), None),
        state_labels=labels,
        dead_ends=dead_ends,
        treat_actionless_as_dead_ends=True,
    )
    return StatedModel(model, start if start is None or isinstance(start, dict) else str(start))


def _json_outcome(
    where: str, outcome: Any, cost: str | None, counted: set[str]
) -> tuple[Any, Hashable, Any]:
    """Check an outcome and return (probability, successor, cost).

    The name of the minimised cost, if costs are named, is added to ``counted``. ``where`` names the
    pair in errors.
    """
    fits = isinstance(outcome, list) and len(outcome) == 3
    if not fits or not isinstance(outcome[1], (str, int)):
        raise ModelError(
            f"{where}: an outcome must be [probability, successor, cost], not {json.dumps(outcome)}"
        )
    chance, successor, paid = outcome
    named = paid if isinstance(paid, dict) else {}
    if cost == UNIT:
        named = {UNIT: 1.0, **named}
    if named or isinstance(paid, dict):
        counted.add(_counted_cost(where, named, cost))
        paid = {name: _json_number(value) for name, value in named.items()}
    elif cost not in (None, FIRST_COST):
        message = f"{where}: the costs of this model have no names such as {cost!r}: leave out "
        raise ModelError(message, Argument("cost"))
    return _json_number(chance), str(successor), _json_number(paid)


def _counted_cost(where: str, costs: Mapping[str, Any], cost: str | None) -> str:
    """Return the name of the cost to be minimised: ``cost``, or the only name."""
    if cost is not None and cost in costs:
        return cost
    if costs and (cost == FIRST_COST or (cost is None and len(costs) == 1)):
        return next(iter(costs))
    hint = "" if cost is None else f", not {cost!r}{did_you_mean(cost, costs)}"
    choices = f"{', '.join(map(repr, costs))}, or {UNIT!r}, which is 1 for each step"
    raise ModelError(f"{where}: choose one of the costs (", Argument("cost"), f"): {choices}{hint}")


def _json_number(value: Any) -> Any:
    """Return a text such as "1/3" or "0.1" as a fraction; other values unchanged."""
    if isinstance(value, str) and _FRACTION.fullmatch(value) and not re.search(r"/0+$", value):
        return Fraction(value)
    return value


def model_in_json(
    model: SSP, start: Hashable | Mapping[Hashable, float] | None = None
) -> Iterator[str]:
    """Yield a complete model as a JSON text, a line for each state.

    States and actions are written by name, as text.

    Args:
        model: the model.
        start: where episodes begin; None: omitted.

    Raises:
        ModelError: two states, or two actions of one state, have the same word.
    """
    names = [str(state) for state in model.states]
    if len(set(names)) < len(names):
        raise ModelError("two states of the model are written alike: rename one of them")
    idle = np.diff(model.pair_offsets) == 0
    stated: dict[str, Any] = {
        "goal": [names[k] for k in model.goal_mask.nonzero()[0].tolist()],
        "dead_ends": [names[k] for k in np.flatnonzero(idle & ~model.goal_mask).tolist()],
        "labels": {word: [names[k] for k in at] for word, at in model.state_labels.items()},
    }
    if isinstance(start, Mapping):
        stated["start"] = {names[model.index_of(state)]: share for state, share in start.items()}
    elif start is not None:
        stated["start"] = names[model.index_of(start)]
    yield json.dumps(stated, ensure_ascii=False)[:-1] + ', "transitions": {'
    by_name = model.costs_by_name

    def paid(costs: Sequence[float]) -> Any:
        """Return an outcome's costs: a number, or ``{name: number}``; fractions are strings."""
        amounts = [str(model.exact_costs.get(cost, "")) or cost for cost in costs]
        return dict(zip(by_name, amounts, strict=True)) if model.named_costs else amounts[0]

    numbers = model.probabilities, model.successors, *by_name.values()
    for state, name in enumerate(names):
        rows: dict[str, list[list[Any]]] = {}
        for pair in model.pairs_of(state):
            action = str(model.action_names[int(model.pair_action[pair])])
            if action in rows:
                raise ModelError(f"two actions of state {name!r} are written {action!r}")
            part = slice(model.outcome_offsets[pair], model.outcome_offsets[pair + 1])
            rows[action] = [
                [chance, names[to], paid(costs)]
                for chance, to, *costs in zip(*(n[part].tolist() for n in numbers), strict=True)
            ]
        line = json.dumps({name: rows}, ensure_ascii=False)[1:-1]
        yield ("\n" if state == 0 else ",\n") + line
    yield "\n}}\n"
