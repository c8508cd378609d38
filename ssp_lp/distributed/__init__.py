"""Pricing by several processes, perhaps on several machines: the extra ``distributed``."""

from ssp_lp.distributed.order import narrow_order as narrow_order
from ssp_lp.distributed.partitioned_model import (
    PartitionedModel as PartitionedModel,
    PartitionedSolution as PartitionedSolution,
)
from ssp_lp.distributed.partitioned_policy import PartitionedPolicy as PartitionedPolicy
from ssp_lp.distributed.petsc import Petsc as Petsc
from ssp_lp.distributed.slab import StateRows as StateRows

__all__ = [
    "PartitionedModel",
    "PartitionedPolicy",
    "PartitionedSolution",
    "Petsc",
    "StateRows",
    "narrow_order",
]
