"""``ssp-lp info``: what a model holds, and how little can fail in it."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable

from formulations.command_line.models import Setting, setting_of
from formulations.command_line.tables import as_json
from formulations.maxprob import MaxProb
from ssp_lp import solve
from ssp_lp.formulation import attention_labels, dead_end_labels


def run(asked: Namespace) -> Iterable[str]:
    """What is printed."""
    facts = _facts(setting_of(asked))
    if asked.json:
        return as_json(facts)
    return [f"{name:<17} {value:,}" for name, value in facts.items()]


def _facts(setting: Setting) -> dict[str, float]:
    """Sizes of a model, and the least failure from the start, if there is one."""
    model = setting.model
    facts: dict[str, float] = {
        "states": model.n_states,
        "pairs": model.n_pairs,
        "outcomes": model.n_outcomes,
        "goals": int(model.goal_mask.sum()),
        "dead-ends": len(dead_end_labels(model)),
        "attention states": len(attention_labels(model)),
    }
    if setting.stated_start is not None:
        facts["least failure"] = solve(MaxProb(model, setting.start)).failure_probability
    return facts
