"""Formulations: one criterion of the literature per file, all solved by ``ssp_lp.solve``."""

from formulations.mcmp import MCMP
from formulations.s3p import S3P

__all__ = ["MCMP", "S3P"]
