"""Models, policies and solutions in and out: files, arrays, environments of others."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssp_lp.io.drn import read_drn, write_drn
    from ssp_lp.io.matrices import from_matrices
    from ssp_lp.io.model_archive import load_model, save_model
    from ssp_lp.io.model_files.model_file import ModelFile
    from ssp_lp.io.prism import read_prism, write_prism

__all__ = [
    "ModelFile",
    "from_matrices",
    "load_model",
    "read_drn",
    "read_prism",
    "save_model",
    "write_drn",
    "write_prism",
]

_ON_DEMAND = {
    "ModelFile": "ssp_lp.io.model_files.model_file",
    "from_matrices": "ssp_lp.io.matrices",
    "load_model": "ssp_lp.io.model_archive",
    "save_model": "ssp_lp.io.model_archive",
    "read_drn": "ssp_lp.io.drn",
    "write_drn": "ssp_lp.io.drn",
    "read_prism": "ssp_lp.io.prism",
    "write_prism": "ssp_lp.io.prism",
}


def __getattr__(name: str) -> object:
    """Import a format when it is first asked for."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = found
    return found
