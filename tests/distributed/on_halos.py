"""Values of other ranks' states, exchanged, beside those that every rank knows: for mpiexec."""

import numpy as np
from mpi4py import MPI

from ssp_lp.distributed.halo import Halo

COMM = MPI.COMM_WORLD


def check_exchange(bounds, columns):
    """Each rank gets what the owners of its ghosts have, whatever its columns are."""
    own = slice(*bounds[COMM.rank : COMM.rank + 2].tolist())
    halo, mine = Halo(COMM, bounds, columns), np.arange(own.start, own.stop)
    outside = sorted(set(columns.tolist()) - set(mine.tolist()))
    assert halo.ghosts.tolist() == outside
    known = np.append(mine, halo.ghosts)
    assert np.array_equal(known[halo.places(columns)], columns)
    everywhere = np.random.default_rng(5).random((bounds[-1], 2, 3))
    for values in (everywhere, everywhere[:, 0, 0].copy(), everywhere[:, 0] > 0.5):
        for _ in range(2):
            assert np.array_equal(halo.filled(values[own]), values[known])
    sent = COMM.allreduce(halo.bytes)
    masses = np.random.default_rng(COMM.rank).random((halo.size, 2))
    every = np.zeros((bounds[-1], 2))
    every[known] = masses
    halo.gather(masses)
    assert np.allclose(masses[: halo.n_own], COMM.allreduce(every)[own], rtol=1e-15)
    assert not masses[halo.n_own :].any()
    assert sent == COMM.allreduce(len(outside)) * 2 * (6 * 8 + 8 + 3)


if __name__ == "__main__":
    rng = np.random.default_rng(COMM.rank)
    for n_states in (0, 1, 7, 50):
        cuts = np.sort(np.random.default_rng(n_states).integers(0, n_states + 1, COMM.size - 1))
        bounds = np.concatenate([[0], cuts, [n_states]])
        for some in (0, 1, 5, 40):
            columns = rng.integers(0, max(n_states, 1), some if n_states else 0)
            check_exchange(bounds, columns.astype(np.int32))
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
