"""What every generator returns: a model together with the state in which it starts."""

from collections.abc import Hashable
from typing import NamedTuple

from ssp_lp import SSP


class Domain(NamedTuple):
    """A model and its start; unpacks as ``model, start = river(4, 4)``."""

    model: SSP
    start: Hashable
