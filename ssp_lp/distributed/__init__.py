"""Models whose rows are distributed over processes or machines: the extra ``distributed``."""

from ssp_lp.distributed.partitioned_model import (
    Measured as Measured,
    PartitionedModel as PartitionedModel,
    PartitionedSolution as PartitionedSolution,
)
from ssp_lp.distributed.policy import PartitionedPolicy as PartitionedPolicy
from ssp_lp.model.state_rows import StateRows as StateRows
