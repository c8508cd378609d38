"""The ranks of a communicator, and the exchange of values of states between ranks.

Every rank runs the same program on its own rows. Joint decisions depend only on numbers that are
equal on all ranks: sums or maxima over all ranks, and values computed from them.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.cargo import Store
from ssp_lp.errors import ModelError, SSPError, in_short, optional_module
from ssp_lp.model.graph import Graph, drain, nearer_pairs, pairs_into, reaching_states

EXTRA = "distributed"

_Made = TypeVar("_Made")


class Ranks:
    """The ranks (processes) of MPI's world, which run the same program, with PETSc on them."""

    def __init__(self) -> None:
        """Start PETSc, if it is not running, with the options of the command line.

        Raises:
            MissingDependencyError: petsc4py or mpi4py is not installed.
        """
        self.mpi = optional_module("mpi4py.MPI", EXTRA)
        optional_module("petsc4py", EXTRA).init(sys.argv)
        self.petsc = optional_module("petsc4py.PETSc", EXTRA)
        self.comm = self.mpi.COMM_WORLD

    def __reduce__(self) -> Any:
        """Refuse to be pickled: objects that span several ranks have no meaning in another process.

        Raises:
            ModelError: always.
        """
        raise ModelError("objects of several ranks cannot be pickled: use answer.policy.save()")

    def caught(self, make: Callable[[], Any]) -> Any:
        """Run a function and return its result; convert its error to an error of the library."""
        try:
            return make()
        except SSPError as error:
            return error
        except Exception as error:
            return ModelError(f"rank {self.comm.rank} failed: {type(error).__name__}: {error}")

    def agreed(self, make: Callable[[], _Made]) -> _Made:
        """Run a function on every rank; if it fails on one, all ranks raise an error.

        Raises:
            SSPError: the rank's own error, or the error of the first rank that failed; other
                exceptions become a ModelError with their text.
        """
        made = self.caught(make)
        failed = isinstance(made, SSPError)
        for packed in self.comm.allgather(Store().pack(made) if failed else None):
            if packed is not None:
                raise made if failed else Store().unpack(packed)
        return made  # type: ignore[no-any-return]

    def check_same(self, what: str, values: Mapping[str, Any]) -> None:
        """Check that every rank has the same values.

        Args:
            what: name of the compared values, for the message.
            values: this rank's values by name, which can be sent and compared.

        Raises:
            ModelError: values differ; every rank raises it, naming two ranks and their values.
        """
        every = self.comm.allgather(values)
        for rank, other in enumerate(every):
            for name in values:
                if (one := every[0][name]) != (two := other[name]):
                    raise ModelError(f"the ranks state different {what}: {name} is {in_short(one)} "
                                     f"on rank 0, {in_short(two)} on rank {rank}")  # fmt: skip

    def together(self, make: Callable[[], _Made]) -> _Made:
        """Run a function on all ranks jointly; an unexpected error on one rank ends all of them.

        Errors of the library are raised by all ranks at the same point. Any other error, or an
        interrupt, may occur on one rank alone. The other ranks would then wait for its messages for
        ever.
        """
        try:
            return make()
        except SSPError:
            raise
        except BaseException:
            if self.comm.size > 1:
                traceback.print_exc(file=sys.stderr)
                self.comm.Abort(1)
            raise

    def total(self, own: npt.ArrayLike) -> Any:
        """Return the sum of each number over all ranks; every rank gets the result."""
        return self._reduced(own, self.mpi.SUM)

    def greatest(self, own: npt.ArrayLike) -> Any:
        """Return the maximum of each number over all ranks; every rank gets the result."""
        return self._reduced(own, self.mpi.MAX)

    def any(self, own: Any) -> bool:
        """Return whether any entry is true on any rank."""
        return bool(self.greatest(float(np.any(own))) > 0.0)

    def _reduced(self, own: npt.ArrayLike, operation: Any) -> Any:
        """Combine each number over all ranks by an operation of MPI."""
        found = np.array(own, dtype=np.float64)
        self.comm.Allreduce(self.mpi.IN_PLACE, found, op=operation)
        return found


class Halo:
    """A rank's own states, and the ghosts: states of other ranks whose values it needs.

    Arrays over known states have the own states first, then the ghosts. All ranks must create their
    halos, and exchange values, at the same time.
    """

    def __init__(self, ranks: Ranks, n_own: int, ghosts: IntArray) -> None:
        """Create PETSc's vector over own states and ghosts; all ranks must call this.

        Args:
            ranks: all ranks.
            n_own: number of own states; states are numbered from rank to rank.
            ghosts: indices of states of other ranks, in the whole model.
        """
        self.ranks, self.n_own, self.ghosts = ranks, n_own, ghosts
        ends = np.cumsum(ranks.comm.allgather(n_own))
        self.end, self.n_all = int(ends[ranks.comm.rank]), int(ends[-1])
        self.first, self.size = self.end - n_own, n_own + len(ghosts)
        index, sizes = ghosts.astype(ranks.petsc.IntType), (n_own, self.n_all)
        self._vector = ranks.petsc.Vec().createGhost(index, sizes, comm=ranks.comm)

    def with_ghosts(self, own: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return values of all known states, with the ghosts' values received from their owners.

        Args:
            own: values of own states; further entries are overwritten, [own states or more].
        """
        with self._vector.localForm() as local:
            local.array[: self.n_own] = own[: self.n_own]
        self._vector.ghostUpdate()
        with self._vector.localForm() as local:
            return np.asarray(local.array.astype(own.dtype))

    @cached_property
    def numbers(self) -> IntArray:
        """Index in the whole model of each known state, [known states]."""
        return np.append(np.arange(self.first, self.end), self.ghosts)

    def fixed_point(self, sweep: Callable[[BoolArray], BoolArray], mask: BoolArray) -> BoolArray:
        """Repeat a search on each rank until no ghost's mark changes on any rank.

        Args:
            sweep: completes a mask by the rank's own rows, given the ghosts' marks, [known states].
            mask: the first mask, [known states].
        """
        while True:
            found = self.with_ghosts(sweep(mask))
            if not self.ranks.any(found[self.n_own :] != mask[self.n_own :]):
                return found
            mask = found

    def reaching(self, graph: Graph, ends: BoolArray) -> BoolArray:
        """Return the states from which an end can be reached, [known states]."""
        return self.fixed_point(lambda mask: reaching_states(graph, mask), self.with_ghosts(ends))

    def staying(self, graph: Graph, usable: BoolArray, outside: BoolArray) -> BoolArray:
        """Return the greatest set of states in which a policy can stay for ever, [known states].

        Each of its states has no pairs, or a usable pair that leads only to states of the set.

        Args:
            graph: the known states, and the pairs of the own states.
            usable: whether a pair may be taken, [pairs].
            outside: whether a state is excluded, [known states].
        """
        acting = np.diff(graph.pair_offsets) > 0

        def sweep(closed: BoolArray) -> BoolArray:
            pairs = usable & ~closed[graph.pair_state]
            counts = np.bincount(graph.pair_state[pairs], minlength=graph.n_states)
            closed = closed | (acting & (counts == 0))
            drain(graph, pairs, counts, closed.nonzero()[0])
            return np.asarray(closed | (acting & (counts == 0)))

        return ~self.fixed_point(sweep, self.with_ghosts(outside))

    def approaching(self, graph: Graph, target_pairs: BoolArray) -> IntArray:
        """Return a pair of each own state that may lead nearer to a leaving pair; -1: no such pair.

        Args:
            graph: the known states, and the pairs of the own states.
            target_pairs: whether a pair leaves the process, [pairs].
        """
        choice = np.full(graph.n_states, -1)

        def sweep(reached: BoolArray) -> BoolArray:
            nearer = nearer_pairs(graph, target_pairs | pairs_into(graph, reached))
            choice[:] = np.where(choice < 0, nearer, choice)
            return reached | (choice >= 0)

        self.fixed_point(sweep, np.zeros(graph.n_states, dtype=np.bool_))
        return choice[: self.n_own].astype(np.int32)
