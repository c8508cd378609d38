"""Tasks: requirements of a run, as formulas of linear temporal logic over finite traces (LTLf).

The trace of a run has a position for each state: the labels of the state and, except at the last
position, the action taken there. A formula is a tuple of its operator and its parts; negations
occur only at names. Progression reads the trace: after each position an obligation remains, which
must hold from the next position on. An obligation is a set of alternatives, each a set of formulas.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ssp_lp.arrays import BoolArray, IntArray, read_only, segment_ids
from ssp_lp.errors import ModelError, ModelWarning, did_you_mean, in_short
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import SSP, check_model, no_lone_string
from ssp_lp.model.tracked_product import Automaton, TrackedSSP, track

Formula = tuple[Any, ...]
Obligation = frozenset[frozenset[Formula]]

_TRUE, _FALSE = ("true",), ("false",)
_MET, _BROKEN = frozenset([frozenset[Formula]()]), frozenset[frozenset[Formula]]()

_TOKEN = re.compile(r'\s*(?:(?P<sign><->|->|[!&|()])|(?P<word>[A-Za-z_]\w*)|"(?P<quoted>[^"]*)")')
_LEVELS = ("<->",), ("->",), ("|",), ("&",), ("U", "R")  # binary operators, the loosest first
_RIGHT = "->", "U", "R"  # operators that group to the right
_UNARY = "!", "X", "N", "F", "G"
_WORDS = {"true", "false", *_UNARY, *_LEVELS[-1]}  # no names, unless quoted
_DUAL = {"and": "or", "or": "and", "X": "N", "N": "X", "U": "R", "R": "U"}
_MOST_VALUES, _MOST_NAMES = 10_000, 62  # names are bits of a whole number


class _Reader:
    """Reader of a task's text, token by token."""

    def __init__(self, text: str) -> None:
        self.text, self.place = text, 0
        self.tokens = list[tuple[str, str, int]]()  # kind, text, position
        end = 0
        while end < len(text.rstrip()):
            match = _TOKEN.match(text, end)
            if match is None:
                start = end + len(text[end:]) - len(text[end:].lstrip())
                raise self._error("not a name or an operator", start)
            kind, end = str(match.lastgroup), match.end()
            name, start = match[kind], match.start(kind) - (kind == "quoted")
            kind = "sign" if kind == "word" and name in _WORDS else kind
            self.tokens.append((kind, name, start))
        self.tokens.append(("end", "", len(text.rstrip())))

    def _error(self, message: str, position: int) -> ModelError:
        """Return the error at a position of the text, marked by a caret."""
        return ModelError(f"task: {message}\n  {self.text}\n  {' ' * position}^")

    def _takes(self, *signs: str) -> str:
        """Consume and return the next token if it is one of the given operators; else return ""."""
        kind, name, _ = self.tokens[self.place]
        if kind != "sign" or name not in signs:
            return ""
        self.place += 1
        return name

    def whole(self) -> Formula:
        """Return the formula of the text.

        Raises:
            ModelError: the text is not a formula.
        """
        formula = self._binary(0)
        if self.tokens[self.place][0] != "end":
            raise self._error("expected an operator & | -> <-> U R", self.tokens[self.place][2])
        return _negated_at_names(formula)

    def _binary(self, level: int) -> Formula:
        """Read a formula whose binary operators have at least this level of precedence."""
        if level == len(_LEVELS):
            return self._unary()
        left = self._binary(level + 1)
        while sign := self._takes(*_LEVELS[level]):
            right = self._binary(level if sign in _RIGHT else level + 1)
            both = ("and", left, right), ("and", ("not", left), ("not", right))
            left = {
                "&": both[0],
                "|": ("or", left, right),
                "->": ("or", ("not", left), right),
                "<->": ("or", *both),
            }.get(sign, (sign, left, right))
        return left

    def _unary(self) -> Formula:
        """Read a name, a constant, a formula in brackets, or a unary operator and its operand."""
        kind, name, position = self.tokens[self.place]
        if kind in ("word", "quoted"):
            self.place += 1
            return ("name", name)
        if sign := self._takes("true", "false"):
            return (sign,)
        if sign := self._takes(*_UNARY):
            inner = self._unary()
            written = {"!": ("not", inner), "F": ("U", _TRUE, inner), "G": ("R", _FALSE, inner)}
            return written.get(sign, (sign, inner))
        if not self._takes("("):
            raise self._error("expected a name, a bracket, or one of ! X N F G", position)
        inner = self._binary(0)
        if not self._takes(")"):
            raise self._error("expected a closing bracket", self.tokens[self.place][2])
        return inner


def _negated_at_names(formula: Formula, *, negated: bool = False) -> Formula:
    """Return an equivalent formula with negations at names only: not X f becomes N not f."""
    kind, *parts = formula
    if kind == "not":
        return _negated_at_names(parts[0], negated=not negated)
    if kind in ("true", "false"):
        return _TRUE if (kind == "true") != negated else _FALSE
    if kind == "name":
        return ("no name", *parts) if negated else formula
    operator = _DUAL[kind] if negated else kind
    return (operator, *(_negated_at_names(part, negated=negated) for part in parts))


def _simplest(alternatives: Iterable[frozenset[Formula]]) -> Obligation:
    """Remove alternatives that contain another alternative; equivalent obligations become equal."""
    every = frozenset(alternatives)
    return frozenset(a for a in every if not any(b < a for b in every))


def _both(a: Obligation, b: Obligation) -> Obligation:
    """Return the conjunction of two obligations."""
    return _simplest(x | y for x in a for y in b)


def _alternatives(formula: Formula) -> Obligation:
    """Return the obligation to satisfy a formula, with conjunctions and disjunctions split."""
    if formula[0] in ("and", "or"):
        first, second = map(_alternatives, formula[1:])
        return _both(first, second) if formula[0] == "and" else _simplest(first | second)
    if formula in (_TRUE, _FALSE):
        return _MET if formula == _TRUE else _BROKEN
    return frozenset([frozenset([formula])])


def _here(formula: Formula, seen: frozenset[str], go_on: bool) -> Obligation:
    """Return the obligation that remains of a formula after the present position.

    Args:
        formula: formula that must hold from the present position on.
        seen: labels and actions that hold at the present position.
        go_on: whether there is a next position. If not, the formula either holds or not: the result
            is ``_MET`` or ``_BROKEN``.
    """
    kind, *parts = formula
    if kind in ("true", "false"):
        return _MET if kind == "true" else _BROKEN
    if kind in ("name", "no name"):
        return _MET if (parts[0] in seen) == (kind == "name") else _BROKEN
    if kind in ("X", "N"):
        if not go_on:
            return _MET if kind == "N" else _BROKEN
        return _alternatives(parts[0])
    first, second = (_here(part, seen, go_on) for part in parts)
    again = frozenset([frozenset([formula])]) if go_on else _MET if kind == "R" else _BROKEN
    if kind == "U":
        return _simplest(second | _both(first, again))
    if kind == "R":
        return _both(second, _simplest(first | again))
    return _both(first, second) if kind == "and" else _simplest(first | second)


def _left(obligation: Obligation, seen: frozenset[str], go_on: bool = True) -> Obligation:
    """Return what remains of an obligation after the present position; see :func:`_here`."""
    left = _BROKEN
    for alternative in obligation:
        every = _MET
        for formula in alternative:
            every = _both(every, _here(formula, seen, go_on))
        left = _simplest(left | every)
    return left


def _text(formula: Formula, inside: bool = False) -> str:
    """Return a formula as text that can be typed; ``inside`` puts a binary one in brackets."""
    kind, *parts = formula
    if kind in ("true", "false"):
        return str(kind)
    if kind in ("name", "no name"):
        is_plain = re.fullmatch(r"[A-Za-z_]\w*", parts[0]) and parts[0] not in _WORDS
        name = parts[0] if is_plain else f'"{parts[0]}"'
        return f"{'!' * (kind == 'no name')}{name}"
    if kind in ("X", "N") or (kind, parts[0]) in (("U", _TRUE), ("R", _FALSE)):
        sign = {"U": "F", "R": "G"}.get(kind, kind)
        return f"{sign} {_text(parts[-1], inside=True)}"
    sign = {"and": "&", "or": "|"}.get(kind, kind)
    text = f" {sign} ".join(_text(part, inside=True) for part in parts)
    return f"({text})" if inside else text


def _obligation_text(obligation: Obligation) -> str:
    """Return an obligation as text that can be typed."""
    inside = len(obligation) > 1
    texts = [
        " & ".join(sorted(_text(f, inside or len(each) > 1) for f in each)) for each in obligation
    ]
    return "false" if not texts else " | ".join(sorted(text or "true" for text in texts))


@dataclass(frozen=True)
class Task:
    """A formula of linear temporal logic over the finite trace of a run; see :func:`task`."""

    text: str

    def __post_init__(self) -> None:
        _ = self.formula

    def __repr__(self) -> str:
        """Return the call that makes the task."""
        return f"task({self.text!r})"

    @cached_property
    def formula(self) -> Formula:
        """The formula, with its negations at names.

        Raises:
            ModelError: the text is not a formula.
        """
        try:
            formula = _Reader(self.text).whole()
            _ = _text(formula)
        except RecursionError:
            raise ModelError(f"task: {in_short(self.text)} is nested too deeply") from None
        return formula

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Labels and actions that the task names."""
        found, pending = dict[str, None](), [self.formula]
        while pending:
            kind, *parts = pending.pop()
            if kind in ("name", "no name"):
                found[parts[0]] = None
            else:
                pending += reversed(parts)
        return tuple(found)

    def seen(self, model: SSP) -> tuple[IntArray, IntArray]:
        """Return the task's names that hold in each state and at each pair, as bit masks.

        Args:
            model: the model.

        Returns:
            Two arrays of whole numbers whose bit k says whether ``names[k]`` holds: for each state
            its labels, [states]; for each pair the labels of its state and its action, [pairs].

        Raises:
            ModelError: a name that is both a label and an action, or neither; or too many names.
        """
        if len(self.names) > _MOST_NAMES:
            told = f"it has {len(self.names)} names, more than {_MOST_NAMES}"
            raise ModelError(f"{in_short(self)}: {told}: give several states one label")
        states = np.zeros(model.n_states, dtype=np.int64)
        actions = np.zeros(len(model.action_names), dtype=np.int64)
        for bit, name in enumerate(self.names):
            is_action = np.array([str(word) == name for word in model.action_names], dtype=np.bool_)
            if name in model.state_labels and is_action.any():
                raise ModelError(f"{self!r}: {name!r} is a state label and an action: rename one")
            if name in model.state_labels:
                states[model.state_labels[name]] |= 1 << bit
            elif is_action.any():
                actions[is_action] |= 1 << bit
            else:
                told = f"{name!r} is neither a label of states nor an action"
                if model.find(name) is not None:
                    told += f"; it is a state: give it a label, state_labels={{{name!r}: [...]}}"
                    raise ModelError(f"{self!r}: {told}")
                known = [*model.state_labels, *map(str, model.action_names)]
                raise ModelError(f"{self!r}: {told}{did_you_mean(name, known, 'there are')}")
        return states, states[model.pair_state] | actions[model.pair_action]

    def _read(self, letters: IntArray) -> list[frozenset[str]]:
        """Return the set of names that each bit mask of :meth:`seen` stands for, [letters]."""
        return [
            frozenset(name for bit, name in enumerate(self.names) if letter >> bit & 1)
            for letter in letters.tolist()
        ]

    @explained
    def automaton(self, model: SSP) -> Automaton:
        """Return the automaton that follows the task on a model; its values are obligations.

        Args:
            model: the model, whose labels and actions the task names.

        Raises:
            ModelError: a name that is both a label and an action, or neither, or a task that
                distinguishes too many obligations.
        """
        check_model(model, "automaton")
        return self.followed(model)[0]

    def followed(self, model: SSP) -> tuple[Automaton, BoolArray]:
        """Return the automaton of the task on a model, and where the task is satisfied.

        Returns:
            The automaton, whose values are obligations; and a mask [values, states]. An entry says
            whether the task is satisfied if the trace ends in the state while the automaton has the
            value.
        """
        of_states, of_pairs = self.seen(model)
        distinct, by_pair = np.unique(of_pairs, return_inverse=True)
        letters, start = self._read(distinct), _alternatives(self.formula)
        number, moves = {start: 0}, list[list[int]]()
        pending = [start]
        for obligation in pending:
            after = [_left(obligation, seen) for seen in letters]
            new = [each for each in dict.fromkeys(after) if each not in number]
            number |= {each: len(number) + k for k, each in enumerate(new)}
            pending += new
            moves.append([number[each] for each in after])
            if len(number) > _MOST_VALUES:
                raise ModelError(f"{self!r} needs a memory of over {_MOST_VALUES:,} values")
        last, by_state = np.unique(of_states, return_inverse=True)
        ends = [[_left(each, s, False) == _MET for s in self._read(last)] for each in number]
        automaton = Automaton(
            name=repr(self),
            words=tuple(map(_obligation_text, number)),
            letters=tuple(" and ".join(sorted(seen)) or "nothing" for seen in letters),
            moves=np.array(moves, dtype=np.int64).reshape(len(number), len(letters)),
            letter=by_pair[segment_ids(model.outcome_offsets)],
            begin=np.zeros(model.n_states, dtype=np.int64),
        )
        return automaton, read_only(np.array(ends, dtype=np.bool_)[:, by_state])

    def satisfied(self, product: TrackedSSP) -> BoolArray:
        """Return a mask of the product's states: a trace that ends there satisfies the task."""
        ends = self.followed(product.original)[1]
        return np.asarray(ends[product.labels.number, product.original_state])


@explained
def task(text: str) -> Task:
    """Return a task: a requirement of runs, as a formula over labels of states and actions.

    The operators, the tightest first: ``! X N F G``, ``U R``, ``&``, ``|``, ``->``, ``<->``. X f:
    there is a next position, and f holds there; N f: if there is one, f holds there; F f: f holds
    now or later; G f: f holds now and always later; f U g: g holds now or later, and f until then;
    f R g: g holds up to and including the position where f holds, or to the end. Unusual names need
    quotes.

    Args:
        text: the formula, such as ``"F key & (!door U key)"``.

    Raises:
        ModelError: the text is not a formula; a caret marks the error.

    Example:
        >>> task("F key & (!door U key)").names
        ('key', 'door')
    """
    return Task(text)


@explained
def reach(model: SSP, goal: Task, *, start: Iterable[Hashable]) -> TrackedSSP:
    """Return the product of a model with a task, whose goal is to satisfy the task.

    A run ends at the first state at which its trace satisfies the task. The model's own goal also
    ends it, as a failure if the task is not satisfied.

    Args:
        model: the model.
        goal: the task.
        start: states in which episodes may begin.

    Returns:
        The product, with states (state, obligation); goals of the model that do not satisfy the
        task bear the label "goal not accepted".

    Raises:
        ModelError: an unknown name or start, or no run satisfies the task.
    """
    check_model(model, "reach")
    if not isinstance(goal, Task):
        raise ModelError(f"reach() takes task('F key') after the model, not {in_short(goal)}")
    begin = np.array([model.index_of(s) for s in no_lone_string(start, "start")], dtype=np.int64)
    automaton, ends = goal.followed(model)
    for state in begin[ends[0, begin]].tolist():
        told = f"the start {model.states[state]!r} satisfies {goal!r}: its runs take no step"
        warnings.warn(told, ModelWarning, stacklevel=3)
    made = track(model, automaton, goal, begin, lambda state, value: ends[value, state])
    if not made.goal_mask.any():
        raise ModelError(f"no run from the start satisfies {goal!r}")
    return made
