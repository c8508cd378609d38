"""A policy as one C99 header: tables, and a function that looks up actions, without allocation.

States and actions are numbers, in the order of the model. A small struct has the memory of an
episode, apart from the total paid: the member of a lottery that plays it, the tail followed beyond
the cap, whether it has given up, and the level to which a total was rounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.archives import fingerprint
from ssp_lp.io.controller_file import controller_member
from ssp_lp.io.model_files.raw_model import FilePath, write_text
from ssp_lp.model.arguments import explained
from ssp_lp.policies import MixedPolicy, Policy
from ssp_lp.policies.policy import as_lottery

_NEVER = 1e308
"""Finite number in place of an infinite total, which no episode reaches."""

_DRAWN = -3
"""First of the codes for random decisions, which go downwards."""

_OTHERS = {"threshold": "double", "levels": "double", "share": "double", "offsets": "int",
           "ends": "unsigned char"}  # fmt: skip
"""Types of the tables without codes."""

_KINDS = {"signed char": 127, "short": 32_767, "int": 2**31 - 1}

_CODE = """
typedef struct { int member, tail, over, level; double paid; } NAME_episode;
#define NAME_BEGIN {-1, -1, -1, 0, 0.0}

/* The number of the action in a state: -1 to give up, -2 where the policy has no decision.

   episode: its memory, NAME_BEGIN where it begins.
   state: its number, 0 .. NAME_states - 1.
   total: paid so far, in multiples of NAME_unit.
   uniform: drawn from [0, 1) at each call; the first one draws the lottery, too. */
static inline int NAME_action(NAME_episode *episode, int state, double total, double uniform)
{
    const NAME_member *member;
    double low = 0.0;
    int code, first, last;
    if (episode->member < 0) {
        episode->member = 0;
        while (episode->member < NAME_count - 1 && uniform >= NAME_members[episode->member].upto)
            low = NAME_members[episode->member++].upto;
        uniform = (uniform - low) / (NAME_members[episode->member].upto - low);
    }
    member = &NAME_members[episode->member];
    if (member->ends && (episode->over > 0 || member->ends[state])) {
        episode->over = 1;
        return member->afterwards[state];
    }
    if (episode->tail < 0) { /* the layer, or from the cap on a tail, for good */
        first = 0, last = member->layers;
        if (member->levels) {
            double step = total - episode->paid;
            episode->paid = total;
            total = member->levels[episode->level] + step;
            while (first < last) { /* the level nearest to the total, the lower one of two */
                const int middle = (first + last) / 2;
                if (total - member->levels[middle] <= member->levels[middle + 1] - total)
                    last = middle;
                else
                    first = middle + 1;
            }
            episode->level = first;
            last = member->layers;
        } else {
            if (total < 1e15)
                total = (double)(long long)(total + 0.5);
            first = total >= last ? last : (int)total;
        }
        if (first >= last)
            episode->tail = total >= member->threshold[state] ? member->tails - 1 : 0;
    }
    if (episode->tail < 0)
        code = member->decision[(long)first * NAME_states + state];
    else
        code = member->tail[(long)episode->tail * NAME_states + state];
    if (code <= DRAWN) {
        first = member->offsets[DRAWN - code], last = member->offsets[DRAWN - code + 1] - 1;
        while (first < last && uniform >= member->share[first])
            first++;
        code = member->action[first];
    }
    if (member->ends && code == -1) {
        episode->over = 1;
        return member->afterwards[state];
    }
    return member->ends && code == -2 ? member->otherwise[state] : code;
}
"""

_MEMBER = """typedef struct {
    double upto; /* probability of this member and those before it */
    int layers, tails;
    const NAME_code *decision; /* [layers][states] number of an action, or a code */
    const NAME_code *tail; /* [tails][states] */
    const double *threshold; /* [states] total from which the last tail is followed */
    const double *levels; /* [layers + 1] totals, in place of multiples of a unit */
    const int *offsets; /* of decisions that are drawn, [states + 1] */
    const NAME_code *action;
    const double *share; /* of each such action and those before it */
    const unsigned char *ends; /* [states] of a policy that acts everywhere */
    const NAME_code *otherwise, *afterwards; /* [states] beside the plan, and after it */
} NAME_member;
"""


@explained
def write_c_header(policy: Policy | MixedPolicy, path: FilePath, *, name: str = "policy") -> None:
    """Write a policy as a C99 header with tables and a function that looks up actions.

    The function ``policy_action(&episode, state, total, uniform)`` takes the number of the state in
    the model, the total paid so far and a uniform random number, and returns the number of an
    action; comments in the header explain the rest. It allocates nothing and calls nothing.

    Args:
        policy: stationary, cost-aware, acting everywhere (``Solution.policy_everywhere``), or a
            lottery over these.
        path: name of the file, ``policy.h``.
        name: prefix of all names in the header.

    Raises:
        ModelError: the policy is of another class, its members count costs in different units, or
            the name is not a name in C.
    """
    lottery = as_lottery(policy)
    model, members = lottery.model, lottery.policies
    if not (name.isascii() and name.isidentifier()):
        raise ModelError(f"name must be a name in C, not {name!r}")
    fields, units = list[dict[str, Any]](), set[float | None]()
    for member in members:
        stated = controller_member(member)
        if (memory := stated["memory"]) and "unit" in memory:
            units |= {None if memory["levels"] else memory["unit"]}
        fields.append(_member_fields(stated, member))
    if len(units) > 1:
        raise ModelError("the members of the lottery count costs in different units")
    tables, rows, largest = list[str](), list[str](), 0
    upto = np.minimum(np.cumsum(lottery.weights), 1.0)
    for k, (told, share) in enumerate(zip(fields, upto.tolist(), strict=True)):
        entries = [repr(share)]
        for key, value in told.items():
            if isinstance(value, int):
                entries.append(str(value))
                continue
            table, entry = np.asarray(value), f"{name}_{key}_{k}"
            largest = max(largest, int(np.abs(table).max())) if key not in _OTHERS else largest
            tables.append(_c_table(entry, _OTHERS.get(key, f"{name}_code"), table))
            entries.append(entry)
        rows.append(f"    {{{', '.join(entries)}}},")
    code_type = next(kind for kind, most in _KINDS.items() if largest <= most)
    type_, code = (
        text.replace("NAME", name).replace("DRAWN", str(_DRAWN)) for text in (_MEMBER, _CODE)
    )
    states = (f"   {k}: {state!a}".replace("*/", "* /") for k, state in enumerate(model.states))
    actions = ", ".join(_c_string(str(action)) for action in model.action_names)
    lines = [
        f"/* A policy of ssp-lp, made for the model {fingerprint(model)}.",
        "   States:",
        *states,
        "*/",
        f"#ifndef {name.upper()}_H",
        f"#define {name.upper()}_H",
        f"enum {{ {name}_states = {model.n_states}, {name}_count = {len(members)} }};",
        f"static const double {name}_unit = {next(filter(None, units), 1.0)!r};",
        f"static const char *const {name}_actions[] = {{{actions or '0'}}};",
        f"typedef {code_type} {name}_code;",
        type_,
        *tables,
        f"static const {name}_member {name}_members[] = {{",
        *rows,
        "};",
        code,
        "#endif",
        "",
    ]
    write_text(path, ["\n".join(lines)])


def _member_fields(stated: Mapping[str, Any], policy: Policy) -> dict[str, Any]:
    """Return the fields of a member's struct by name, without ``upto``; a list is a table.

    Args:
        stated: the member as in a controller's file.
        policy: the member.

    Raises:
        ModelError: the struct has no place for its memory.
    """
    memory, decision = stated["memory"], stated["decision"]
    cap = 0 if memory is None else memory.get("cap", -1)
    tails, drawn = decision[cap:], any(type(one) is list for row in decision for one in row)
    if cap < 0 or (drawn and memory):
        raise ModelError(f"a C header cannot contain a {type(policy).__name__}")
    fields: dict[str, Any] = dict.fromkeys(
        ("layers", "tails", "decision", "tail", "threshold", "levels", "offsets", "action", "share",
         "ends", "otherwise", "afterwards"), 0)  # fmt: skip
    fields |= {"layers": cap, "tails": len(tails), "decision": decision[:cap] or 0}
    never = [None] * policy.model.n_states
    layers = never if memory is None else memory["threshold"]
    fields["threshold"] = [_NEVER if layer is None else layer for layer in layers]
    if memory is not None and memory["levels"] is not None:
        fields["levels"] = memory["levels"]
    if drawn:
        (tail,) = tails
        listed = [one if type(one) is list else [(one, 1.0)] for one in tail]
        fields["offsets"] = offsets_of(np.array([*map(len, listed)]))
        fields["action"] = [code for some in listed for code, _ in some]
        fields["share"] = [upto for some in listed for upto in accumulate(p for _, p in some)]
        tails = [_DRAWN - k if type(one) is list else one for k, one in enumerate(tail)]
    fields["tail"] = tails
    if "otherwise" in stated:
        ends = np.zeros(policy.model.n_states, dtype=np.int64)
        ends[stated["ends"]] = 1
        fields |= {"ends": ends, **{name: stated[name] for name in ("otherwise", "afterwards")}}
    return fields


def _c_string(text: str) -> str:
    """Return a text as a C literal; octal escapes stand for all but a few bytes of its UTF-8."""
    plain = (chr(b) if chr(b).isalnum() or chr(b) in " _-+,.:()" else "" for b in range(128))
    known = dict(enumerate(plain))
    return '"' + "".join(known.get(b) or f"\\{b:03o}" for b in text.encode()) + '"'


_A_LINE = 24  # numbers


def _c_table(name: str, kind: str, values: IntArray | FloatArray) -> str:
    """Return a table as C code."""
    words = [repr(value) for value in values.ravel().tolist()]
    lines = (words[k : k + _A_LINE] for k in range(0, len(words), _A_LINE))
    body = ",\n    ".join(", ".join(line) for line in lines)
    return f"static const {kind} {name}[] = {{\n    {body}}};"
