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
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, NoReturn

from .. import PAGES

CRITERIA = {
    page.replace("_", "-"): name
    for name, page in PAGES.items()
    if name not in {"ConstrainedCost", "GUBS"}  # MCMP with --limit, and a function of the cost
}
"""The criteria by their names in a shell, which are those of their pages."""

_SHELLS = ("bash", "zsh", "tcsh")
_FILES = {"bash": "_shtab_compgen_files", "zsh": "_files", "tcsh": "f"}
"""What completes the name of a file, as shtab's ``FILE`` has it."""
_NO_PROGRAM = {"cost-quantile", "cvar"}


class Parameter(NamedTuple):
    """A command-line argument of a criterion, an argument of its class."""

    help: str
    type: Callable[[str], Any] = bool  # bool: the flag, or the flag after --no-
    metavar: str = ""


def number_argument(text: str) -> Fraction:
    """A number as it is written: 0.1 is a tenth, 5% a twentieth, 1/3 a third.

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
    """A number, 0.05 or 5%."""
    return float(number_argument(text))


def _number_or_none(text: str) -> float | None:
    """A command-line argument that is a number, or none."""
    return None if text == "none" else _float_argument(text)


def _budgets_argument(text: str) -> float | list[float | None] | None:
    """A command-line argument that is a number or none; several, with commas between, in a list."""
    several = [_number_or_none(one) for one in text.split(",")]
    return several if len(several) > 1 else several[0]


def _criterion_argument(text: str) -> str:
    """The criterion that is meant: ``min-cost``, ``MinCost`` and ``min_cost`` are one."""
    letters = re.sub("[-_]", "", text).lower()
    return next((name for name in CRITERIA if name.replace("-", "") == letters), text)


def _steps_argument(text: str) -> int | str | None:
    """The command-line argument for a horizon: a number of steps, none, or "env"."""
    if text in ("env", "none"):
        return text if text == "env" else None
    if text.isdecimal():
        return int(text)
    raise ArgumentTypeError(f"{text!r} is no number of steps, nor none")


def option(name: str, value: object = ...) -> str:
    """The command-line argument of a Python argument: ``--discount 0.9``, ``--no-check``."""
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

_JSON = "for other programs"

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
            word = unknown[0].partition("=")[0]
            flags = [flag for flag in self._option_string_actions if flag[:2] == "--"]
            self.error(f"there is no {word}{_flag_meant(word, flags)}")
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


def _flag_meant(word: str, flags: Sequence[str]) -> str:
    """For an error: a clause for the command-line argument that is meant by an unknown one."""
    from ssp_lp.errors import meant_argument

    names = {flag.lstrip("-").replace("-", "_"): flag for flag in flags}
    meant = meant_argument(word.lstrip("-").replace("-", "_"), names)
    return "" if meant is None else f"; did you mean {names[meant]}?"


def argument_parser() -> ArgumentParser:
    """The parser of the command line's arguments; what it parses has the command's name."""
    whole = _OneLineParser(
        prog="ssp-lp",
        formatter_class=RawDescriptionHelpFormatter,
        description="Reach the goal as cheaply as possible, and fail with probability at most P.",
        epilog="examples:\n"
        + "\n".join(verb.examples.splitlines()[0] for verb in VERBS.values())
        + "\n\nexit codes: 0 done, 1 a method failed, 2 wrong arguments or model, 3 infeasible",
    )
    whole.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    whole.add_argument(
        "--print-completion", action=_Completion, choices=_SHELLS, metavar="SHELL",
        help=f"print what makes {', '.join(_SHELLS)} complete the command",
    )  # fmt: skip
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
            _add_file(one, "model", metavar="MODEL", help="see above")
        verb.add(one)
        if verb.takes_model:
            said = one.add_mutually_exclusive_group()
            said.add_argument(
                "--verbose", action="store_true", help="each phase, in lines that stay"
            )
            said.add_argument("--quiet", action="store_true", help="say nothing on the way")
            _add_model(one)
    return whole


def _add_file(one: Any, *names: str, **told: Any) -> None:
    """Add an argument that shells complete by the names of files."""
    one.add_argument(*names, **told).complete = _FILES


def _add_model(one: ArgumentParser) -> None:
    """Add the command-line arguments that name a model."""
    model = one.add_argument_group("the model")
    model.add_argument(
        "--goal", nargs="+", default=[], metavar="STATE", help="goal states, or their label"
    )
    model.add_argument(
        "--dead-ends", nargs="+", metavar="STATE",
        help="states (or their label) that may lack actions; any other one is then an error",
    )  # fmt: skip
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


def _add_question(one: ArgumentParser, criteria: list[str], **own: Parameter) -> None:
    """Add the command-line arguments that ask a criterion, some of them the command's own."""
    question = one.add_argument_group("the question")
    question.add_argument(
        "--criterion", type=_criterion_argument, choices=criteria, default="mcmp", metavar="NAME",
        help=f"mcmp if left out; or {', '.join(c for c in criteria if c != 'mcmp')}",
    )  # fmt: skip
    question.add_argument(
        "--property", metavar="WORDS",
        help='the same in PRISM\'s words: multi(R{"time"}min=? [F "ok"], P>=0.95 [F "ok"])',
    )  # fmt: skip
    for name, parameter in (PARAMETERS | own).items():
        settings: dict[str, Any] = {"help": parameter.help, "default": SUPPRESS}
        if parameter.type is bool:
            question.add_argument(option(name), action=BooleanOptionalAction, **settings)
        else:
            settings |= {"type": parameter.type, "metavar": parameter.metavar}
            question.add_argument(option(name), **settings)
    question.add_argument(
        "--limit", action="append", default=[], metavar="WORDS",
        help='such as "fuel <= 3", "visits(ward) <= 2", "end(crash) <= 0.01", "goal >= 0.9", '
        '"cost + 2 * fuel <= 9": quantities are cost, goal, failure, visits(STATE), end(LABEL) and '
        "the model's other costs by name; may be given again",
    )  # fmt: skip


def _add_solve(one: ArgumentParser) -> None:
    """Add the command-line arguments of ``solve``, which takes several budgets."""
    budgets = PARAMETERS["failure_budget"]
    told = f"{budgets.help}; several, 0.01,0.05, make a table"
    _add_question(one, list(CRITERIA), failure_budget=Parameter(told, _budgets_argument, "P[,P]"))
    search = one.add_argument_group("the search")
    methods = ("columns", "lp", "game", "deterministic")
    search.add_argument("--method", choices=methods, metavar="NAME", help=", ".join(methods))
    search.add_argument("--tolerance", type=float, metavar="GAP", help="relative gap; 1e-9")
    search.add_argument("--time-limit", type=float, metavar="SECONDS", help="then the best so far")
    answer = one.add_argument_group("the answer")
    _add_file(
        answer, "--policy-out", metavar="FILE",
        help="write the policy: .npz to load again, .json for a controller, .h for C, .csv",
    )  # fmt: skip
    shown = "print what the policy does, where it comes to from the start"
    answer.add_argument("--show-policy", action="store_true", help=shown)
    answer.add_argument(
        "--everywhere", action="store_true",
        help="the policy that is written acts in every state, planned or not, failed or not",
    )  # fmt: skip
    told = "write a proof of the answer, for ssp-lp check"
    _add_file(answer, "--certificate-out", metavar="FILE", help=told)
    _add_file(answer, "--plot", metavar="FILE", help="draw the law of the total cost")
    answer.add_argument("--json", action="store_true", help=_JSON)


def _add_tracing(one: ArgumentParser, points: int | None = None) -> None:
    """Add the arguments of whatever traces a frontier."""
    _add_question(one, [name for name in CRITERIA if name not in _NO_PROGRAM])
    said = "the limit to trace, by its words: failure if left out; other limits are kept"
    one.add_argument("--over", metavar="NAME", default="failure", help=said)
    one.add_argument("--gap", type=float, metavar="GAP", help="how near; 1e-9")
    many = "at most so many turning points" + ("" if points is None else f"; {points}")
    one.add_argument("--point-limit", type=int, metavar="N", default=points, help=many)
    one.add_argument("--time-limit", type=float, metavar="SECONDS", help="then what is there")


def _add_explore(one: ArgumentParser) -> None:
    """Add the arguments of ``explore``."""
    _add_tracing(one, 50)
    _add_file(one, "--out", required=True, metavar="FILE", help="the page: .html")
    one.add_argument("--seed", type=int, default=0, metavar="N", help="of the sample runs; 0")


def _add_frontier(one: ArgumentParser) -> None:
    """Add the command-line arguments of ``frontier``."""
    _add_tracing(one)
    _add_forms(one)
    _add_file(one, "--plot", metavar="FILE", help="draw it, with the budget and its tangent")


def _add_forms(one: ArgumentParser) -> None:
    """Add ``--json`` and ``--csv``, printed or in a file, of which there may be one."""
    form = one.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help=_JSON)
    _add_file(form, "--csv", nargs="?", const="-", metavar="FILE", help="for tables; into a file")


def _add_simulate(one: ArgumentParser) -> None:
    """Add the command-line arguments of ``simulate``."""
    _add_file(one, "--policy", required=True, metavar="FILE", help="of solve --policy-out")
    one.add_argument("--episodes", type=int, default=10_000, metavar="N", help="10,000")
    one.add_argument("--seed", type=int, default=0, metavar="N", help="0")
    one.add_argument("--max-steps", type=int, default=10_000, metavar="N", help="10,000")
    one.add_argument("--confidence", type=float, default=0.95, metavar="P", help="0.95")
    one.add_argument(
        "--check", action=BooleanOptionalAction, default=True,
        help="whether the policy must be of this very model, the default",
    )  # fmt: skip
    one.add_argument("--json", action="store_true", help=_JSON)


def _add_program(one: ArgumentParser) -> None:
    """Add the command-line arguments of ``program``."""
    _add_question(one, [name for name in CRITERIA if name not in _NO_PROGRAM])
    _add_file(one, "--out", metavar="FILE", help="write it: .mps or .lp")


def _add_convert(one: ArgumentParser) -> None:
    """Add the command-line argument of ``convert``."""
    one.add_argument("target", metavar="TARGET", help="a file, or - for JSON to read on")


def _add_info(one: ArgumentParser) -> None:
    """Add the command-line argument of ``info``."""
    one.add_argument("--json", action="store_true", help=_JSON)


def _add_check(one: ArgumentParser) -> None:
    """Add the command-line argument of ``check``."""
    _add_file(one, "certificate", metavar="FILE", help="of solve --certificate-out")


def _add_compile(one: ArgumentParser) -> None:
    """``compile`` takes no arguments of the command line."""


class Verb(NamedTuple):
    """A command of the command line: what it is for, what it takes, and how it is used."""

    purpose: str
    add: Callable[[ArgumentParser], None]  # adds its own arguments
    examples: str  # run as they stand, given the file roads.json of the page on the command line
    takes_model: bool = True


VERBS = {
    "solve": Verb(
        "the best policy within a failure budget, and its proof",
        _add_solve,
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
        "check a certificate by exact inequalities: between which fractions the optimum lies",
        _add_check,
        """\
  ssp-lp solve roads.json --goal home --start depot --certificate-out roads.cert
  ssp-lp check roads.cert""",
        takes_model=False,
    ),
    "frontier": Verb(
        "the least cost for every failure budget at once",
        _add_frontier,
        """\
  ssp-lp frontier roads.json --goal home --start depot
  ssp-lp frontier roads.json --goal home --start depot --criterion s3p --csv frontier.csv
  ssp-lp frontier roads.json --goal home --start depot --failure-budget 0.05 --plot frontier.png
  ssp-lp frontier roads.json --goal home --start depot --limit "cost <= 9" --over cost""",
    ),
    "explore": Verb(
        "a page of HTML with a slider along the frontier",
        _add_explore,
        """\
  ssp-lp explore roads.json --goal home --start depot --failure-budget 0.05 --out roads.html
  ssp-lp explore gym:FrozenLake-v1 --horizon none --out lake.html""",
    ),
    "program": Verb(
        "the linear program of a criterion, shown or written",
        _add_program,
        """\
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05
  ssp-lp program roads.json --goal home --start depot --failure-budget 0.05 --out roads.mps""",
    ),
    "simulate": Verb(
        "play a saved policy, with confidence intervals",
        _add_simulate,
        """\
  ssp-lp simulate roads.json --goal home --start depot --policy policy.npz --seed 7
  ssp-lp solve gym:FrozenLake-v1 --policy-out lake.npz
  ssp-lp simulate gym:FrozenLake-v1 --policy lake.npz --episodes 500""",
    ),
    "info": Verb(
        "what a model holds, and how little can fail in it",
        _add_info,
        """\
  ssp-lp info roads.json --goal home --start depot
  ssp-lp info gym:FrozenLake-v1 --horizon none --json""",
    ),
    "convert": Verb(
        "a model from one format into another",
        _add_convert,
        """\
  ssp-lp convert roads.json roads.drn --goal home --start depot
  ssp-lp convert gym:FrozenLake-v1 - --horizon 20 | ssp-lp info -""",
    ),
    "compile": Verb(
        "compile all inner loops at once, a minute or two with the extra fast (numba)",
        _add_compile,
        """\
  ssp-lp compile""",
        takes_model=False,
    ),
}
"""Every command of the command line, by its name."""
