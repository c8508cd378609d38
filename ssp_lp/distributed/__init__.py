"""Pricing by several processes, perhaps on several machines: the extra ``distributed``."""

from ssp_lp.distributed.petsc import Petsc as Petsc

__all__ = ["Petsc"]
