"""``ssp-lp simulate``: play a saved policy, in its model or in its environment."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable, Mapping
from typing import Any

from formulations.command_line.models import Setting, setting_of
from formulations.command_line.tables import as_json
from formulations.mcmp import MCMP
from ssp_lp import simulate
from ssp_lp.analysis.estimate import Estimate
from ssp_lp.io import load_policy, rollout


def run(asked: Namespace) -> Iterable[str]:
    """What is printed."""
    setting = setting_of(asked)
    told = (_in_model if setting.environment is None else _in_environment)(asked, setting)
    if asked.json:
        return as_json({name: _plain(value) for name, value in told.items()})
    return [f"{name.replace('_', ' '):<20} {_in_words(value)}" for name, value in told.items()]


def _in_model(asked: Namespace, setting: Setting) -> dict[str, Any]:
    report = simulate(
        load_policy(asked.policy, setting.model),
        MCMP(setting.model, setting.start, failure_budget=1.0),
        episodes=asked.episodes,
        rng=asked.seed,
        max_steps=asked.max_steps,
        confidence=asked.confidence,
    )
    goal = report.goal_probability
    failure = Estimate(1.0 - goal.value, 1.0 - goal.high, 1.0 - goal.low, goal.confidence)
    return {
        "episodes": report.episodes,
        "ends": report.ends,
        "failure_probability": failure,
        "cost_given_success": report.conditional_cost,
        "cost_until_failure": report.expected_cost,
        "mean_steps": report.mean_steps,
    }


def _in_environment(asked: Namespace, setting: Setting) -> dict[str, Any]:
    report = rollout(
        setting.environment,
        load_policy(asked.policy, setting.model),
        episodes=asked.episodes,
        seed=asked.seed,
        max_steps=asked.max_steps,
        confidence=asked.confidence,
    )
    ends = {name: getattr(report, name) for name in ("goal", "failed", "gave_up", "truncated")}
    return {
        "episodes": report.episodes,
        "ends": ends,
        "failure_probability": report.failure_probability,
        "cost_given_success": report.conditional_cost,
        "mean_steps": report.mean_steps,
    }


def _plain(value: Any) -> Any:
    return value._asdict() if isinstance(value, Estimate) else value


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {count:,}" for name, count in value.items() if count)
    return f"{value}" if isinstance(value, Estimate) else f"{value:,.6g}"
