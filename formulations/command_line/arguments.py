"""What each command takes. Nothing of the library is imported here, so that help comes at once."""

from __future__ import annotations

from argparse import (
    SUPPRESS,
    Action,
    ArgumentParser,
    ArgumentTypeError,
    BooleanOptionalAction,
    RawDescriptionHelpFormatter,
)
from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple, NoReturn

from formulations import PAGES

CRITERIA = {
    page.replace("_", "-"): name
    for name, page in PAGES.items()
    if name not in {"ConstrainedCost", "GUBS"}  # MCMP with --limit, and a function of the cost
}
"""The criteria by their names in a shell, which are those of their pages."""


class Parameter(NamedTuple):
    """What a criterion may take, an argument of its class."""

    help: str
    type: Callable[[str], Any] = bool  # bool: the flag, or the flag after --no-
    metavar: str = ""


def _number_argument(text: str) -> Fraction:
    """An argument's number as it is written: 0.1 is a tenth."""
    try:
        if "/" not in text and not 0.0 < abs(float(text)) < float("inf"):
            return Fraction(float(text))  # written out, 1e-9999999 would fill the memory
        number = Fraction(text)
        float(number)
    except (ValueError, ZeroDivisionError, OverflowError):
        raise ArgumentTypeError(f"{text!r} is no number that a float can stand for") from None
    return number


def _number_or_none(text: str) -> float | None:
    """A number, or what None is for Python."""
    return None if text == "none" else float(_number_argument(text))


def _steps_argument(text: str) -> int | str | None:
    """A horizon: a number of steps, none, or "env", the environment's own."""
    if text in ("env", "none"):
        return text if text == "env" else None
    if text.isdecimal():
        return int(text)
    raise ArgumentTypeError(f"{text!r} is no number of steps, nor none")


def option(name: str, value: object = ...) -> str:
    """The option that is an argument of Python's: ``--discount 0.9``, ``--no-check``."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{flag}" if value else f"--no-{flag}"
    return f"--{flag}" if value is ... else f"--{flag} {'none' if value is None else value}"


PARAMETERS = {
    "failure_budget": Parameter(
        "largest failure probability, or none: the least; left out mostly the least",
        _number_or_none,
        "P",
    ),
    "reach_fraction": Parameter("share of the greatest goal probability to keep", float, "SHARE"),
    "penalty": Parameter("what failing costs", float, "COST"),
    "level": Parameter("of the quantile or the tail, such as 0.95", float, "P"),
    "cost_bound": Parameter("the total cost to keep to", _number_argument, "COST"),
    "cost_budget": Parameter("the expected cost to keep to", float, "COST"),
    "risk_factor": Parameter("of the exponential utility, < 0 to shun risk", float, "X"),
    "goal_bonus": Parameter("utility of the goal itself", float, "X"),
    "quantity": Parameter("what is to be least, as in --limit", str, "QUANTITY"),
    "discount": Parameter("of the paper's surrogate, in (0, 1), or none", _number_or_none, "GAMMA"),
    "give_up": Parameter("where: anywhere, attention (states), dead_ends", str, "WHERE"),
    "charge_failing_step": Parameter("whether the failing step is paid"),
    "cost_cap": Parameter("tell costs apart up to here", float, "COST"),
    "cost_levels": Parameter("tell so many costs apart", int, "N"),
}
"""The arguments of criteria, by name; which of them one takes and needs, its class says."""

SEVERAL = {
    "failure_budget": "failure_budgets",
    "penalty": "penalties",
    "reach_fraction": "reach_fractions",
    "cost_bound": "cost_bounds",
    "level": "levels",
}
"""What ``compare`` takes several of, as its function calls them."""

_JSON = "for other programs"

_MODEL_HELP = """\
MODEL is a file (.json, .drn, .tra, .npz, through Storm .prism, .nm, .pm, .jani, .umb; .json and
.drn may be gzip), "-" for JSON from standard input, or gym:NAME for an environment of Gymnasium's,
gym:NAME,map_name=8x8 with its arguments. In JSON a model is
{state: {action: [[probability, successor, cost], ...]}}; a state without actions that is no goal
is a dead-end."""

EXAMPLES = {
    "solve": """\
  ssp-lp solve roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp solve roads.json --goal home --start depot --criterion cvar --level 0.9 --json
  ssp-lp solve roads.json --goal home --start depot --failure-budget 0.05 --policy-out policy.npz
  ssp-lp solve roads.json --goal home --start depot --criterion s3p --limit "cost <= 9"
  ssp-lp solve gym:FrozenLake-v1 --criterion cost-bounded-reach --cost-bound 40""",
    "frontier": """\
  ssp-lp frontier roads.json --goal home --start depot
  ssp-lp frontier roads.json --goal home --start depot --criterion s3p --csv > frontier.csv
  ssp-lp frontier roads.json --goal home --start depot --failure-budget 0.05 --plot frontier.png""",
    "info": """\
  ssp-lp info roads.json --goal home --start depot
  ssp-lp info gym:FrozenLake-v1 --horizon none --json""",
    "simulate": """\
  ssp-lp simulate roads.json --goal home --start depot --policy policy.npz --seed 7
  ssp-lp solve gym:FrozenLake-v1 --policy-out lake.npz
  ssp-lp simulate gym:FrozenLake-v1 --policy lake.npz --episodes 500""",
    "convert": """\
  ssp-lp convert roads.json roads.drn --goal home --start depot
  ssp-lp convert gym:FrozenLake-v1 - --horizon 20 | ssp-lp info -""",
    "compare": """\
  ssp-lp compare roads.json --goal home --start depot
  ssp-lp compare roads.json --goal home --start depot --failure-budget 0.02 0.05 --level 0.9""",
    "program": """\
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05 --out roads.mps""",
    "check": """\
  ssp-lp solve roads.json --goal home --start depot --certificate-out roads.cert
  ssp-lp check roads.cert""",
}
"""Commands that run as they stand, given the file roads.json of the page on the command line."""


class _Version(Action):
    """Print the version, for which the library is loaded."""

    def __call__(self, parser: ArgumentParser, *_: Any) -> NoReturn:
        from ssp_lp import __version__

        print(f"ssp-lp {__version__}")
        parser.exit()


def argument_parser() -> ArgumentParser:
    """The parser of the whole command line; what it parses has the command's name."""
    whole = ArgumentParser(
        prog="ssp-lp",
        formatter_class=RawDescriptionHelpFormatter,
        description="Reach the goal as cheaply as possible, and fail with probability at most P.",
        epilog="examples:\n"
        + "\n".join(some.splitlines()[0] for some in EXAMPLES.values())
        + "\n\nexit codes: 0 done, 1 a method failed, 2 wrong arguments or model, 3 infeasible",
    )
    whole.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (purpose, add) in _COMMANDS.items():
        one = commands.add_parser(
            name,
            help=purpose,
            formatter_class=RawDescriptionHelpFormatter,
            description=f"{purpose[0].upper()}{purpose[1:]}.\n\n{_MODEL_HELP}",
            epilog=f"examples:\n{EXAMPLES[name]}",
        )
        one.add_argument("model", metavar="MODEL", help="see above")
        if name == "convert":
            one.add_argument("target", metavar="TARGET", help="a file, or - for JSON to read on")
        said = "say on the way how far it has come"
        one.add_argument("--verbose", action="store_true", help=said)
        _add_model(one)
        if add is not None:
            add(one)
        if name in ("solve", "info", "simulate", "compare"):
            one.add_argument("--json", action="store_true", help=_JSON)
    _add_check(commands)
    return whole


def _add_check(commands: Any) -> None:
    """Add the command ``check``, which takes no model: a certificate has its own."""
    told = "check a certificate by exact inequalities"
    one = commands.add_parser(
        "check", help=told, formatter_class=RawDescriptionHelpFormatter,
        description=f"{told[0].upper()}{told[1:]}: what the optimum lies between, as fractions.",
        epilog=f"examples:\n{EXAMPLES['check']}",
    )  # fmt: skip
    one.add_argument("certificate", metavar="FILE", help="of solve --certificate-out")
    one.set_defaults(verbose=False)


def _add_model(one: ArgumentParser) -> None:
    """Add the arguments that name a model."""
    model = one.add_argument_group("the model")
    model.add_argument(
        "--goal", nargs="+", default=[], metavar="STATE", help="goal states, or their label"
    )
    model.add_argument("--start", metavar="STATE", help="where an episode begins")
    model.add_argument("--cost", metavar="NAME", help="which of the model's costs counts")
    model.add_argument("--constants", metavar="N=5,...", help="what a program leaves open")
    model.add_argument(
        "--horizon",
        type=_steps_argument,
        default="env",
        metavar="N",
        help="reach the goal within N steps; an environment's own limit if left out, or none",
    )


def _add_question(one: ArgumentParser, criteria: list[str]) -> None:
    """Add the arguments that ask a criterion."""
    question = one.add_argument_group("the question")
    question.add_argument(
        "--criterion", choices=criteria, default="mcmp", metavar="NAME",
        help=f"mcmp if left out; or {', '.join(c for c in criteria if c != 'mcmp')}",
    )  # fmt: skip
    for name, parameter in PARAMETERS.items():
        told: dict[str, Any] = {"help": parameter.help, "default": SUPPRESS}
        if parameter.type is bool:
            question.add_argument(option(name), action=BooleanOptionalAction, **told)
        else:
            told |= {"type": parameter.type, "metavar": parameter.metavar}
            question.add_argument(option(name), **told)
    question.add_argument(
        "--limit", action="append", default=[], metavar="WORDS",
        help='such as "fuel <= 3", "visits(ward) <= 2", "end(crash) <= 0.01", "goal >= 0.9", '
        '"cost + 2 * fuel <= 9": quantities are cost, goal, failure, visits(STATE), end(LABEL) and '
        "the model's other costs by name; may be given again",
    )  # fmt: skip


def _add_solve(one: ArgumentParser) -> None:
    """Add the arguments of ``solve``."""
    _add_question(one, list(CRITERIA))
    search = one.add_argument_group("the search")
    methods = ("columns", "lp", "game", "deterministic")
    search.add_argument("--method", choices=methods, metavar="NAME", help=", ".join(methods))
    search.add_argument("--tolerance", type=float, metavar="GAP", help="relative gap; 1e-9")
    search.add_argument("--time-limit", type=float, metavar="SECONDS", help="then the best so far")
    answer = one.add_argument_group("the answer")
    answer.add_argument(
        "--policy-out", metavar="FILE",
        help="write the policy: .npz to load again, .storm.json for Storm, .json for a "
        "controller, .dot, .csv",
    )  # fmt: skip
    answer.add_argument(
        "--certificate-out", metavar="FILE", help="write a proof of the answer, for ssp-lp check"
    )
    answer.add_argument("--plot", metavar="FILE", help="draw the law of the total cost")


def _add_frontier(one: ArgumentParser) -> None:
    """Add the arguments of ``frontier``."""
    _add_question(one, ["mcmp", "s3p"])
    one.add_argument("--gap", type=float, metavar="GAP", help="how near; 1e-9")
    one.add_argument("--point-limit", type=int, metavar="N", help="at most so many turning points")
    one.add_argument("--time-limit", type=float, metavar="SECONDS", help="then what is there")
    form = one.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help=_JSON)
    form.add_argument("--csv", action="store_true", help="for tables")
    one.add_argument("--plot", metavar="FILE", help="draw it, with the budget and its tangent")


def _add_simulate(one: ArgumentParser) -> None:
    """Add the arguments of ``simulate``."""
    one.add_argument("--policy", required=True, metavar="FILE", help="of solve --policy-out")
    one.add_argument("--episodes", type=int, default=10_000, metavar="N", help="10,000")
    one.add_argument("--seed", type=int, default=0, metavar="N", help="0")
    one.add_argument("--max-steps", type=int, default=10_000, metavar="N", help="10,000")
    one.add_argument("--confidence", type=float, default=0.95, metavar="P", help="0.95")
    one.add_argument(
        "--check", action=BooleanOptionalAction, default=True,
        help="whether the policy must be of this very model, the default",
    )  # fmt: skip


def _add_compare(one: ArgumentParser) -> None:
    """Add the arguments of ``compare``, each of which takes several values."""
    for name, several in SEVERAL.items():
        said = PARAMETERS[name]
        told: dict[str, Any] = {"type": said.type, "metavar": said.metavar, "help": said.help}
        one.add_argument(option(name), dest=several, nargs="+", default=[], **told)


def _add_program(one: ArgumentParser) -> None:
    """Add the arguments of ``program``."""
    _add_question(one, [name for name in CRITERIA if name not in {"cost-quantile", "cvar"}])
    one.add_argument("--out", metavar="FILE", help="write it: .mps or .lp")


_COMMANDS: dict[str, tuple[str, Callable[[ArgumentParser], None] | None]] = {
    "solve": ("the best policy within a failure budget, and its proof", _add_solve),
    "frontier": ("the least cost for every failure budget at once", _add_frontier),
    "info": ("what a model holds, and how little can fail in it", None),
    "simulate": ("play a saved policy, with confidence intervals", _add_simulate),
    "convert": ("a model from one format into another", None),
    "compare": ("the criteria of the literature side by side", _add_compare),
    "program": ("the linear program of a criterion, shown or written", _add_program),
}
"""What each command is for, and what adds arguments that are its own."""
