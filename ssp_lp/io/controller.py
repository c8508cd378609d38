"""A controller: runs a policy from a JSON file, with nothing but the standard library.

This file may be copied onto a robot by itself; it needs no other part of ssp-lp. It reads files of
``write_controller``, with the entries

- ``format``: "ssp-lp controller"; ``version``: 1; ``model``: the model's fingerprint;
- ``checksum``: the SHA-256 of all other entries, as JSON with sorted keys and no blanks;
- ``goals``, ``dead_ends``: the numbers of these states;
- ``states``: the labels of the states, or how many states there are if the labels are 0, 1, ...;
  tuples are written as lists;
- ``actions``: the labels of the actions;
- ``members``: the policies of a lottery; one is drawn for each episode. Each has

  - ``weight``: its probability;
  - ``ends``: the numbers of the states in which an episode of this policy is over;
  - ``memory``: null, or an object whose ``kind`` is

    - "layers": the cost paid, as a number of layers of size ``unit``; the cost of a step is rounded
      up to whole layers if ``rounds_up``. Below ``cap`` the memory is this number. Once the number
      reaches ``cap``, the memory is ``cap`` + k for good, where k is the number of one of ``tails``
      tail policies: the last one if the number has reached the state's ``threshold`` (null: never),
      else the first one. If ``levels`` is not null, number k stands for the total cost levels[k]
      instead, the last level is at the cap, a step leads to the level nearest to the old level plus
      its cost, and this sum is compared with the threshold. ``acting``: for each state 1 if a step
      into it updates the memory, else 0;
    - "steps": the number of steps taken, at most ``steps``. After the last step it is ``steps`` + 1
      ("out of time") if the successor is ``acting`` (for each state 1 or 0);
    - "task": a number, initially ``start``. ``moves`` lists the steps that change it: [number,
      state, action, successor, cost, next number]; a cost of null stands for any cost;
    - "failing": 1 if the run has failed, else 0. A run fails by any action in a state of ``lost``,
      and by an action taken with giving up: with n actions, the position n + k in ``decision``
      means action k with giving up. For the inner memory the step that fails costs the state's
      ``charge``, and later steps cost nothing;

    The memories "steps", "task" and "failing" have two more entries. ``place``: [number][state], an
    index for each pair (number, state), -1 for a pair that does not occur. ``inner``: null, or a
    further memory, whose states are these indices;
  - ``decision``: [value of the innermost memory][state of that memory]: the position of an action,
    -1 to give up, -2 for no decision, or a list of [position, probability];
  - ``otherwise`` and ``afterwards``, only in a policy that acts everywhere: the position of an
    action for each state, -2 for none. ``otherwise`` is taken where ``decision`` has no action, and
    ``afterwards`` once the policy has given up or its episode is over.
"""

from __future__ import annotations

import json
import random
import sys
from bisect import bisect_left
from collections.abc import Hashable
from contextlib import suppress
from hashlib import sha256
from math import ceil, isclose
from numbers import Integral, Real
from os import PathLike
from typing import Any, cast

GIVE_UP = "give up"
"""Answer in place of an action if the policy gives up."""

_GIVE_UP_CODE = -1
_VERSION = 1
_SAME_TOTAL = 5e-13  # relative distance of equal costs, summed in two ways
_FAR = 1e15  # units: greatest step
_OFF_LATTICE = 1e-6  # of a unit: far above the rounding of a sum of costs, far below a step


class Controller:
    """A policy that is read from a file and plays an episode.

    Several controllers of one file can play several episodes side by side. The attribute ``model``
    is the fingerprint of the policy's model.

    Args:
        path: a file of ``write_controller``.

    Raises:
        ValueError: not a controller's file, of another version, or changed since it was written.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        try:
            with open(path, encoding="utf-8") as file:
                content = json.load(file)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{path!r} is not an ssp-lp controller file: {error}") from error
        if not isinstance(content, dict) or content.get("format") != "ssp-lp controller":
            raise ValueError(f"{path} is not an ssp-lp controller file")
        if content.get("version") != _VERSION:
            raise ValueError(f"{path} has version {content.get('version')!r}, not {_VERSION}")
        if content.get("checksum") != controller_checksum(content):
            raise ValueError(f"{path} is damaged: its content does not agree with its checksum")
        self.model: str = content["model"]
        states, self._are_numbered = content["states"], isinstance(content["states"], int)
        labels = range(states) if self._are_numbered else map(controller_label, states)
        self._index: dict[Hashable, int] = {label: k for k, label in enumerate(labels)}
        self._actions: list[Hashable] = [controller_label(action) for action in content["actions"]]
        self._goals, self._dead_ends = frozenset(content["goals"]), frozenset(content["dead_ends"])
        self._members: list[dict[str, Any]] = content["members"]
        for member in self._members:
            member["ends"] = frozenset(member["ends"])
        self._rng = random.Random()
        self._member: dict[str, Any] | None = None

    def reset(self, seed: int | None = None, *, world: str = "model") -> None:
        """Begin an episode.

        Args:
            seed: seed of the lottery and of random actions; None: continue with the generator.
            world: "model": it is an error to ask for an action in a state other than the observed
                one, or to observe twice after one action. "other": both are accepted. In both cases
                observed steps are not compared with the model, because the file does not contain
                it.

        Raises:
            ValueError: another value of ``world``.
        """
        if world not in {"model", "other"}:
            raise ValueError(f"world must be 'model' or 'other', not {world!r}")
        if seed is not None:
            self._rng.seed(seed)
        weights = [member["weight"] for member in self._members]
        self._member = self._rng.choices(self._members, weights)[0]
        self._is_model = world == "model"
        self._memory: Any = None  # a number, or [number, inner memory]
        self._step = -1, -1  # the state, and the last action in it
        self._is_observed = True  # whether the last action was observed
        self._is_over = False
        self._answer: Hashable = None  # the last one, repeated once the episode is over
        self._alone = 0  # 1: the member is over, and the controller acts on; 2: it never began
        self._quits = False  # whether the last action is taken with giving up
        self._failed = False

    @property
    def failed(self) -> bool:
        """Whether the goal was lost or given up before or by the last action."""
        return self._failed

    def action(self, state: Hashable) -> Hashable:
        """Return the action in this state; once the episode is over, return "give up" or None.

        The episode is over after giving up ("give up"), and at a goal or a dead-end (None). If the
        policy has decisions after failing, the episode goes on instead, and ``failed`` is True.

        Raises:
            ValueError: the state is unknown, is not the observed one, or has no decision.
            RuntimeError: no episode was begun.
        """
        _, here = self._current(), self._state(state)
        begun = self._memory is not None
        if begun and self._is_model and not self._is_over and here != self._step[0]:
            raise ValueError(f"the episode is in the observed state, not in state {state!r}")
        if not self._is_over and self._ends_in(here):
            self._is_over, self._answer, self._step = True, None, (here, -1)
        if self._is_over:
            self._failed |= self._step[0] not in self._goals
            return self._answer
        if not begun:
            self._begin(here)
        choice = self._choice(here)
        if choice < _GIVE_UP_CODE:
            raise ValueError(f"the policy has no decision in state {state!r}")
        self._quits = choice >= len(self._actions)
        self._step, self._is_observed = (here, choice - self._quits * len(self._actions)), False
        self._is_over = choice == _GIVE_UP_CODE
        self._failed |= self._is_over or self._quits or here in self._dead_ends
        self._answer = GIVE_UP if self._is_over else self._actions[self._step[1]]
        return self._answer

    def _ends_in(self, state: int) -> bool:
        """Return whether an episode is over in a state."""
        member = self._current()
        if "afterwards" in member:
            return state in self._goals or member["afterwards"][state] < 0
        return state in member["ends"]

    def _begin(self, state: int) -> None:
        """Set the initial memory of an episode that begins in this state."""
        member, self._memory = self._current(), 0
        try:
            self._memory = _start_memory(member["memory"], state)
        except ValueError:
            if "otherwise" not in member:
                raise
            self._alone = 2

    def _choice(self, state: int) -> int:
        """Return the number of the action in a state, or a negative code; draw a random action."""
        member, is_over = self._current(), self._alone == 1
        acts = "otherwise" in member
        is_over |= acts and state in member["ends"]
        if is_over or self._alone:
            return int(member["afterwards" if is_over else "otherwise"][state])
        place, memory, number = state, member["memory"], self._memory
        while memory is not None and "place" in memory:
            place, memory = _place_of(memory, number[0], place), memory["inner"]
            number = number[1]
        choice = member["decision"][number][place]
        if isinstance(choice, list):
            kept = [one for one in choice if not self._quits or one[0] >= len(self._actions)]
            codes, shares = zip(*kept, strict=True)
            choice = self._rng.choices(codes, shares)[0]
        if acts and choice == _GIVE_UP_CODE:
            self._alone, self._failed = 1, True
            return int(member["afterwards"][state])
        return int(member["otherwise"][state] if acts and choice < 0 else choice)

    def observe(self, successor: Hashable, cost: float) -> None:
        """Update the memory, given the successor and the cost of the last step.

        Raises:
            ValueError: unknown state, an episode that is over, an action that was observed already,
                a cost that is negative, not finite or no whole number of units, or a step that
                leads to a memory that the policy does not have.
            RuntimeError: no action was requested yet.
        """
        member, there = self._current(), self._state(successor)
        if self._is_over:
            raise ValueError("the episode is over: there is no step to observe")
        if self._memory is None:
            raise RuntimeError("observe() was called before the first action() of the episode")
        if self._is_observed and self._is_model:
            raise ValueError("observe() was called twice after one action()")
        if not (isinstance(cost, Real) and 0.0 <= cost <= sys.float_info.max):
            raise ValueError(f"observed cost {cost!r} must be a number >= 0, and finite")
        if self._ends_in(there):
            self._is_over, self._answer = True, None
        elif "otherwise" in member and self._step[0] in member["ends"]:
            self._alone = 1
        elif not self._alone:
            step = (*self._step, there)
            kept = _memory_after(member["memory"], self._memory, step, float(cost), self._quits)
            self._memory = kept
        self._step, self._is_observed, self._quits = (there, self._step[1]), True, False

    def _current(self) -> dict[str, Any]:
        """Return the member of the lottery that plays the episode.

        Raises:
            RuntimeError: no episode was begun.
        """
        if self._member is None:
            raise RuntimeError("call reset(seed) before the first action of an episode")
        return self._member

    def _state(self, label: Hashable) -> int:
        """Return the number of a state, or raise ValueError if the model does not have it."""
        with suppress(KeyError, TypeError):  # such as a list, which has no hash
            if isinstance(label, Integral) or not self._are_numbered:
                return self._index[label]
        raise ValueError(f"{label!r} is not a state of the model")

    def __repr__(self) -> str:
        """Return a line with the model's fingerprint, its states and the policy's members."""
        states, members = len(self._index), len(self._members)
        return f"Controller(model {self.model[:16]}, {states:,} states, members: {members})"


def controller_checksum(content: dict[str, Any]) -> str:
    """Return the SHA-256 of all entries except the checksum, as compact JSON with sorted keys."""
    hashed = {name: value for name, value in content.items() if name != "checksum"}
    return sha256(json.dumps(hashed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def controller_label(value: Any) -> Hashable:
    """Return the label that a JSON value stands for: a tuple for a list, else the value."""
    if isinstance(value, list):
        return tuple(controller_label(part) for part in value)
    return cast("Hashable", value)


def _start_memory(memory: dict[str, Any] | None, state: int) -> Any:
    """Return the memory of an episode that begins in a state."""
    if memory is None:
        return 0
    if "place" in memory:
        number = memory.get("start", 0)
        place = _place_of(memory, number, state)
        return [number, _start_memory(memory["inner"], place)]
    return 0 if memory["levels"] is not None else _layer_or_tail(memory, 0, 0, state)


def _place_of(memory: dict[str, Any], number: int, state: int) -> int:
    """Return the index of (number, state) in the file's ``place``; number is a memory's value.

    Raises:
        ValueError: the policy does not have this memory in this state.
    """
    place: int = memory["place"][number][state]
    if place < 0:
        raise ValueError("the observations give a memory that the policy never has in this state")
    return place


def _memory_after(
    memory: dict[str, Any] | None, value: Any, step: tuple[int, int, int], cost: float, quits: bool
) -> Any:
    """Return the memory after a step.

    Args:
        memory: description of the memory in the file.
        value: the memory before the step.
        step: state, action and successor.
        cost: cost of the step.
        quits: whether the action is taken with giving up.

    Raises:
        ValueError: the memory has no value after this step or this cost.
    """
    if memory is None:
        return value
    state, action, successor = step
    if "place" in memory:
        number, inner = value
        if memory["kind"] == "failing":
            fails = quits or (number == 0 and state in memory["lost"])
            then = int(fails or number == 1)
            cost = memory["charge"][state] if fails else 0.0 if then else cost
        else:
            then = _number_after(memory, number, step, cost)
        places = zip((number, then), (state, successor), strict=True)
        place, there = (_place_of(memory, *one) for one in places)
        inner = _memory_after(memory["inner"], inner, (place, action, there), cost, quits)
        return [then, inner]
    number = value
    if not memory["acting"][successor] or number >= memory["cap"]:
        return number
    if memory["levels"] is not None:
        levels, total = memory["levels"], memory["levels"][number] + cost
        above = min(max(bisect_left(levels, total), 1), memory["cap"])
        is_below_nearer = total - levels[above - 1] <= levels[above] - total
        return _layer_or_tail(memory, above - is_below_nearer, total, successor)
    paid = cost / memory["unit"]
    if memory["rounds_up"]:
        number += ceil(min(paid, _FAR) * (1.0 - _SAME_TOTAL))
    else:
        steps = round(min(paid, 2.0 * _FAR))
        if steps > _FAR or abs(paid - steps) > _OFF_LATTICE:
            unit = memory["unit"]
            raise ValueError(f"observed cost {cost!r} is not a multiple of the unit {unit!r}")
        number += steps
    return _layer_or_tail(memory, number, number, successor)


def _number_after(
    memory: dict[str, Any], number: int, step: tuple[int, int, int], cost: float
) -> int:
    """Return the number in a memory of kind "steps" or "task" after a step.

    Raises:
        ValueError: the model has no such step at this cost.
    """
    if memory["kind"] == "steps":
        late = memory["acting"][step[2]] and number + 1 >= memory["steps"]
        return int(memory["steps"] + 1) if late else number + 1
    if "table" not in memory:  # indexed once for all steps
        memory["table"] = {}
        for *key, paid, then in memory["moves"]:
            memory["table"].setdefault(tuple(key), []).append((paid, then))
    moves = memory["table"].get((number, *step), [(None, number)])
    for paid, then in moves:
        if paid is None or isclose(paid, cost, rel_tol=_OFF_LATTICE):
            return int(then)
    raise ValueError(f"the model has no step between these states at observed cost {cost!r}")


def _layer_or_tail(memory: dict[str, Any], layer: int, reached: float, state: int) -> int:
    """Return the memory at a number of layers: the number itself below the cap, else a tail's code.

    Tail k has the code cap + k. The last tail is taken if ``reached`` is at least the state's
    threshold, else the first one.
    """
    threshold, cap = memory["threshold"][state], int(memory["cap"])
    if layer < cap:
        return layer
    return cap if threshold is None or reached < threshold else cap + int(memory["tails"]) - 1
