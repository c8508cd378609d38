"""A policy as one header of C99: tables, and a function that looks actions up, without allocation.

States and actions are numbers, in the order of the model. What an episode has to remember beside
the total that was paid is in a small struct: which member of a lottery plays it, which of its tails
it follows beyond the cap, whether it has given up, and the level to which a total was rounded.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.archives import fingerprint
from ssp_lp.io.model_files.raw_model import FilePath, write_text
from ssp_lp.model.arguments import explained
from ssp_lp.policies import (
    CompletePolicy,
    CostAwarePolicy,
    DeterministicPolicy,
    MixedPolicy,
    Policy,
    StochasticPolicy,
)
from ssp_lp.policies.policy import as_lottery

_NEVER = 1e308
"""A total that no episode comes to, in place of an infinite one."""

_DRAWN = -3
"""This code and those below it are numbers of decisions that are drawn."""

_OTHERS = {"threshold": "double", "levels": "double", "share": "double", "offsets": "int",
           "ends": "unsigned char"}  # fmt: skip
"""Types of the tables that hold no codes."""

_KINDS = {"signed char": 127, "short": 32_767, "int": 2**31 - 1}

_CODE = """
typedef struct { int member, tail, over, level; double paid; } NAME_episode;
#define NAME_BEGIN {-1, -1, -1, 0, 0.0}

/* The number of the action in a state: -1 to give up, -2 where the policy has no decision.

   episode: its memory, NAME_BEGIN where it begins.
   state: its number, 0 .. NAME_states - 1.
   total: paid so far, in multiples of NAME_unit.
   uniform: drawn afresh from [0, 1) at each call; the first one draws the lottery, too. */
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
    """Write a policy as a header of C99, with tables and one function, for a machine to act by.

    The function ``policy_action(&episode, state, total, uniform)`` is told the number of the state
    in the model, the total paid so far and a uniform random number, and answers with the number of
    an action; the header says the rest. It allocates nothing and calls nothing.

    Args:
        policy: stationary, cost-aware, acting everywhere (``Solution.policy_everywhere``), or a
            lottery over these.
        path: of the file, ``policy.h``.
        name: what the names in it begin with.

    Raises:
        ModelError: the policy is of another class, its members count costs in different units, or
            the name is none in C.
    """
    lottery = as_lottery(policy)
    model, members = lottery.model, lottery.policies
    if not (name.isascii() and name.isidentifier()):
        raise ModelError(f"name must be a name in C, not {name!r}")
    plans = [m.inner if isinstance(m, CompletePolicy) else m for m in members]
    units = {
        plan.unit for plan in plans if isinstance(plan, CostAwarePolicy) and plan.levels is None
    }
    if len(units) > 1 or (
        units and any(getattr(plan, "levels", None) is not None for plan in plans)
    ):
        raise ModelError("the members of the lottery count costs in different units")
    tables, rows, largest = list[str](), list[str](), 0
    upto = np.minimum(np.cumsum(lottery.weights), 1.0)
    for k, (member, share) in enumerate(zip(members, upto.tolist(), strict=True)):
        fields = _member_fields(member)
        told = {key: value for key, value in fields.items() if isinstance(value, np.ndarray)}
        for key, value in told.items():
            largest = max(largest, int(np.abs(value).max())) if key not in _OTHERS else largest
            tables.append(_c_table(f"{name}_{key}_{k}", _OTHERS.get(key, f"{name}_code"), value))
        entries = (f"{name}_{key}_{k}" if key in told else str(v) for key, v in fields.items())
        rows.append(f"    {{{share!r}, {', '.join(entries)}}},")
    code_type = next(kind for kind, most in _KINDS.items() if largest <= most)
    words = {"NAME": name, "DRAWN": str(_DRAWN)}
    type_, code = _MEMBER, _CODE
    for word, meant in words.items():
        type_, code = type_.replace(word, meant), code.replace(word, meant)
    states = (f"   {k}: {_c_comment(state)}" for k, state in enumerate(model.states))
    actions = ", ".join(_c_string(str(action)) for action in model.action_names)
    lines = [
        f"/* A policy of ssp-lp, made for the model {fingerprint(model)}.",
        "   States:",
        *states,
        "*/",
        f"#ifndef {name.upper()}_H",
        f"#define {name.upper()}_H",
        f"enum {{ {name}_states = {model.n_states}, {name}_count = {len(members)} }};",
        f"static const double {name}_unit = {float(next(iter(units), 1.0))!r};",
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


def _member_fields(policy: Policy) -> dict[str, object]:
    """The fields of a member's struct but the first, by name; arrays are tables of their own."""
    plan = policy.inner if isinstance(policy, CompletePolicy) else policy
    model, states = plan.model, np.arange(plan.model.n_states)

    def action_codes(pairs: IntArray) -> IntArray:
        """The numbers of the pairs' actions; codes stay."""
        action = np.append(model.pair_action, 0).astype(np.int64)
        return np.where(pairs < 0, pairs, action[np.maximum(pairs, 0)])

    fields: dict[str, object] = dict.fromkeys(
        ("layers", "tails", "decision", "tail", "threshold", "levels", "offsets", "action", "share",
         "ends", "otherwise", "afterwards"), 0)  # fmt: skip
    fields |= {"tails": 1, "threshold": np.full(model.n_states, _NEVER)}
    if isinstance(plan, CostAwarePolicy):
        pairs = np.where(plan.decision < 0, plan.decision, model.pair_offsets[:-1] + plan.decision)
        fields |= {"layers": plan.cap, "tails": len(plan.tails)}
        fields["tail"] = action_codes(plan.tails)
        fields["threshold"] = np.clip(plan.tail_threshold, -1.0, _NEVER)
        if plan.cap:
            fields["decision"] = action_codes(pairs)
        if plan.levels is not None:
            fields["levels"] = plan.levels
    elif isinstance(plan, DeterministicPolicy) or (
        isinstance(plan, StochasticPolicy) and plan.carrier is None
    ):
        found = plan.branches(states, np.zeros_like(states))
        codes = action_codes(found.pair)
        offsets = offsets_of(np.bincount(found.situation, minlength=model.n_states))
        fields["tail"] = codes[offsets[:-1]]
        drawn = np.diff(offsets) > 1
        if drawn.any():
            shares = np.cumsum(found.probability)
            shares -= np.repeat(np.append(0.0, shares)[offsets[:-1]], np.diff(offsets))
            fields |= {"offsets": offsets, "action": codes, "share": shares}
            fields["tail"] = np.where(drawn, _DRAWN - states, codes[offsets[:-1]])
    else:
        raise ModelError(f"a header of C cannot hold a {type(plan).__name__}")
    if isinstance(policy, CompletePolicy):
        fields["ends"] = plan.ended.astype(np.uint8)
        for name in ("otherwise", "afterwards"):
            fields[name] = action_codes(getattr(policy, name))
    return fields


def _c_comment(label: object) -> str:
    """A label as part of a comment of C."""
    return repr(label).replace("*/", "* /").encode("ascii", "backslashreplace").decode()


def _c_string(text: str) -> str:
    """A text as a literal of C, the bytes of its UTF-8 that are not plain in octal."""
    plain = (chr(b) if chr(b).isalnum() or chr(b) in " _-+,.:()" else "" for b in range(128))
    known = dict(enumerate(plain))
    return '"' + "".join(known.get(b) or f"\\{b:03o}" for b in text.encode()) + '"'


_A_LINE = 24  # numbers


def _c_table(name: str, kind: str, values: IntArray | FloatArray) -> str:
    """A table as C has it."""
    words = [repr(value) for value in values.ravel().tolist()]
    lines = (words[k : k + _A_LINE] for k in range(0, len(words), _A_LINE))
    body = ",\n    ".join(", ".join(line) for line in lines)
    return f"static const {kind} {name}[] = {{\n    {body}}};"
