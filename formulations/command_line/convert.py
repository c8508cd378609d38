"""``ssp-lp convert``: a model from one format into another."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable

from formulations.command_line.models import setting_of
from ssp_lp.io import write_any
from ssp_lp.io.model_files.json_model import json_text


def run(asked: Namespace) -> Iterable[str]:
    """What is printed: the model where the target is "-"."""
    setting = setting_of(asked)
    if asked.target == "-":
        return ["".join(json_text(setting.model, setting.stated_start)).rstrip()]
    write_any(setting.model, asked.target, setting.only_start)
    return []
