"""Models, policies and solutions in and out: files, arrays, environments of others."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ssp_lp.io.any_format import read_any, write_any
    from ssp_lp.io.controller import Controller
    from ssp_lp.io.controller_files import write_controller
    from ssp_lp.io.dot import write_dot
    from ssp_lp.io.gym.from_gymnasium import GymnasiumWorld, from_gymnasium
    from ssp_lp.io.gym.rollout import RolloutReport, StepLimitWarning, rollout
    from ssp_lp.io.matrices import from_matrices
    from ssp_lp.io.model_archive import load_model, save_model
    from ssp_lp.io.model_files.drn_reader import read_drn
    from ssp_lp.io.model_files.drn_writer import write_drn
    from ssp_lp.io.model_files.prism_reader import read_prism
    from ssp_lp.io.model_files.prism_writer import write_prism
    from ssp_lp.io.model_files.raw_model import ModelFile
    from ssp_lp.io.model_fingerprint import fingerprint
    from ssp_lp.io.policy_files import load_policy, save_policy
    from ssp_lp.io.solution_files import load_solution, save_solution
    from ssp_lp.io.storm.from_storm import from_stormpy
    from ssp_lp.io.storm.induced_chain import induced_chain
    from ssp_lp.io.storm.programs import read_with_storm
    from ssp_lp.io.storm.schedulers import write_scheduler
    from ssp_lp.io.storm.to_storm import to_stormpy, write_umb
    from ssp_lp.io.tables import policy_table, to_frame

__all__ = [
    "Controller",
    "GymnasiumWorld",
    "ModelFile",
    "RolloutReport",
    "StepLimitWarning",
    "fingerprint",
    "from_gymnasium",
    "from_matrices",
    "from_stormpy",
    "induced_chain",
    "load_model",
    "load_policy",
    "load_solution",
    "policy_table",
    "read_any",
    "read_drn",
    "read_prism",
    "read_with_storm",
    "rollout",
    "save_model",
    "save_policy",
    "save_solution",
    "to_frame",
    "to_stormpy",
    "write_any",
    "write_controller",
    "write_dot",
    "write_drn",
    "write_prism",
    "write_scheduler",
    "write_umb",
]

_ON_DEMAND = {
    "from_stormpy": "ssp_lp.io.storm.from_storm",
    "to_stormpy": "ssp_lp.io.storm.to_storm",
    "write_umb": "ssp_lp.io.storm.to_storm",
    "read_with_storm": "ssp_lp.io.storm.programs",
    "write_scheduler": "ssp_lp.io.storm.schedulers",
    "induced_chain": "ssp_lp.io.storm.induced_chain",
    "read_any": "ssp_lp.io.any_format",
    "write_any": "ssp_lp.io.any_format",
    "Controller": "ssp_lp.io.controller",
    "write_controller": "ssp_lp.io.controller_files",
    "write_dot": "ssp_lp.io.dot",
    "GymnasiumWorld": "ssp_lp.io.gym.from_gymnasium",
    "from_gymnasium": "ssp_lp.io.gym.from_gymnasium",
    "RolloutReport": "ssp_lp.io.gym.rollout",
    "StepLimitWarning": "ssp_lp.io.gym.rollout",
    "rollout": "ssp_lp.io.gym.rollout",
    "fingerprint": "ssp_lp.io.model_fingerprint",
    "load_policy": "ssp_lp.io.policy_files",
    "save_policy": "ssp_lp.io.policy_files",
    "policy_table": "ssp_lp.io.tables",
    "to_frame": "ssp_lp.io.tables",
    "load_solution": "ssp_lp.io.solution_files",
    "save_solution": "ssp_lp.io.solution_files",
    "ModelFile": "ssp_lp.io.model_files.raw_model",
    "from_matrices": "ssp_lp.io.matrices",
    "load_model": "ssp_lp.io.model_archive",
    "save_model": "ssp_lp.io.model_archive",
    "read_drn": "ssp_lp.io.model_files.drn_reader",
    "write_drn": "ssp_lp.io.model_files.drn_writer",
    "read_prism": "ssp_lp.io.model_files.prism_reader",
    "write_prism": "ssp_lp.io.model_files.prism_writer",
}


def __getattr__(name: str) -> object:
    """Import what is first asked for: nothing here is needed by those who write no files."""
    if name not in _ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_ON_DEMAND[name]), name)
    globals()[name] = found
    return found
