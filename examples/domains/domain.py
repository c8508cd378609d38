"""The result of every generator: a model with its start state."""

from collections.abc import Hashable
from typing import NamedTuple

from ssp_lp import SSP


class Domain(NamedTuple):
    """A model and its start; unpacks as ``model, start = river(4, 4)``."""

    model: SSP
    start: Hashable
