"""What each command takes. Nothing of the library is imported here, so that help comes at once."""

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
"""The criteria by their names in a shell, which are those of their pages."""

_FILES = {"bash": "_shtab_compgen_files", "zsh": "_files", "tcsh": "f"}
"""What completes the name of a file, as shtab's ``FILE`` has it."""


class Parameter(NamedTuple):
    """A command-line argument of a criterion, an argument of its class."""

    help: str
    type: Callable[[str], Any] = bool  # bool: the flag, or the flag after --no-
    metavar: str = ""


def number_argument(text: str) -> Fraction:
    """Return a number as it is written: 0.1 is a tenth, 5% a twentieth, 1/3 a third.

    Raises:
        ArgumentTypeError: no number that a float can stand for.
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
        raise ArgumentTypeError(f"{text!r} is no number that a float can stand for") from None
    return number / 100 if percent else number


def _float_argument(text: str) -> float:
    """Return a number, 0.05 or 5%."""
    return float(number_argument(text))


def _number_or_none(text: str) -> float | None:
    """Return a command-line argument that is a number, or none."""
    return None if text == "none" else _float_argument(text)


def _budgets_argument(text: str) -> float | list[float | None] | None:
    """A command-line argument that is a number or none; several, with commas between, in a list."""
    several = [_number_or_none(one) for one in text.split(",")]
    return several if len(several) > 1 else several[0]


def _criterion_argument(text: str) -> str:
    """Return the criterion that is meant: ``min-cost``, ``MinCost`` and ``min_cost`` are one."""
    letters = re.sub("[-_]", "", text).lower()
    return next((name for name in CRITERIA if name.replace("-", "") == letters), text)


def _steps_argument(text: str) -> int | str | None:
    """Return the command-line argument for a horizon: a number of steps, none, or "env"."""
    if text in ("env", "none"):
        return text if text == "env" else None
    if text.isdecimal():
        return int(text)
    raise ArgumentTypeError(f"{text!r} is no number of steps, nor none")


def option(name: str, value: object = ...) -> str:
    """Return the command-line argument of a Python argument: ``--discount 0.9``, ``--no-check``."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{flag}" if value else f"--no-{flag}"
    return f"--{flag}" if value is ... else f"--{flag} {'none' if value is None else value}"


PARAMETERS = {
    "failure_budget": Parameter(
        "largest failure probability, or none: the least; left out mostly the least; several, "
        "0.01,0.05, make a table of solve",
        _budgets_argument,
        "P[,P]",
    ),
    "reach_fraction": Parameter(
        "share of the greatest goal probability to keep", _float_argument, "SHARE"
    ),
    "penalty": Parameter("what failing costs", _float_argument, "COST"),
    "level": Parameter("of the quantile or the tail, such as 0.95", _float_argument, "P"),
    "cost_bound": Parameter("the total cost to keep to", number_argument, "COST"),
    "cost_budget": Parameter("the expected cost to keep to", _float_argument, "COST"),
    "risk_factor": Parameter("of the exponential utility, < 0 to shun risk", _float_argument, "X"),
    "goal_bonus": Parameter("utility of the goal itself", _float_argument, "X"),
    "quantity": Parameter("what is to be least, as in --limit", str, "QUANTITY"),
    "discount": Parameter("of the paper's surrogate, in (0, 1), or none", _number_or_none, "GAMMA"),
    "give_up": Parameter("where: anywhere, attention (states), dead_ends", str, "WHERE"),
    "charge_failing_step": Parameter("whether the failing step is paid"),
    "cost_cap": Parameter("tell costs apart up to here", _float_argument, "COST"),
    "cost_levels": Parameter("tell so many costs apart", int, "N"),
}
"""The arguments of criteria, by name; which of them one takes and needs, its class says."""

_MODEL_HELP = """\
MODEL is a file (.json, .csv, .drn, .umb, .npz, through Storm .prism, .nm, .pm, .jani; also
.json.gz, .drn.gz, .drn.xz), "-" for JSON from standard input, or gym:NAME for an environment of
Gymnasium's, gym:NAME,map_name=8x8 with its arguments. In JSON a model is
{state: {action: [[probability, successor, cost], ...]}}; a state without actions that is no goal
is a dead-end."""


class _Version(Action):
    """Print the version, for which the library is loaded."""

    def __call__(self, parser: ArgumentParser, *_: Any) -> NoReturn:
        from ssp_lp import __version__

        print(f"ssp-lp {__version__}")
        parser.exit()


class _Completion(Action):
    """Print what makes a shell complete the command, for which ``shtab`` is loaded."""

    def __call__(self, parser: ArgumentParser, _: object, shell: Any, *rest: object) -> NoReturn:
        from ssp_lp.errors import MissingDependencyError, optional_module

        try:
            print(optional_module("shtab", "completion").complete(parser, shell))
        except MissingDependencyError as error:
            parser.error(str(error))
        parser.exit()


class _OneLineParser(ArgumentParser):
    """A parser whose errors are one line, without the usage, which ``--help`` has."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse arguments; those that there are not are named, with what was meant."""
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
        """Raise ArgumentError for a word of the command line that is not among those to choose."""
        if action.choices is not None and value not in action.choices:
            from ssp_lp.errors import did_you_mean

            listed = f"; choose from {', '.join(map(str, action.choices))}"
            nearest = did_you_mean(value, action.choices) or listed
            raise ArgumentError(action, f"there is no {value!r}{nearest}")

    def error(self, message: str) -> NoReturn:
        """End with what is wrong and where help is."""
        self.exit(2, f"{self.prog}: {message} ({self.prog} --help)\n")


def _as_name(flag: str) -> str:
    """Return the Python argument of a command-line argument."""
    return flag.lstrip("-").replace("-", "_")


def argument_parser() -> ArgumentParser:
    """Return the parser of the command line's arguments; what it parses has the command's name."""
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
"""Arguments of the command line by name, each with its settings in argparse's words."""


def _add_all(place: Any, options: Options) -> None:
    """Add arguments to a parser or a group of it; shells complete those that are files by name."""
    for name, settings in options.items():
        added = place.add_argument(name, **settings)
        if settings.get("metavar") in ("MODEL", "FILE"):
            added.complete = _FILES


def _taken(said: str, metavar: str, kind: Callable[[str], Any] = str, **more: Any) -> Any:
    """Settings of an argument of the command line that takes a word."""
    return {"help": said, "metavar": metavar, "type": kind, **more}


def _switch(said: str, **more: Any) -> Any:
    """Settings of an argument of the command line that is there or not."""
    return {"help": said, "action": "store_true", **more}


_QUESTION: Options = {
    "--criterion": _taken(
        f"mcmp if left out; or {', '.join(name for name in CRITERIA if name != 'mcmp')}", "NAME",
        _criterion_argument, choices=tuple(CRITERIA), default="mcmp",
    ),
    "--property": _taken(
        'the same in PRISM\'s words: multi(R{"time"}min=? [F "ok"], P>=0.95 [F "ok"])', "WORDS"
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

_JSON: Options = {"--json": _switch("for other programs")}

_ALONE: Options = {
    "--version": {"action": _Version, "nargs": 0, "help": "print the version and exit"},
    "--print-completion": _taken(
        "print what makes bash, zsh or tcsh complete the command", "SHELL", action=_Completion,
        choices=[*_FILES],
    ),
}  # fmt: skip

_TOLD: Options = {
    "--verbose": _switch("each phase, in lines that stay"),
    "--quiet": _switch("say nothing on the way"),
}

_MODEL: Options = {
    "--goal": _taken("goal states, or their label", "STATE", nargs="+", default=[]),
    "--dead-ends": _taken(
        "states (or their label) that may lack actions; any other one is then an error", "STATE",
        nargs="+",
    ),
    "--start": _taken("where an episode begins", "STATE"),
    "--cost": _taken("which of the model's costs counts", "NAME"),
    "--constants": _taken("what a program leaves open", "N=5,..."),
    "--horizon": _taken(
        "reach the goal within N steps; an environment's own limit if left out, or none", "N",
        _steps_argument, default="env",
    ),
}  # fmt: skip

_METHODS = ("columns", "lp", "game", "deterministic")
_SOLVE: dict[str, Options] = {
    "the question": _QUESTION,
    "the search": {
        "--method": _taken(", ".join(_METHODS), "NAME", choices=_METHODS),
        "--tolerance": _taken("relative gap; 1e-9", "GAP", float, default=1e-9),
        "--time-limit": _taken("then the best so far", "SECONDS", float),
    },
    "the answer": {
        "--policy-out": _taken(
            "write the policy: .npz to load again, .json for a controller, .h for C, .csv", "FILE"
        ),
        "--show-policy": _switch("print what the policy does, where it comes to from the start"),
        "--everywhere": _switch(
            "the policy that is written acts in every state, planned or not, failed or not"
        ),
        "--certificate-out": _taken("write a proof of the answer, for ssp-lp check", "FILE"),
        "--plot": _taken("draw the law of the total cost", "FILE"),
    }
    | _JSON,
}

_TRACE: Options = {
    "--over": _taken(
        "the limit to trace, by its words: failure if left out; other limits are kept", "NAME",
        default="failure",
    ),
    "--gap": _taken("how near; 1e-9", "GAP", float, default=1e-9),
    "--point-limit": _taken("at most so many turning points", "N", int),
    "--time-limit": _taken("then what is there", "SECONDS", float),
}  # fmt: skip

_EXPLORE: Options = {
    "--point-limit": _taken("at most so many turning points; 50", "N", int, default=50),
    "--out": _taken("the page: .html", "FILE", required=True),
    "--seed": _taken("of the sample runs; 0", "N", int, default=0),
}

_SIMULATE: Options = {
    "--policy": _taken("of solve --policy-out", "FILE", required=True),
    "--episodes": _taken("10,000", "N", int, default=10_000),
    "--seed": _taken("0", "N", int, default=0),
    "--max-steps": _taken("10,000", "N", int, default=10_000),
    "--confidence": _taken("0.95", "P", float, default=0.95),
    "--check": _switch(
        "whether the policy must be of this very model, the default", default=True,
        action=BooleanOptionalAction,
    ),
}  # fmt: skip


class Verb(NamedTuple):
    """A command of the command line: what it is for, what it takes, and how it is used."""

    purpose: str
    takes: dict[str, Options]  # by the title of their group; "": without one
    examples: str  # run as they stand, given the file roads.json of the page on the command line
    takes_model: bool = True
    forms: Options = {}  # of the answer, of which there may be one


VERBS = {
    "solve": Verb(
        "the best policy within a failure budget, and its proof",
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
    "check": Verb(
        "check a certificate by exact inequalities: between which numbers the optimum lies",
        {
            "": {
                "certificate": _taken("of solve --certificate-out", "FILE"),
                "--model": _taken("your own model, of which you ask what follows", "MODEL"),
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
    "frontier": Verb(
        "the least cost for every failure budget at once",
        {
            "the question": _QUESTION,
            "": _TRACE | {"--plot": _taken("draw it, with the budget and its tangent", "FILE")},
        },
        """\
  ssp-lp frontier roads.json --goal home --start depot
  ssp-lp frontier roads.json --goal home --start depot --criterion s3p --csv frontier.csv
  ssp-lp frontier roads.json --goal home --start depot --failure-budget 0.05 --plot frontier.png
  ssp-lp frontier roads.json --goal home --start depot --limit "cost <= 9" --over cost""",
        forms=_JSON | {"--csv": _taken("for tables; into a file", "FILE", nargs="?", const="-")},
    ),
    "what-if": Verb(
        "which number matters: derivatives of the optimum by every probability, cost and bound",
        {
            "the question": _QUESTION,
            "": {
                "--plot": _taken("draw a tornado of the numbers that matter most", "FILE"),
                "--time-limit": _taken("then the derivatives so far", "SECONDS", float),
            },
        },
        """\
  ssp-lp what-if roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp what-if roads.json --goal home --start depot --criterion maxprob --plot tornado.png""",
        forms=_JSON | {"--csv": _taken("for tables; into a file", "FILE", nargs="?", const="-")},
    ),
    "explore": Verb(
        "a page of HTML with a slider along the frontier",
        {"the question": _QUESTION, "": _TRACE | _EXPLORE},
        """\
  ssp-lp explore roads.json --goal home --start depot --failure-budget 0.05 --out roads.html
  ssp-lp explore gym:FrozenLake-v1 --horizon none --out lake.html""",
    ),
    "program": Verb(
        "the linear program of a criterion, shown or written",
        {"the question": _QUESTION, "": {"--out": _taken("write it: .mps or .lp", "FILE")}},
        """\
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05 --out roads.mps""",
    ),
    "simulate": Verb(
        "play a saved policy, with confidence intervals",
        {"": _SIMULATE | _JSON},
        """\
  ssp-lp simulate roads.json --goal home --start depot --policy policy.npz --seed 7
  ssp-lp solve gym:FrozenLake-v1 --policy-out lake.npz
  ssp-lp simulate gym:FrozenLake-v1 --policy lake.npz --episodes 500""",
    ),
    "info": Verb(
        "what a model holds, and how little can fail in it",
        {"": _JSON},
        """\
  ssp-lp info roads.json --goal home --start depot
  ssp-lp info gym:FrozenLake-v1 --horizon none --json""",
    ),
    "convert": Verb(
        "a model from one format into another",
        {"": {"target": _taken("a file, or - for JSON to read on", "TARGET")}},
        """\
  ssp-lp convert roads.json roads.drn --goal home --start depot
  ssp-lp convert gym:FrozenLake-v1 - --horizon 20 | ssp-lp info -""",
    ),
}
"""Every command of the command line, by its name."""
