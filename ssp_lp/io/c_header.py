"""A policy as one C99 header: tables, and a function that looks up actions, without allocation.

``policy.h`` beside this file is the template of the header. States and actions are numbers, in the
order of the model. The caller stores the total cost paid in an episode. The rest of the policy's
memory is a small struct: the member of the lottery that was drawn, the tail policy followed beyond
the cap, whether the policy has given up, and the level to which the total was rounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from pathlib import Path
from string import Template
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
"""Number that stands for an infinite total in C: no episode reaches it."""

_DRAWN = -3
"""Greatest code of a random decision; codes are -3, -4, ... ."""

_OTHERS = {"threshold": "double", "levels": "double", "share": "double", "offsets": "int",
           "ends": "unsigned char"}  # fmt: skip
"""C types of the tables that do not contain codes of decisions."""

_KINDS = {"signed char": 127, "short": 32_767, "int": 2**31 - 1}


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
        raise ModelError(f"name must be an identifier in C, not {name!r}")
    fields, units = list[dict[str, Any]](), set[float | None]()
    for member in members:
        stated = controller_member(member)
        if (memory := stated["memory"]) and "unit" in memory:
            units |= {None if memory["levels"] else memory["unit"]}
        fields.append(_member_fields(stated, member))
    if len(units) > 1:
        raise ModelError("the policies of the lottery use different cost units: write each alone")
    tables, rows, largest = list[str](), list[str](), 0
    upto = np.minimum(np.cumsum(lottery.weights), 1.0)
    for k, (member_fields, share) in enumerate(zip(fields, upto.tolist(), strict=True)):
        entries = [repr(share)]
        for key, value in member_fields.items():
            if isinstance(value, int):
                entries.append(str(value))
                continue
            table, entry = np.asarray(value), f"{name}_{key}_{k}"
            largest = max(largest, int(np.abs(table).max())) if key not in _OTHERS else largest
            tables.append(_c_table(entry, _OTHERS.get(key, f"{name}_code"), table))
            entries.append(entry)
        rows.append(f"    {{{', '.join(entries)}}},")
    code_type = next(kind for kind, most in _KINDS.items() if largest <= most)
    states = (f"   {k}: {state!a}".replace("*/", "* /") for k, state in enumerate(model.states))
    actions = ", ".join(_c_string(str(action)) for action in model.action_names)
    template = Template(Path(__file__).with_name("policy.h").read_text("utf-8"))
    text = template.substitute(
        name=name,
        guard=f"{name.upper()}_H",
        model=fingerprint(model),
        states="\n".join(states),
        n_states=model.n_states,
        n_members=len(members),
        unit=repr(next(filter(None, units), 1.0)),
        actions=actions or "0",
        code=code_type,
        drawn=_DRAWN,
        tables="\n".join(tables),
        members="\n".join(rows),
    )
    write_text(path, [text])


def _member_fields(stated: Mapping[str, Any], policy: Policy) -> dict[str, Any]:
    """Return the fields of the C struct of a lottery's member, except for its weight.

    Args:
        stated: the member as a controller's file describes it.
        policy: the member.

    Returns:
        Name of each field -> a number, or the list of numbers of a table.

    Raises:
        ModelError: the struct does not support the member's memory.
    """
    memory, decision = stated["memory"], stated["decision"]
    cap = 0 if memory is None else memory.get("cap", -1)
    tails, drawn = decision[cap:], any(type(one) is list for row in decision for one in row)
    if cap < 0 or (drawn and memory):
        raise ModelError(f"no C header of a {type(policy).__name__}: use write_controller")
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
    """Return a text as a C string literal in UTF-8, with octal escapes for unusual bytes."""
    plain = (chr(b) if chr(b).isalnum() or chr(b) in " _-+,.:()" else "" for b in range(128))
    known = dict(enumerate(plain))
    return '"' + "".join(known.get(b) or f"\\{b:03o}" for b in text.encode()) + '"'


_A_LINE = 24  # numbers


def _c_table(name: str, kind: str, values: IntArray | FloatArray) -> str:
    words = [repr(value) for value in values.ravel().tolist()]
    lines = (words[k : k + _A_LINE] for k in range(0, len(words), _A_LINE))
    body = ",\n    ".join(", ".join(line) for line in lines)
    return f"static const {kind} {name}[] = {{\n    {body}}};"
