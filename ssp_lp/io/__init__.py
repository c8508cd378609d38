"""Files, arrays and environments: models, policies and solutions in other formats."""

from ssp_lp.io.any_format import read_any as read_any, write_any as write_any
from ssp_lp.io.archives import (
    fingerprint as fingerprint,
    load_model as load_model,
    load_policy as load_policy,
    load_solution as load_solution,
    save_model as save_model,
    save_policy as save_policy,
    save_solution as save_solution,
)
from ssp_lp.io.c_header import write_c_header as write_c_header
from ssp_lp.io.controller import Controller as Controller
from ssp_lp.io.controller_file import write_controller as write_controller
from ssp_lp.io.gymnasium_worlds import (
    GymnasiumWorld as GymnasiumWorld,
    RolloutReport as RolloutReport,
    StepLimitWarning as StepLimitWarning,
    continuous_from_gymnasium as continuous_from_gymnasium,
    from_gymnasium as from_gymnasium,
    rollout as rollout,
)
from ssp_lp.io.matrices import from_matrices as from_matrices
from ssp_lp.io.model_files.drn import read_drn as read_drn, write_drn as write_drn
from ssp_lp.io.model_files.raw_model import ModelFile as ModelFile
from ssp_lp.io.model_files.umb import read_umb as read_umb, write_umb as write_umb
from ssp_lp.io.storm_models import from_stormpy as from_stormpy, read_with_storm as read_with_storm

__all__ = sorted(name for name, value in globals().items() if callable(value) and name[0] != "_")
