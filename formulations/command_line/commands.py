"""Commands: from the words of a shell to a model and a problem, and to the lines printed."""

from __future__ import annotations

import json
import re
import sys
from argparse import ArgumentTypeError
from ast import literal_eval
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, fields, replace
from operator import eq, ge, le
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import ssp_lp
from ssp_lp import SSP, ModelError, Solution, io
from ssp_lp.analysis.simulation import Estimate
from ssp_lp.errors import Argument, SolverError, check_whole, did_you_mean, optional_module
from ssp_lp.formulation import Problem, attention_labels, dead_end_labels
from ssp_lp.io.any_format import Start
from ssp_lp.io.model_files.json_model import model_in_json, parse_json
from ssp_lp.io.model_files.raw_model import FIRST_COST
from ssp_lp.methods.labelled_program import program_of
from ssp_lp.model.report import Table
from ssp_lp.plotting import explore, plot_cost_law, plot_frontier, plot_tornado, row_major
from ssp_lp.policies.policy import Policy
from ssp_lp.policies.remembering import LabelledPolicy, RememberingPolicy

from ..maxprob import MaxProb
from ..mcmp import MCMP
from .arguments import CRITERIA, PARAMETERS, number_argument, option

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ENVIRONMENT = "gym:"
"""Prefix of the name of a Gymnasium environment."""

Asked = Mapping[str, Any]
"""Arguments of a command by name; those of a criterion only if they were given."""


@dataclass(frozen=True)
class _CommandModel:
    """A model with its start and, if it was made from one, its Gymnasium environment."""

    asked: Asked
    model: SSP
    stated_start: Start | None
    horizon: int | None  # steps within which the goal must be reached
    environment: Any = None

    @property
    def start(self) -> Start:
        """Start of an episode.

        Raises:
            ModelError: neither the file nor the command states a start.
        """
        if self.stated_start is None:
            raise ModelError("say where an episode begins: --start STATE")
        return self.stated_start

    @property
    def written_out(self) -> tuple[SSP, Start | None]:
        """Return the model and its start; with a horizon, those of the product that counts steps.

        Raises:
            ModelError: a horizon without a start.
        """
        if self.horizon is None:
            return self.model, self.stated_start
        begin = self.start if isinstance(self.start, Mapping) else {self.start: 1.0}
        counting = ssp_lp.within_steps(self.model, self.horizon, start=begin)
        return counting, counting.start(begin)


def command_model(asked: Asked) -> _CommandModel:
    """Read the model that the arguments of a command name.

    Raises:
        ModelError: no model, or a start that is not a state.
        MissingDependencyError: an environment, but Gymnasium is not installed.
        OSError: the file cannot be read.
    """
    source, goal, cost, ends = (asked[name] for name in ("model", "goal", "cost", "dead_ends"))
    if source.startswith(_ENVIRONMENT):
        return _model_of_environment(asked)
    if cost is None and asked["command"] in ("info", "convert"):  # which minimise no cost
        cost = FIRST_COST
    if source == "-":
        model, start = parse_json(sys.stdin.read(), "standard input", goal, cost, ends)
    else:
        model, start = io.read_any(source, goal, cost, asked["constants"], ends)
    if asked["start"] is not None:
        start = _state_named(model, asked["start"])
    horizon = None if asked["horizon"] == "env" else asked["horizon"]
    return _CommandModel(asked, model, start, horizon)


def _model_of_environment(asked: Asked) -> _CommandModel:
    """Return the model of the Gymnasium environment that a command names."""
    gymnasium = optional_module("gymnasium", "gym")
    name, *words = asked["model"].removeprefix(_ENVIRONMENT).split(",")
    arguments = {key: _value_for_model(word) for key, _, word in (w.partition("=") for w in words)}
    try:
        environment = gymnasium.make(name, **arguments)
    except (gymnasium.error.Error, TypeError, KeyError, ModuleNotFoundError) as error:
        raise ModelError(f"Gymnasium cannot make {asked['model']!r}: {error}") from error
    goal, start, ends = asked["goal"], asked["start"], asked["dead_ends"]
    world = io.from_gymnasium(
        environment,
        goal=[_value_for_model(word) for word in goal] or None,
        cost=asked["cost"] or "step",
        horizon=None,
        start=None if start is None else _value_for_model(start),
        dead_ends=ends and [_value_for_model(word) for word in ends],
    )
    horizon = world.step_limit if asked["horizon"] == "env" else asked["horizon"]
    return _CommandModel(asked, world.model, world.start, horizon, environment)


def _value_for_model(word: str) -> Any:
    """Return the value that a word stands for in Python or JSON, or else the word itself."""
    for read in (literal_eval, json.loads):
        with suppress(ValueError, SyntaxError):
            return read(word)
    return word


def _state_named(model: SSP, word: str) -> Hashable:
    """Return the state of a model that a word names; the word itself if no state fits."""
    return next((state for state in model.states if str(state) == word), word)


_LIMIT = re.compile(r"(?P<words>.*?)\s*(?P<sign><=|>=|==)\s*(?P<bound>\S+)")
_TERM = re.compile(r"(?:(?P<factor>[^\s*]+)\s*\*\s*)?(?P<word>[^\s(]+)(?:\((?P<of>.*)\))?")
_PLAIN: dict[str, Callable[[], ssp_lp.Quantity]] = {
    "cost": ssp_lp.expected_cost,
    "goal": ssp_lp.goal_probability,
    "failure": ssp_lp.failure_probability,
}
_OF_STATES: dict[str, Callable[..., ssp_lp.Quantity]] = {
    "visits": ssp_lp.visits,
    "end": ssp_lp.end_probability,
}
_SIGNS: dict[str, Callable[..., ssp_lp.Constraint]] = {"<=": le, ">=": ge, "==": eq}


def problem_of(of: _CommandModel, **others: Any) -> Problem:
    """Return the problem that the arguments of a command state.

    Args:
        of: the model, with the arguments of the command.
        others: arguments that replace the command's.

    Raises:
        ModelError: an argument that the criterion does not have, lacks, or rejects.
    """
    asked = {**of.asked, **others}
    page = asked["criterion"]
    criterion = getattr(ssp_lp, CRITERIA[page])
    takes = {field.name: field for field in fields(criterion) if field.name in PARAMETERS}
    given = {name: asked[name] for name in PARAMETERS if name in asked}
    for name in given:
        if name not in takes:
            options = ", ".join(map(option, takes)) or "none"
            raise ModelError(f"{page} has no {option(name)}; its options: {options}")
    for name, field in takes.items():
        if name not in given and field.default is MISSING and name != "failure_budget":
            raise ModelError(f"{page} needs {option(name)}: {PARAMETERS[name].help}")
    if "quantity" in given:
        given["quantity"] = _problem_quantity(given["quantity"], of)
    limits: dict[str, ssp_lp.Constraint] = {}
    for words in asked["limit"]:
        match = _LIMIT.fullmatch(words.strip())
        if match is None:
            raise ModelError(f'a limit is written "QUANTITY <= NUMBER" (or >=, ==), not "{words}"')
        name, compared = match["words"], _SIGNS[match["sign"]]
        constraint = compared(_problem_quantity(name, of), _problem_number(match["bound"], words))
        limits[words if name in {"failure", *limits} else name] = constraint
    stated = criterion(of.model, of.start, **given, constraints=limits, horizon=of.horizon)
    return cast("Problem", stated)


def _problem_quantity(words: str, of: _CommandModel) -> ssp_lp.Quantity:
    """Return the quantity that words such as "cost + 2 * visits(ward)" name.

    Raises:
        ModelError: words that are not a quantity of this model.
    """
    terms = []
    for one in words.split(" + "):
        match = _TERM.fullmatch(one.strip())
        if match is None:
            raise ModelError(f'"{words}" is not a sum such as cost + 2 * visits(ward)')
        factor, word, states = match.groups()
        if word in _OF_STATES and states:
            is_label = states in of.model.state_labels
            measured = _OF_STATES[word](states if is_label else _state_named(of.model, states))
        elif word in _PLAIN:
            measured = _PLAIN[word]()
        elif word in of.model.named_costs:
            measured = ssp_lp.secondary_cost(word)
        else:
            names = [*_PLAIN, *(f"{name}(...)" for name in _OF_STATES), *of.model.named_costs]
            nearest = did_you_mean(word, dict.fromkeys(names), "quantities are")
            raise ModelError(f"{word!r} is not a quantity of this model{nearest}")
        terms.append(measured if factor is None else _problem_number(factor, words) * measured)
    return sum(terms[1:], start=terms[0])


def _problem_number(word: str, whole: str) -> float:
    """Return the number that a word stands for; ``whole`` is the text around it, for the error."""
    try:
        return float(number_argument(word))
    except ArgumentTypeError as error:
        raise ModelError(f'"{word}" in "{whole}" is not a number') from error


_OPERATOR = re.compile(
    r'\s*(?P<measure>[PR])\s*(?:\{\s*"(?P<cost>[^"]*)"\s*\})?\s*'
    r"(?P<relation>max\s*=\s*\?|min\s*=\s*\?|>=|<=)\s*(?P<bound>[^\s\[]*)\s*\[\s*(?:C|F\s*"
    r'(?:<=\s*(?P<steps>\d+)\s*)?\(?(?P<target>"[^"]+"|[^\]]+?)\)?)\s*\]\s*'
)
_TAKEN = 'multi(R{"time"}min=? [F "ok"], P>=0.95 [F "ok"], P<=0.01 [F "crash"])'


class _Operator(NamedTuple):
    """One operator of a property, such as ``P>=0.95 [F "ok"]``."""

    words: str
    measure: str  # P or R
    cost: str | None
    relation: str  # max=?, min=?, >= or <=
    bound: str
    steps: str | None  # within which the target is reached
    target: str | None  # reached state or label; None: [C], the total


def with_property(asked: Asked) -> Asked:
    """Return the arguments of a command, with those that its PRISM property states.

    The operator with =? gives the criterion, and P>= gives the least goal probability. The other
    operators become limits: P<= on the probability of an end, R<= on a cost. As everywhere in this
    library, costs count until the goal is reached or lost, also with [C].

    Raises:
        ModelError: the property is not supported, or contradicts the other arguments.
    """
    words = asked.get("property")
    if words is None:
        return asked
    operators = _operators_in(words)
    objectives = [one for one in operators if one.relation.endswith("?")]
    if len(objectives) != 1:
        raise ModelError(f"{words}: exactly one operator must have =?, not {len(objectives)}")
    (objective,) = objectives
    reaching = [one for one in operators if (one.measure, one.relation) == ("P", ">=")]
    goals = {one.target for one in (objective, *reaching) if one.target is not None}
    if len(goals) != 1:
        raise ModelError(f"{words}: =? and P>= must have one goal [F ...], not {sorted(goals)}")
    if (objective.measure, objective.relation) not in {("P", "max=?"), ("R", "min=?")}:
        raise ModelError(f"{objective.words}: the objective must be Pmax=? or Rmin=?")
    (goal,) = goals
    stated: dict[str, Any] = {"goal": [goal], "limit": list(asked["limit"])}
    if objective.measure == "P":
        stated["criterion"] = "maxprob"
    elif reaching:
        least = max(number_argument(one.bound) for one in reaching)
        stated |= {"criterion": "mcmp", "failure_budget": float(1 - least), "cost": objective.cost}
    else:
        stated |= {"criterion": "min-cost", "cost": objective.cost}
    for one in operators:
        if one.relation == "<=":
            limited = (one.cost or "cost") if one.measure == "R" else f"end({one.target})"
            stated["limit"].append(f"{limited} <= {one.bound}")
        elif one.measure == "R" and one is not objective:
            raise ModelError(f"{one.words}: a cost can have an upper bound only")
    steps = {one.steps for one in operators if one.steps is not None}
    if steps:
        if len(steps) > 1 or any(one.steps is None and one.target == goal for one in operators):
            raise ModelError(f"{words}: all operators must have the same number of steps")
        stated["horizon"] = int(*steps)
    for name in ("goal", "cost"):
        if asked[name] and asked[name] != stated.get(name, asked[name]):
            raise ModelError(f"--{name} contradicts the property {words}")
    return {**asked, **{name: word for name, word in stated.items() if word is not None}}


def _operators_in(words: str) -> list[_Operator]:
    """Return the operators of a property: one, or several in ``multi( , )``.

    Raises:
        ModelError: words that are not an operator.
    """
    several = re.fullmatch(r"\s*multi\s*\((.*)\)\s*", words)
    operators = []
    for one in re.split(r"(?<=\])\s*,", several[1]) if several else [words]:
        found = _OPERATOR.fullmatch(one)
        if found is None:
            raise ModelError(f"{one.strip()!r} is not a supported property; one is {_TAKEN}")
        named = _Operator(one.strip(), *found.groups())
        relation, target = re.sub(r"\s", "", named.relation), named.target
        try:
            number_argument(named.bound or "0")
        except ArgumentTypeError as error:
            raise ModelError(f"{named.words}: {error}") from error
        if relation.endswith("?") == bool(named.bound):
            raise ModelError(f"{named.words}: >= and <= need a number, =? has none")
        if named.measure == "P" and target is None:
            raise ModelError(f"{named.words}: P needs a target, [F ...]")
        operators.append(named._replace(relation=relation, target=target and target.strip('"')))
    return operators


def json_answer(answer: Any) -> list[str]:
    """Return an answer in JSON, with null for infinite and undefined numbers."""
    finite = json.loads(json.dumps(answer), parse_constant=lambda _: None)
    return [json.dumps(finite, indent=2, ensure_ascii=False)]


def _csv_answer(path: str, table: Table) -> list[str]:
    """Return the lines of a table as CSV if the path is "-"; else write them to the file.

    After writing a file, there are no lines to return.
    """
    if path == "-":
        return table.csv().splitlines()
    Path(path).write_text(table.csv(), encoding="utf-8")
    return []


def with_options(error: ssp_lp.SSPError) -> str:
    """Return an error's message, with command-line options in place of Python's arguments."""
    return "".join(option(*one) if isinstance(one, Argument) else str(one) for one in error.args)


@contextmanager
def picture(path: str | None) -> Iterator[Axes | None]:
    """Yield new axes, and save the drawing on them to a file; None without a path.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        ModelError: matplotlib has no format with this ending.
    """
    if path is None:
        yield None
        return
    module = optional_module("matplotlib.figure", "plot")
    figure = module.Figure(figsize=(6.4, 4.2), layout="constrained")  # needs no screen
    formats = figure.canvas.get_supported_filetypes()
    if Path(path).suffix.removeprefix(".") not in formats:
        raise ModelError(f"{path!r} must end in one of {', '.join(sorted(formats))}")
    yield figure.subplots()
    figure.savefig(path)


_WRITERS: dict[str, Callable[[Any, str], object]] = {
    ".npz": io.save_policy,
    ".json": io.write_controller,
    ".h": io.write_c_header,
    ".csv": lambda policy, path: _csv_answer(path, policy.table().all_rows()),
}
"""Writers of policies, by the ending of the file's name."""


def _solve_command(asked: Asked) -> Iterable[str]:
    out = asked["policy_out"]
    write = None if out is None else _WRITERS.get(Path(out).suffix)
    if out is not None and write is None:  # before the solve
        raise ModelError(f"{out!r} must end in one of {', '.join(_WRITERS)}")
    search = {name: asked[name] for name in ("method", "tolerance", "time_limit")}
    if isinstance(budgets := asked.get("failure_budget"), list):
        return _several_answers(command_model(asked), budgets, search)
    with picture(asked["plot"]) as ax:
        solution = ssp_lp.solve(problem_of(command_model(asked)), **search)
        if write is not None:
            write(solution.policy_everywhere() if asked["everywhere"] else solution.policy, out)
        if asked["certificate_out"] is not None:
            ssp_lp.write_certificate(solution, asked["certificate_out"])
        if ax is not None:
            level = {"level": asked["level"]} if "level" in asked else {}
            plot_cost_law(ssp_lp.success_costs(solution.policy, solution.problem), ax=ax, **level)
    if asked["json"]:
        return json_answer(_solution_in_json(solution))
    decisions = ["", str(solution.policy_table())] if asked["show_policy"] else []
    forbids = str(Argument("give_up", "dead_ends")), option("give_up", "dead_ends")
    return [solution.summary().replace(*forbids), *decisions]


_WORTH_PROCESSES = 100_000  # outcomes of a model that takes longer to solve than a process to start


_OF_ONE_ANSWER = "policy_out", "certificate_out", "plot", "show_policy"


def _several_answers(
    of: _CommandModel, budgets: Sequence[float | None], search: Mapping[str, Any]
) -> Iterable[str]:
    """Run the command ``solve`` for several failure budgets and return its lines.

    Raises:
        ModelError: an option whose output needs a single answer.
    """
    for name in ("policy_out", "certificate_out", "plot", "show_policy"):
        if of.asked[name]:
            raise ModelError(f"{option(name)} needs a single answer: give one --failure-budget")
    problems = [problem_of(of, failure_budget=budget) for budget in budgets]
    executor = ThreadPoolExecutor(1) if of.model.n_outcomes < _WORTH_PROCESSES else None
    answers = ssp_lp.solve_many(problems, executor=executor, **search)
    for error in answers.errors.values():
        error.args = (with_options(error),)
    if not of.asked["json"]:
        return [answers.summary()]
    rows: list[dict[str, Any]] = [{"failure_budget": budget} for budget in budgets]
    for row, answer in zip(rows, answers, strict=True):
        if isinstance(answer, Solution):
            row |= _solution_in_json(answer)
        else:
            row["error"] = str(answer)
    return json_answer(rows)


def _check_command(asked: Asked) -> Iterable[str]:
    """Run the command ``check`` and return its lines.

    Raises:
        ModelError: the arguments state a problem without a model.
        SolverError: the certificate is refused.
    """
    problem, file = None, asked["certificate"]
    if asked["model"] is not None:
        problem = problem_of(command_model(asked))
    elif any(asked[name] for name in ("goal", "start", "limit")) or asked.keys() & PARAMETERS:
        raise ModelError("these options need a model: add --model, or pass the certificate alone")
    checked = ssp_lp.check_certificate(file, problem=problem)
    if not checked.accepted:
        raise SolverError(f"{file} is refused: {checked.reason}")
    return [str(checked)]


def _solution_in_json(solution: Solution) -> dict[str, Any]:
    """Return the numbers and decisions of a solution as a JSON object."""
    members = zip(solution.policy.weights.tolist(), solution.policy.policies, strict=True)
    found = solution.evaluation
    return {
        "criterion": type(solution.problem).__name__,
        "objective": solution.objective,
        "lower_bound": solution.lower_bound if solution.upper_bound is None else None,
        "upper_bound": solution.upper_bound,
        "gap": solution.gap,
        "goal_probability": found.goal_probability,
        "failure_probability": found.failure_probability,
        "conditional_cost": found.conditional_cost,
        "expected_cost": found.expected_cost,
        "failure_price": solution.failure_price,
        "limits": {
            name: {"value": value, "price": solution.prices.get(name, 0.0)}
            for name, value in solution.secondary_costs.items()
        },
        "ends": dict(found.ends),
        "policy": [{"weight": weight, **_decisions(member)} for weight, member in members],
        "method": solution.method,
        "seconds": solution.seconds,
        "note": solution.note,
    }


def _decisions(policy: Policy) -> dict[str, Any]:
    """Return the actions of a deterministic policy by state; for another policy its repr."""
    inner = policy.inner if isinstance(policy, RememberingPolicy | LabelledPolicy) else policy
    if not isinstance(inner, ssp_lp.DeterministicPolicy):
        return {"kind": repr(policy)}
    return {"actions": {str(state): str(action) for state, action in inner.actions().items()}}


def _traced_frontier(of: _CommandModel) -> ssp_lp.Frontier:
    limits = {name: of.asked[name] for name in ("over", "gap", "point_limit", "time_limit")}
    return ssp_lp.trace_frontier(problem_of(of), **limits)


def _explore_command(asked: Asked) -> Iterable[str]:
    of, out = command_model(asked), asked["out"]
    traced = _traced_frontier(of)
    world = of.environment and of.environment.unwrapped
    drawn: Any = getattr(world, "desc", ())  # a map in letters
    rows, columns = len(drawn), len(drawn[0]) if len(drawn) else 0
    cells = row_major(rows, columns) if rows * columns == of.model.n_states else None
    explore(traced, out, cells=cells, seed=asked["seed"])
    return [repr(traced).splitlines()[0], f"page written to {Path(out).resolve()}"]


def _frontier_command(asked: Asked) -> Iterable[str]:
    with picture(asked["plot"]) as ax:
        traced = _traced_frontier(command_model(asked))
        if ax is not None:
            budget = asked.get("failure_budget") if traced.over == "failure" else None
            plot_frontier(traced, budget, ax=ax)
    (table,) = traced.tables()
    if asked["json"]:
        points = table.records()
        return json_answer({"gap": traced.gap, "complete": traced.complete, "points": points})
    return _csv_answer(asked["csv"], table) if asked["csv"] else replace(table, shown=None).lines()


def _info_command(asked: Asked) -> Iterable[str]:
    model, start = command_model(asked).written_out
    names = list(map(str, model.action_names))
    facts: dict[str, Any] = {
        "states": model.n_states,
        "pairs": model.n_pairs,
        "outcomes": model.n_outcomes,
        "goals": int(model.goal_mask.sum()),
        "dead-ends": len(dead_end_labels(model)),
        "attention states": len(attention_labels(model)),
        "actions": names[:8] + ["..."] * (len(names) > 8),
        "costs": list(model.costs_by_name),
        "labels": {name: len(members) for name, members in model.state_labels.items()},
    }
    if start is not None:
        facts["least failure"] = ssp_lp.solve(MaxProb(model, start)).failure_probability
    if asked["json"]:
        return json_answer(facts)
    return Table([*facts.items()]).lines()


def _simulate_command(asked: Asked) -> Iterable[str]:
    check_whole("seed", asked["seed"], 0)
    of = command_model(asked)
    problem = MCMP(of.model, of.start, failure_budget=1.0, horizon=of.horizon)
    policy = io.load_policy(asked["policy"], problem.unrolled.model, check=asked["check"])
    settings = {name: asked[name] for name in ("episodes", "seed", "max_steps", "confidence")}
    report: Any
    if of.environment is not None:
        report = io.rollout(of.environment, policy, **settings)
    else:
        report = ssp_lp.simulate(policy, problem, **settings)
    if not asked["json"]:
        return [report.summary()]
    facts = {fact["name"].replace(" ", "_"): fact["value"] for fact in report.tables()[0].records()}
    plain = {k: v._asdict() if isinstance(v, Estimate) else v for k, v in facts.items()}
    return json_answer(plain | {"ends": dict(facts["ends"])})


def _convert_command(asked: Asked) -> Iterable[str]:
    model, start = command_model(asked).written_out
    if asked["target"] == "-":
        return ["".join(model_in_json(model, start)).rstrip()]
    io.write_any(model, asked["target"], start)
    return []


def _program_command(asked: Asked) -> Iterable[str]:
    program = program_of(problem_of(command_model(asked)))
    if asked["out"] is not None:
        program.write(asked["out"])
    return [str(program)]


def _what_if_command(asked: Asked) -> Iterable[str]:
    with picture(asked["plot"]) as ax:
        solution = ssp_lp.solve(problem_of(command_model(asked)))
        effects = solution.what_if(time_limit=asked["time_limit"])
        if ax is not None:
            plot_tornado(effects, ax=ax)
    (table,) = effects.tables()
    if asked["json"]:
        numbers = [row | {name: str(row[name]) for name in ("state", "action", "successor")}
                   for row in table.records()]  # fmt: skip
        return json_answer({"objective": solution.objective, "numbers": numbers})
    return _csv_answer(asked["csv"], table) if asked["csv"] else table.lines()


COMMANDS: dict[str, Callable[[Asked], Iterable[str]]] = {
    "solve": _solve_command,
    "frontier": _frontier_command,
    "explore": _explore_command,
    "info": _info_command,
    "simulate": _simulate_command,
    "convert": _convert_command,
    "program": _program_command,
    "what-if": _what_if_command,
    "check": _check_command,
}
"""Commands by name; each returns the lines that are printed."""
