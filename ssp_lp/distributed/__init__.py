"""Models whose rows lie with several processes, perhaps on several machines: extra ``distributed``."""

from ssp_lp.distributed.part import StateRows as StateRows
from ssp_lp.distributed.partitioned_model import (
    Measured as Measured,
    PartitionedModel as PartitionedModel,
    PartitionedSolution as PartitionedSolution,
)
from ssp_lp.distributed.policy import PartitionedPolicy as PartitionedPolicy

__all__ = ["Measured", "PartitionedModel", "PartitionedPolicy", "PartitionedSolution", "StateRows"]
