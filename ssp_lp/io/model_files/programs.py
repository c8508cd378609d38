"""Models as programs of one variable, the number of the state: PRISM's language, and JANI."""

from __future__ import annotations

import json
import re
from collections.abc import Hashable, Iterator
from typing import Any

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.raw_model import Exported, FilePath, exported, write_text
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained

_KEYWORD = re.compile(
    "A|bool|clock|const|ctmc|C|double|dtmc|E|endinit|endinvariant|endmodule|endobservables|"
    "endrewards|endsystem|false|formula|filter|func|F|global|G|init|invariant|I|int|label|max|mdp|"
    "min|module|X|nondeterministic|observables?|of|Pmax|Pmin|P|pomdp|popta|probabilistic|prob|pta|"
    "rate|rewards|Rmax|Rmin|R|S|stochastic|system|true|U|W"
)
_OWN_LABELS = ("init", "deadlock")  # which PRISM gives a meaning of its own
_PER_LINE = 40  # states of a label on one line of PRISM's


@explained
def write_prism_program(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a program in PRISM's language, with a command for each state and action.

    States, costs and labels are those of :func:`ssp_lp.io.write_drn`: the variable ``s`` is the
    number of the state, each cost a reward structure of actions, and what is no word of PRISM's
    in the name of an action becomes an underscore.

    Args:
        model: the model.
        path: the file, plain or gzip by its ending.
        start: the initial state.

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    write_text(path, _prism_lines(exported(model, start)))


@explained
def write_jani(model: SSP, path: FilePath, *, start: Hashable) -> None:
    """Write a model as a JANI program with an edge for each state and action.

    States, costs and labels are those of :func:`ssp_lp.io.write_drn`: the variable ``s`` is the
    number of the state, each cost a transient variable that edges assign, and each label one that
    is true in its states.

    Args:
        model: the model.
        path: the file, plain or gzip by its ending.
        start: the initial state.

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    program = _jani_program(exported(model, start))
    write_text(path, [json.dumps(program, ensure_ascii=False)])


def _program_words(process: Exported) -> list[str]:
    """The names of actions as identifiers, [pairs]; distinct within each state."""
    plain = {name: re.sub(r"\W", "_", name, flags=re.ASCII) for name in process.actions}
    words: dict[str, str] = {}
    for name, word in plain.items():
        word = f"_{word}" if word[:1].isdigit() or _KEYWORD.fullmatch(word) else word
        while word in words.values():
            word += "_"
        words[name] = word
    return [words[name] for name in process.actions]


def _state_sets(process: Exported) -> Iterator[tuple[str, IntArray]]:
    """The labels that a program states itself, with their states."""
    for name, members in process.labels.items():
        if name not in _OWN_LABELS:
            yield name, np.asarray(members)


def _prism_lines(process: Exported) -> Iterator[str]:
    """The text of a program in PRISM's language."""
    words, (begin,) = _program_words(process), process.labels["init"].tolist()
    last = process.pair_offsets.size - 2
    yield f"mdp\n\nmodule states\n  s : [0..{last}] init {begin};\n"
    for state, _, pair, moves in process.pairs():
        ends = " + ".join(f"{chance!r}:(s'={successor})" for successor, chance in moves)
        yield f"  [{words[pair]}] s={state} -> {ends};\n"
    yield "endmodule\n"
    for k, name in enumerate(process.cost_names):
        yield f'\nrewards "{name}"\n'
        for state, _, pair, _ in process.pairs():
            if paid := float(process.costs[pair, k]):
                yield f"  [{words[pair]}] s={state} : {paid!r};\n"
        yield "endrewards\n"
    for name, members in _state_sets(process):
        if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) or _KEYWORD.fullmatch(name):
            raise ModelError(f"the label {name!r} is no word of PRISM's: give it another name")
        holds = [f"s={state}" for state in members.tolist()]
        rows = [" | ".join(holds[k : k + _PER_LINE]) for k in range(0, len(holds), _PER_LINE)]
        yield f'\nlabel "{name}" = ' + ("\n  | ".join(rows) or "false") + ";\n"


def _jani_program(process: Exported) -> dict[str, Any]:
    """The document of a program in JANI."""
    words, (begin,) = _program_words(process), process.labels["init"].tolist()
    last = process.pair_offsets.size - 2

    labels = {name: members.tolist() for name, members in _state_sets(process)}
    marks = [{"ref": name, "value": _among(members)} for name, members in labels.items()]
    transient = [
        *(
            {"name": n, "type": "real", "transient": True, "initial-value": 0}
            for n in process.cost_names
        ),
        *({"name": n, "type": "bool", "transient": True, "initial-value": False} for n in labels),
    ]
    return {
        "jani-version": 1,
        "name": "states",
        "type": "mdp",
        "actions": [{"name": word} for word in dict.fromkeys(words)],
        "variables": [
            {
                "name": "s",
                "type": {"kind": "bounded", "base": "int", "lower-bound": 0, "upper-bound": last},
                "initial-value": begin,
            },
            *transient,
        ],
        "automata": [
            {
                "name": "states",
                "locations": [{"name": "there", "transient-values": marks}],
                "initial-locations": ["there"],
                "edges": _jani_edges(process, words),
            }
        ],
        "system": {
            "elements": [{"automaton": "states"}],
            "syncs": [{"synchronise": [word], "result": word} for word in dict.fromkeys(words)],
        },
        "properties": [],
    }


def _jani_edges(process: Exported, words: list[str]) -> list[dict[str, Any]]:
    """An edge of JANI's for each state and action."""
    return [
        {
            "location": "there",
            "action": words[pair],
            "guard": {"exp": _among([state])},
            "destinations": [
                {
                    "location": "there",
                    "probability": {"exp": chance},
                    "assignments": [
                        {"ref": "s", "value": successor},
                        *(
                            {"ref": name, "value": paid}
                            for name, paid in zip(
                                process.cost_names, process.costs[pair].tolist(), strict=True
                            )
                            if paid
                        ),
                    ],
                }
                for successor, chance in moves
            ],
        }
        for state, _, pair, moves in process.pairs()
    ]


def _among(states: list[int]) -> Any:
    """The condition of being in one of some states, halved until it is one."""
    if len(states) <= 1:
        return {"op": "=", "left": "s", "right": states[0]} if states else False
    half = len(states) // 2
    return {"op": "∨", "left": _among(states[:half]), "right": _among(states[half:])}
