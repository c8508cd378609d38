"""Where randomness comes from: a generator, or the seed of one."""

from __future__ import annotations

import numpy as np

from ssp_lp.errors import ModelError

Randomness = np.random.Generator | int
"""A generator, or the seed of a new one."""


def generator_of(rng: Randomness) -> np.random.Generator:
    """The generator itself, or a new one with this seed.

    Raises:
        ModelError: neither a generator nor a whole number >= 0.
    """
    if isinstance(rng, np.random.Generator):
        return rng
    if isinstance(rng, (int, np.integer)) and not isinstance(rng, bool) and rng >= 0:
        return np.random.default_rng(int(rng))
    raise ModelError(f"rng must be a numpy.random.Generator or a seed such as 0, not {rng!r}")
