"""Arguments of each command. The library is not imported here, so that help appears at once."""

from __future__ import annotations

import re
from argparse import (
    SUPPRESS,
    Action,
    ArgumentError,
    ArgumentParser,
    ArgumentTypeError,
    BooleanOptionalAction,
    RawDescriptionHelpFormatter,
)
from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple, NoReturn

from .. import PAGES

CRITERIA = {
    page.replace("_", "-"): name
    for name, page in PAGES.items()
    if name not in {"ConstrainedCost", "GUBS"}  # MCMP with --limit, and a function of the cost
}
"""Name of a criterion's module, with hyphens -> name of its class."""

_FILES = {"bash": "_shtab_compgen_files", "zsh": "_files", "tcsh": "f"}
"""Completion functions of shells for a file's name, as in shtab's ``FILE``."""


class _Option(NamedTuple):
    """An option that stands for an argument of a criterion's class."""

    help: str
    type: Callable[[str], Any] = bool  # bool: the flag, or the flag after --no-
    metavar: str = ""


def number_argument(text: str) -> Fraction:
    """Return the exact number of a text: 0.1 is a tenth, 5% a twentieth, 1/3 a third.

    Raises:
        ArgumentTypeError: no number that fits a float.
    """
    plain, percent, rest = text.partition("%")
    try:
        if "/" not in plain and not 0.0 < abs(float(plain)) < float("inf"):
            number = Fraction(float(plain))  # written out, 1e-9999999 would fill the memory
        else:
            number = Fraction(plain)
        float(number)
        if rest:
            raise ValueError
    except (ValueError, ZeroDivisionError, OverflowError):
        raise ArgumentTypeError(f"{text!r} is not a number that fits a float") from None
    return number / 100 if percent else number


def _float_argument(text: str) -> float:
    """Return the number in a text such as 0.05 or 5%."""
    return float(number_argument(text))


def _number_or_none(text: str) -> float | None:
    """Return the number in a text, or None for "none"."""
    return None if text == "none" else _float_argument(text)


def _budgets_argument(text: str) -> float | list[float | None] | None:
    """Return the budget in a text: a number, or None for "none"; for a text with commas a list."""
    several = [_number_or_none(one) for one in text.split(",")]
    return several if len(several) > 1 else several[0]


def _criterion_argument(text: str) -> str:
    """Return a criterion's key in ``CRITERIA``, given its name in any spelling.

    Both ``min-cost`` and ``MinCost`` are accepted. A text that is no criterion is returned
    unchanged.
    """
    letters = re.sub("[-_]", "", text).lower()
    return next((name for name in CRITERIA if name.replace("-", "") == letters), text)


def _steps_argument(text: str) -> int | str | None:
    """Return the horizon in a text: a number of steps, None for "none", or "env"."""
    if text in ("env", "none"):
        return text if text == "env" else None
    if text.isdecimal():
        return int(text)
    raise ArgumentTypeError(f"{text!r} is neither a number of steps nor none")


def option(name: str, value: object = ...) -> str:
    """Return the command-line option for a Python argument.

    Examples are ``--discount 0.9`` and ``--no-check``. If no value is given, only the option's name
    is returned.
    """
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{flag}" if value else f"--no-{flag}"
    return f"--{flag}" if value is ... else f"--{flag} {'none' if value is None else value}"


PARAMETERS = {
    "failure_budget": _Option(
        "greatest failure probability; none (default of most criteria): as low as possible; with "
        "several, 0.01,0.05, solve prints a table",
        _budgets_argument,
        "P[,P]",
    ),
    "reach_fraction": _Option(
        "least share of the greatest goal probability", _float_argument, "SHARE"
    ),
    "penalty": _Option("cost of failing", _float_argument, "COST"),
    "level": _Option("level of the quantile or the tail, such as 0.95", _float_argument, "P"),
    "cost_bound": _Option("greatest total cost", number_argument, "COST"),
    "cost_budget": _Option("greatest expected cost", _float_argument, "COST"),
    "risk_factor": _Option("factor of the cost in the utility, < 0", _float_argument, "X"),
    "goal_bonus": _Option("utility of the goal itself", _float_argument, "X"),
    "quantity": _Option("quantity to minimise, as in --limit", str, "QUANTITY"),
    "discount": _Option("discount factor in (0, 1), or none", _number_or_none, "GAMMA"),
    "give_up": _Option("where to give up: anywhere, attention, dead_ends", str, "WHERE"),
    "charge_failing_step": _Option("pay for the step at which failure is declared"),
    "cost_cap": _Option("greatest total cost that is counted exactly", _float_argument, "COST"),
    "cost_levels": _Option("greatest number of total costs to count", int, "N"),
}
"""Arguments of criteria, by name; each class says which of them it takes and needs."""

_MODEL_HELP = """\
MODEL is a file (.json, .csv, .drn, .umb, .npz, through Storm .prism, .nm, .pm, .jani; also
.json.gz, .drn.gz, .drn.xz), "-" for JSON from standard input, or gym:NAME for an environment of
Gymnasium's, gym:NAME,map_name=8x8 with its arguments. In JSON a model is
{state: {action: [[probability, successor, cost], ...]}}; a state without actions that is not a goal
is a dead-end."""


class _Version(Action):
    """Action that prints the version, for which the library is loaded."""

    def __call__(self, parser: ArgumentParser, *_: Any) -> NoReturn:
        from ssp_lp import __version__

        print(f"ssp-lp {__version__}")
        parser.exit()


class _Completion(Action):
    """Action that prints the completion script of a shell, for which ``shtab`` is loaded."""

    def __call__(self, parser: ArgumentParser, _: object, shell: Any, *rest: object) -> NoReturn:
        from ssp_lp.errors import MissingDependencyError, optional_module

        try:
            print(optional_module("shtab", "completion").complete(parser, shell))
        except MissingDependencyError as error:
            parser.error(str(error))
        parser.exit()


class _OneLineParser(ArgumentParser):
    """A parser whose error messages are one line, without the usage."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse arguments; the error for an unknown one suggests a similar one."""
        asked, unknown = super().parse_known_args(args, namespace)
        if unknown:
            if unknown[0][:1] != "-":
                self.error(f"{unknown[0]!r} is one word too many: options begin with --")
            from ssp_lp.errors import meant_argument

            word = unknown[0].partition("=")[0]
            known = (flag for flag in self._option_string_actions if flag[:2] == "--")
            flags = {_as_name(flag): flag for flag in known}
            meant = meant_argument(_as_name(word), flags)
            nearest = "" if meant is None else f"; did you mean {flags[meant]}?"
            self.error(f"there is no {word}{nearest}")
        return asked, unknown

    def _check_value(self, action: Action, value: Any) -> None:
        """Raise ArgumentError for a value that is not one of the choices."""
        if action.choices is not None and value not in action.choices:
            from ssp_lp.errors import did_you_mean

            listed = f"; choose from {', '.join(map(str, action.choices))}"
            nearest = did_you_mean(value, action.choices) or listed
            raise ArgumentError(action, f"there is no {value!r}{nearest}")

    def error(self, message: str) -> NoReturn:
        """Exit with the error and a hint at ``--help``."""
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help)\n")


def _as_name(flag: str) -> str:
    """Return the Python name of an option."""
    return flag.lstrip("-").replace("-", "_")


def argument_parser() -> ArgumentParser:
    """Return the parser of the command line; ``command`` in its result is the command."""
    whole = _OneLineParser(
        prog="ssp-lp",
        formatter_class=RawDescriptionHelpFormatter,
        description="Reach the goal as cheaply as possible, and fail with probability at most P.",
        epilog="examples:\n"
        + "\n".join(verb.examples.splitlines()[0] for verb in VERBS.values())
        + "\n\nexit codes: 0 done, 1 a method failed, 2 wrong arguments or model, 3 infeasible",
    )
    _add_all(whole, _ALONE)
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, verb in VERBS.items():
        purpose = f"{verb.purpose[0].upper()}{verb.purpose[1:]}."
        one = commands.add_parser(
            name,
            help=verb.purpose,
            formatter_class=RawDescriptionHelpFormatter,
            description=f"{purpose}\n\n{_MODEL_HELP}" if verb.takes_model else purpose,
            epilog=f"examples:\n{verb.examples}",
        )
        one.set_defaults(verbose=False, quiet=not verb.takes_model)
        if verb.takes_model:
            _add_all(one, {"model": _taken("see above", "MODEL")})
        for title, options in verb.takes.items():
            _add_all(one.add_argument_group(title) if title else one, options)
        if verb.forms:
            _add_all(one.add_mutually_exclusive_group(), verb.forms)
        if verb.takes_model:
            _add_all(one.add_mutually_exclusive_group(), _TOLD)
            _add_all(one.add_argument_group("the model"), _MODEL)
    return whole


Options = dict[str, dict[str, Any]]
"""Options by name, each with its settings for argparse."""


def _add_all(place: Any, options: Options) -> None:
    """Add options to a parser or a group, with completion of the names of files and models."""
    for name, settings in options.items():
        added = place.add_argument(name, **settings)
        if settings.get("metavar") in ("MODEL", "FILE"):
            added.complete = _FILES


def _taken(text: str, metavar: str, kind: Callable[[str], Any] = str, **more: Any) -> Any:
    """Return the settings for argparse of an option that takes a value."""
    return {"help": text, "metavar": metavar, "type": kind, **more}


def _switch(text: str, **more: Any) -> Any:
    """Return the settings for argparse of an option without a value."""
    return {"help": text, "action": "store_true", **more}


_QUESTION: Options = {
    "--criterion": _taken(
        f"mcmp (default), {', '.join(name for name in CRITERIA if name != 'mcmp')}", "NAME",
        _criterion_argument, choices=tuple(CRITERIA), default="mcmp",
    ),
    "--property": _taken(
        'problem in PRISM\'s words: multi(R{"time"}min=? [F "ok"], P>=0.95 [F "ok"])', "WORDS"
    ),
    **{
        option(name): _switch(each.help, action=BooleanOptionalAction, default=SUPPRESS)
        if each.type is bool
        else _taken(each.help, each.metavar, each.type, default=SUPPRESS)
        for name, each in PARAMETERS.items()
    },
    "--limit": _taken(
        'such as "fuel <= 3", "visits(ward) <= 2", "end(crash) <= 0.01", "goal >= 0.9", '
        '"cost + 2 * fuel <= 9": quantities are cost, goal, failure, visits(STATE), end(LABEL) and '
        "the model's other costs by name; may be given again",
        "WORDS", action="append", default=[],
    ),
}  # fmt: skip

_JSON: Options = {"--json": _switch("print JSON, for other programs")}

_TABLE: Options = {
    **_JSON,
    "--csv": _taken("print CSV, or write a file", "FILE", nargs="?", const="-"),
}

_ALONE: Options = {
    "--version": {"action": _Version, "nargs": 0, "help": "print the version and exit"},
    "--print-completion": _taken(
        "print the completion script for bash, zsh or tcsh", "SHELL", action=_Completion,
        choices=[*_FILES],
    ),
}  # fmt: skip

_TOLD: Options = {
    "--verbose": _switch("print each phase on a line of its own"),
    "--quiet": _switch("print no progress"),
}

_MODEL: Options = {
    "--goal": _taken("goal states, or their label", "STATE", nargs="+", default=[]),
    "--dead-ends": _taken(
        "states (or their label) that may lack actions; any other one is then an error", "STATE",
        nargs="+",
    ),
    "--start": _taken("state in which an episode begins", "STATE"),
    "--cost": _taken("name of the cost to minimise", "NAME"),
    "--constants": _taken("constants that a program leaves open", "N=5,..."),
    "--horizon": _taken(
        "reach the goal within N steps; default: an environment's own limit, or none", "N",
        _steps_argument, default="env",
    ),
}  # fmt: skip

_METHODS = ("columns", "lp", "game", "deterministic")
_SOLVE: dict[str, Options] = {
    "the question": _QUESTION,
    "the search": {
        "--method": _taken(", ".join(_METHODS), "NAME", choices=_METHODS),
        "--tolerance": _taken("relative gap to reach; 1e-9", "GAP", float, default=1e-9),
        "--time-limit": _taken("stop then, with the best policy so far", "SECONDS", float),
    },
    "the answer": {
        "--policy-out": _taken(
            "write the policy: .npz to load again, .json for a controller, .h for C, .csv", "FILE"
        ),
        "--show-policy": _switch("print the decisions that the policy reaches from the start"),
        "--everywhere": _switch(
            "write a policy that acts in every state, planned or not, failed or not"
        ),
        "--certificate-out": _taken("write a proof of the answer, for ssp-lp check", "FILE"),
        "--plot": _taken("draw the law of the total cost", "FILE"),
    }
    | _JSON,
}

_TRACE: Options = {
    "--over": _taken(
        "the limit to trace, as given to --limit; default: failure; other limits stay", "NAME",
        default="failure",
    ),
    "--gap": _taken("relative gap to reach; 1e-9", "GAP", float, default=1e-9),
    "--point-limit": _taken("greatest number of turning points", "N", int),
    "--time-limit": _taken("stop then, with the frontier so far", "SECONDS", float),
}  # fmt: skip

_EXPLORE: Options = {
    "--point-limit": _taken("greatest number of turning points; 50", "N", int, default=50),
    "--out": _taken("file of the page: .html", "FILE", required=True),
    "--seed": _taken("seed of the sample runs; 0", "N", int, default=0),
}

_SIMULATE: Options = {
    "--policy": _taken("file of solve --policy-out", "FILE", required=True),
    "--episodes": _taken("number of episodes; 10,000", "N", int, default=10_000),
    "--seed": _taken("seed; 0", "N", int, default=0),
    "--max-steps": _taken("steps of an episode at most; 10,000", "N", int, default=10_000),
    "--confidence": _taken("confidence level; 0.95", "P", float, default=0.95),
    "--check": _switch(
        "require that the policy was made for this model (default)", default=True,
        action=BooleanOptionalAction,
    ),
}  # fmt: skip


class _Verb(NamedTuple):
    """A command: its purpose, its options, and examples."""

    purpose: str
    takes: dict[str, Options]  # by the title of their group; "": without a group
    examples: str  # complete commands, for the file roads.json in the guide to the command line
    takes_model: bool = True
    forms: Options = {}  # of the answer, mutually exclusive


VERBS = {
    "solve": _Verb(
        "find the best policy within a failure budget, and its proof",
        _SOLVE,
        """\
  ssp-lp solve roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp solve roads.json --goal home --start depot --criterion cvar --level 0.9 --json
  ssp-lp solve roads.json --goal home --start depot --failure-budget 0.05 --policy-out policy.npz
  ssp-lp solve roads.json --goal home --start depot --failure-budget 0.02,0.05,0.08
  ssp-lp solve roads.json --goal home --start depot --criterion s3p --limit "cost <= 9"
  ssp-lp solve roads.json --start depot --property 'multi(Rmin=? [C], P>=0.95 [F "home"])'
  ssp-lp solve gym:FrozenLake-v1 --criterion cost-bounded-reach --cost-bound 40""",
    ),
    "check": _Verb(
        "check a certificate with exact arithmetic and print the interval of the optimum",
        {
            "": {
                "certificate": _taken("file of solve --certificate-out", "FILE"),
                "--model": _taken("your own model, to state the question about it", "MODEL"),
            },
            "the question": _QUESTION,
            "the model": _MODEL,
        },
        """\
  ssp-lp solve roads.json --goal home --start depot --certificate-out roads.cert
  ssp-lp check roads.cert
  ssp-lp check roads.cert --model roads.json --goal home --start depot""",
        takes_model=False,
    ),
    "frontier": _Verb(
        "trace the least cost as a function of the failure budget",
        {
            "the question": _QUESTION,
            "": _TRACE | {"--plot": _taken("draw it, with the budget and its tangent", "FILE")},
        },
        """\
  ssp-lp frontier roads.json --goal home --start depot
  ssp-lp frontier roads.json --goal home --start depot --criterion s3p --csv frontier.csv
  ssp-lp frontier roads.json --goal home --start depot --failure-budget 0.05 --plot frontier.png
  ssp-lp frontier roads.json --goal home --start depot --limit "cost <= 9" --over cost""",
        forms=_TABLE,
    ),
    "what-if": _Verb(
        "rank the numbers: derivatives of the optimum by every probability, cost and bound",
        {
            "the question": _QUESTION,
            "": {
                "--plot": _taken("draw a tornado of the numbers that matter most", "FILE"),
                "--time-limit": _taken("stop then, with the derivatives so far", "SECONDS", float),
            },
        },
        """\
  ssp-lp what-if roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp what-if roads.json --goal home --start depot --criterion maxprob --plot tornado.png""",
        forms=_TABLE,
    ),
    "explore": _Verb(
        "write a page of HTML with a slider along the frontier",
        {"the question": _QUESTION, "": _TRACE | _EXPLORE},
        """\
  ssp-lp explore roads.json --goal home --start depot --failure-budget 0.05 --out roads.html
  ssp-lp explore gym:FrozenLake-v1 --horizon none --out lake.html""",
    ),
    "program": _Verb(
        "print or write the linear program of a criterion",
        {"the question": _QUESTION, "": {"--out": _taken("write it: .mps or .lp", "FILE")}},
        """\
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05 --out roads.mps""",
    ),
    "simulate": _Verb(
        "simulate a saved policy, with confidence intervals",
        {"": _SIMULATE | _JSON},
        """\
  ssp-lp simulate roads.json --goal home --start depot --policy policy.npz --seed 7
  ssp-lp solve gym:FrozenLake-v1 --policy-out lake.npz
  ssp-lp simulate gym:FrozenLake-v1 --policy lake.npz --episodes 500""",
    ),
    "info": _Verb(
        "print a model's sizes, costs and least failure probability",
        {"": _JSON},
        """\
  ssp-lp info roads.json --goal home --start depot
  ssp-lp info gym:FrozenLake-v1 --horizon none --json""",
    ),
    "convert": _Verb(
        "convert a model from one format into another",
        {"": {"target": _taken("a file, or - for JSON on standard output", "TARGET")}},
        """\
  ssp-lp convert roads.json roads.drn --goal home --start depot
  ssp-lp convert gym:FrozenLake-v1 - --horizon 20 | ssp-lp info -""",
    ),
}
"""Commands of the command line, by name."""
