"""``ssp-lp convert``: a model from one format into another."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterable

from formulations.command_line.models import Setting, setting_of
from ssp_lp import ModelError
from ssp_lp.io import save_model, write_drn, write_prism
from ssp_lp.io.model_files.exported import write_text
from ssp_lp.io.model_files.named_json import json_text


def run(asked: Namespace) -> Iterable[str]:
    """What is printed: the model where the target is "-"."""
    endings = [ending for ending in _WRITERS if asked.target.endswith(ending)]
    if asked.target != "-" and not endings:
        raise ModelError(f"{asked.target!r} ends in none of {', '.join(_WRITERS)}")
    setting = setting_of(asked)
    if asked.target == "-":
        return ["".join(json_text(setting.model, setting.stated_start)).rstrip()]
    _WRITERS[endings[0]](setting, asked.target)
    return []


def _only_start(setting: Setting) -> object:
    """The one state that episodes begin in, for formats that know no other."""
    start = setting.start
    return next(iter(start)) if isinstance(start, dict) and len(start) == 1 else start


_WRITERS: dict[str, Callable[[Setting, str], None]] = {
    ".json": lambda s, path: write_text(path, json_text(s.model, s.stated_start)),
    ".json.gz": lambda s, path: write_text(path, json_text(s.model, s.stated_start)),
    ".drn": lambda s, path: write_drn(s.model, path, start=_only_start(s)),
    ".drn.gz": lambda s, path: write_drn(s.model, path, start=_only_start(s)),
    ".tra": lambda s, path: write_prism(s.model, path, start=_only_start(s)),
    ".npz": lambda s, path: save_model(s.model, path),
}
