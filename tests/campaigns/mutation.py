"""Mutants of a package, each tried in a forked child by the tests that run its line.

Run from the repository's root; where processes cannot be forked there is no such campaign::

    python tests/campaigns/mutation.py game verification --every 3

The parent imports the library and collects the tests of the package's room. A first child runs them
all and says which lines each of them runs, and for how long. Then each mutant has a child of its
own: its functions get the mutated code, and the tests that run its line follow, the quickest first,
until one fails, or until they have taken ``--seconds``. A test that takes three times its own time,
and a little, hangs; this kills the mutant, too.

Mutants are those of comparisons, arithmetic, numbers, ``and``, ``or``, ``not``, minima and maxima,
branches, and statements that are dropped. Left out are annotations, docstrings, messages, logs, and
what runs when a module is imported. Prints a table, and each mutant that survives.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import pickle
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory
from types import CodeType, FrameType, FunctionType
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
MEMORY = 8 << 30  # bytes of a child
GRACE = 1.5  # seconds of a processor that a test may take beyond three times its own

ROOMS = {
    "accumulated_cost": "tests/accumulated_cost tests/programs",
    "analysis": "tests/analysis",
    "column_generation": "tests/column_generation",
    "dynamic_programming": "tests/dynamic_programming",
    "game": "tests/game tests/theorems/test_game_theorems.py",
    "io": "tests/io",
    "methods": "tests/methods",
    "model": "tests/model",
    "policies": "tests/policies",
    "processes": "tests/processes",
    "reductions": "tests/reductions",
    "verification": "tests/verification tests/reductions/test_exploration.py",
}
"""The tests of each package of ``ssp_lp``."""

COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Mod: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
_PAIRS = ["min max", "minimum maximum", "any all", "floor ceil", "argmin argmax"]
TWINS = {one: other for pair in _PAIRS for one, other in (pair.split(), pair.split()[::-1])}
SKIPPED = {"annotation", "returns", "decorator_list", "defaults", "kw_defaults", "msg"}


class Mutant(NamedTuple):
    """A changed node of a syntax tree, by its number among those of :func:`nodes`."""

    line: int
    begin: int  # first line of its statement
    change: str
    number: int
    choice: int  # among the changes of the node


def numbers(value: object) -> list[object]:
    """Numbers in place of one."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [0, 2] if value == 1 else [value + 1 if value < 10 else value // 4]
    if isinstance(value, float):
        return [value + 1.0 if value in (0.0, 0.5, 1.0, 2.0) else 100.0 * value]
    return []


def changes(node: Any, known: set[str]) -> Iterator[ast.AST]:
    """Nodes in place of one; an assignment is dropped where its names have a value before it."""
    fields: list[tuple[str, Any]] = []
    if isinstance(node, ast.Compare):
        for k, operator in enumerate(node.ops):
            ops = [[*node.ops[:k], new(), *node.ops[k + 1 :]] for new in COMPARED[type(operator)]]
            fields += [("ops", each) for each in ops]
    elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in COMPUTED:
        fields = [("op", COMPUTED[type(node.op)]())]
    elif isinstance(node, ast.Constant):
        fields = [("value", value) for value in numbers(node.value)]
    elif isinstance(node, ast.UnaryOp):
        yield node.operand
    elif isinstance(node, ast.BoolOp):
        for k in range(len(node.values)):
            rest = [*node.values[:k], *node.values[k + 1 :]]
            yield rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
    elif isinstance(node, ast.Call) and isinstance(node.func, (ast.Name, ast.Attribute)):
        is_name = isinstance(node.func, ast.Name)
        word = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
        if word in TWINS:
            func = copy.deepcopy(node.func)
            setattr(func, "id" if is_name else "attr", TWINS[word])
            fields = [("func", func)]
        elif word == "abs" and len(node.args) == 1:
            yield node.args[0]
    elif isinstance(node, (ast.If, ast.While, ast.IfExp)) and not isinstance(
        node.test, ast.Compare
    ):
        fields = [("test", ast.UnaryOp(ast.Not(), node.test))]
    elif isinstance(node, ast.comprehension):
        fields = [("ifs", [*node.ifs[:k], *node.ifs[k + 1 :]]) for k in range(len(node.ifs))]
    for name, value in fields:
        new = copy.copy(node)
        setattr(new, name, value)
        yield new
    is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    is_again = (
        isinstance(node, ast.Assign) and set[str]().union(*map(names_in, node.targets)) <= known
    )
    if is_call or is_again or isinstance(node, (ast.AugAssign, ast.Raise, ast.Continue, ast.Break)):
        yield ast.Pass()


def names_in(node: ast.AST) -> set[str]:
    """Names that a node assigns."""
    inner = (n for n in ast.walk(node) if isinstance(n, ast.Name))
    return {n.id for n in inner if isinstance(n.ctx, ast.Store)}


def nodes(
    tree: ast.AST, known: set[str] | None = None
) -> Iterator[tuple[Any, Callable[[Any], None], set[str]]]:
    """The nodes of a tree that may be changed: each, with what puts another one in its place.

    Args:
        tree: a module, or a part of it.
        known: names that have a value before it, which come with each node; None outside of
            functions, where nothing is changed.
    """
    for field, value in ast.iter_fields(tree):
        for k, child in enumerate(value if isinstance(value, list) else [value]):
            text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            is_log = isinstance(child, ast.Expr) and "_LOG" in ast.unparse(child)
            is_place = isinstance(tree, ast.Subscript) and isinstance(child, ast.Constant)
            told = isinstance(child, ast.keyword) and child.arg in {"strict", "axis", "dtype"}
            left_out = text or is_log or is_place or told or isinstance(child, ast.JoinedStr)
            if not isinstance(child, ast.AST) or field in SKIPPED or left_out:
                continue
            inside = known
            if isinstance(child, ast.FunctionDef):
                inside = {a.arg for a in [*child.args.args, *child.args.kwonlyargs]}
            elif known is not None:

                def put(new: Any, field: str = field, k: int = k) -> None:
                    """Put a node in the place of the child."""
                    if isinstance(getattr(tree, field), list):
                        getattr(tree, field)[k] = new
                    else:
                        setattr(tree, field, new)

                yield child, put, set(known)
            yield from nodes(child, inside)
            if known is not None and isinstance(child, ast.stmt):
                known |= names_in(child)


def mutants(source: str) -> Iterator[Mutant]:
    """The mutants of a module, in the order of its text."""
    line = begin = 0
    for number, (node, _, known) in enumerate(nodes(ast.parse(source))):
        line = getattr(node, "lineno", line)
        begin = line if isinstance(node, ast.stmt) else begin
        for choice, new in enumerate(changes(node, known)):
            texts = (ast.unparse(each).partition("\n")[0][:100] for each in (node, new))
            yield Mutant(line, begin, " -> ".join(texts), number, choice)


def mutated(source: str, mutant: Mutant) -> ast.Module:
    """The tree of a module with a mutant in it; no line moves."""
    tree = ast.parse(source)
    for number, (node, put, known) in enumerate(nodes(tree)):
        if number == mutant.number:
            new = list(changes(node, known))[mutant.choice]
            put(ast.copy_location(new, node) if hasattr(node, "lineno") else new)
            break
    return ast.fix_missing_locations(tree)


def codes(code: CodeType) -> Iterator[tuple[tuple[str, int], CodeType]]:
    """The code of each function of a module, by name and line."""
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield (inner.co_qualname, inner.co_firstlineno), inner
            yield from codes(inner)


class Lines(NamedTuple):
    """What a test took, and what it ran."""

    seconds: float  # of a processor
    lines: set[tuple[str, int]]  # (path, line)


class Campaign:
    """A plugin of pytest that tries mutants instead of running the tests once."""

    def __init__(self, package: str, asked: argparse.Namespace, folder: Path) -> None:
        every = sorted((ROOT / "ssp_lp" / package).rglob("*.py"))
        self.paths = [str(path) for path in every if path.name != "__init__.py"]
        self.package, self.asked, self.folder = package, asked, folder
        self.stops, self.broken, self.rows = False, False, list[str]()

    def pytest_collection(self) -> None:
        """Spare draws their search for the smallest one that fails."""
        from hypothesis import Phase, settings

        phases = [Phase.explicit, Phase.generate]
        settings.register_profile("mutants", phases=phases, database=None)
        settings.load_profile("mutants")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """End a mutant's child at the first failure."""
        self.broken |= report.failed
        if report.failed and self.stops:
            os._exit(1)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Try the mutants of the package's modules."""
        import gc

        self.session, self.items = session, {item.nodeid: item for item in session.items}
        every = (one for one in gc.get_objects() if isinstance(one, FunctionType))
        self.functions = [one for one in every if one.__code__.co_filename in self.paths]
        table = self.measured()
        for path in self.paths:
            self.rows.append(self.tried(path, table))
        return True

    def forked(self, work: Callable[[], int]) -> int:
        """The exit status of a child that does some work; above 1 if it was killed."""
        if (child := os.fork()) == 0:
            status = 1
            try:
                with open(os.devnull, "w") as nothing:
                    os.dup2(nothing.fileno(), 1), os.dup2(nothing.fileno(), 2)
                resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
                factory = self.session.config._tmp_path_factory  # type: ignore[attr-defined]
                factory._given_basetemp = self.folder / str(os.getpid())
                status = work()
            finally:
                os._exit(status)
        return abs(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))

    def run(self, names: list[str], before: Callable[[str], None]) -> Iterator[str]:
        """Run tests one after the other."""
        for name, after in zip(names, [*names[1:], None], strict=True):
            before(name)
            self.session.config.hook.pytest_runtest_protocol(
                item=self.items[name], nextitem=after and self.items[after]
            )
            yield name

    def measured(self) -> dict[str, Lines]:
        """What each test takes and runs, by a child that runs them all; without those that fail.

        Fixtures of a module count with its dearest test, and with all that ask for them.
        """

        def work() -> int:
            table, lines = dict[str, Lines](), set[tuple[str, int]]()

            def trace(frame: FrameType, event: str, _: object) -> Any:
                if frame.f_code.co_filename in self.paths:
                    lines.add((frame.f_code.co_filename, frame.f_lineno))
                    return trace
                return None

            began = time.process_time()
            for name in self.run([*self.items], lambda name: sys.settrace(trace)):
                sys.settrace(None)
                if not self.broken:
                    table[name] = Lines(time.process_time() - began, set(lines))
                self.broken, began = False, time.process_time()
                lines.clear()
            Path(kept.name).write_bytes(pickle.dumps(table))
            return 0

        with NamedTemporaryFile(dir=self.folder) as kept:
            self.forked(work)
            table: dict[str, Lines] = pickle.loads(Path(kept.name).read_bytes())  # noqa: S301
        dearest = Counter[str]()
        for name, each in table.items():
            module = name.partition("::")[0]
            dearest[module] = max(dearest[module], each.seconds)  # type: ignore[assignment]
        return {
            name: each._replace(seconds=max(each.seconds, dearest[name.partition("::")[0]]))
            if self.shares_fixtures(name) else each
            for name, each in table.items()
        }  # fmt: skip

    def shares_fixtures(self, name: str) -> bool:
        """Whether a test asks for a fixture that is made once for its module or session."""
        known = self.items[name]._fixtureinfo.name2fixturedefs  # type: ignore[attr-defined]
        return any(one.scope in {"module", "session"} for each in known.values() for one in each
                   if one.baseid)  # fmt: skip

    def tried(self, path: str, table: dict[str, Lines]) -> str:
        """Try the mutants of a module, print those that survive, and return its row."""
        source, counts = Path(path).read_text(encoding="utf-8"), Counter[str]()
        covered: dict[int, list[str]] = {}
        for name in sorted(table, key=lambda name: table[name].seconds):
            for other, line in table[name].lines:
                if other == path:
                    covered.setdefault(line, []).append(name)
        every = list(mutants(source))
        for mutant in every[self.asked.begin :: self.asked.every]:
            chosen, left = list[str](), self.asked.seconds
            for name in covered.get(mutant.line, covered.get(mutant.begin, [])):
                left -= table[name].seconds
                chosen += [name] if left >= 0.0 or not chosen else []
            said = self.outcome(path, source, mutant, chosen, table) if chosen else "uncovered"
            counts[said] += 1
            if said in {"survived", "uncovered"}:
                print(f"{path}:{mutant.line}: {said}: {mutant.change}", flush=True)
        columns = [counts[word] for word in ("killed", "timed out", "survived", "uncovered")]
        numbers = " | ".join(f"{number:,}" for number in (len(every), counts.total(), *columns))
        return f"| `{Path(path).relative_to(ROOT)}` | {numbers} |"

    def outcome(
        self, path: str, source: str, mutant: Mutant, chosen: list[str], table: dict[str, Lines]
    ) -> str:
        """What some tests say of a mutant."""
        new = dict(codes(compile(mutated(source, mutant), path, "exec")))

        def limit(name: str) -> None:
            signal.setitimer(signal.ITIMER_VIRTUAL, 3.0 * table[name].seconds + GRACE)

        def work() -> int:
            for one in self.functions:
                key = one.__code__.co_qualname, one.__code__.co_firstlineno
                if one.__code__.co_filename == path and key in new:
                    one.__code__ = new[key]
            self.stops = True
            return 0 * len([*self.run(chosen, limit)])

        status = self.forked(work)
        return "survived" if status == 0 else "killed" if status == 1 else "timed out"


def main(arguments: list[str] | None = None) -> int:
    """Try the mutants of some packages; print a table and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("packages", nargs="+", choices=ROOMS)
    parser.add_argument("--every", type=int, default=1, help="try each k-th mutant")
    parser.add_argument("--begin", type=int, default=0, help="from this one on")
    parser.add_argument("--seconds", type=float, default=3.0, help="of tests for a mutant")
    asked = parser.parse_args(arguments)
    rows = [
        "| module | mutants | tried | killed | timed out | survived | uncovered |",
        "|---|---|---|---|---|---|---|",
    ]
    options = ["-q", "--tb=no", "--capture=no", "-p", "no:cacheprovider", "-p", "no:xdist"]
    with TemporaryDirectory() as name:
        for package in asked.packages:
            campaign = Campaign(package, asked, Path(name))
            pytest.main([*options, *ROOMS[package].split()], plugins=[campaign])
            rows += campaign.rows
    print("\n".join(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
