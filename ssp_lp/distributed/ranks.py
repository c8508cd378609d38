"""The ranks of PETSc: the first gives orders, the others serve, until there is an answer."""

from __future__ import annotations

import pickle
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from ssp_lp.cargo import Cargo
from ssp_lp.compiled.accelerator import without_twins
from ssp_lp.compiled.deadline import check_time, until
from ssp_lp.distributed.share import Share
from ssp_lp.errors import ModelError, SolverError, SSPError, in_short, optional_module

EXTRA = "distributed"

_Made = TypeVar("_Made")


class Ranks:
    """The ranks of PETSc's world, of which the first gives orders.

    An order is the name of what a rank does with the rows that it holds, and its arguments: those
    that all get, and those of each; what each makes of it comes back to the first.
    """

    def __init__(self, comm: Any, petsc: Any) -> None:
        """Know the ranks.

        Args:
            comm: of mpi4py.
            petsc: the module.
        """
        self.comm, self.petsc = comm, petsc
        self.share: Share | None = None
        self.held_by: object = None  # the dynamics whose rows the ranks hold
        self.chosen: object = None  # the equations that they have set up
        self.messages, self.bytes = 0, 0  # of ghosts' values, sent while rows were held

    @classmethod
    def all(cls) -> Ranks:
        """All ranks of PETSc.

        Raises:
            MissingDependencyError: petsc4py or mpi4py is not installed.
        """
        world = optional_module("mpi4py.MPI", EXTRA).COMM_WORLD
        optional_module("petsc4py", EXTRA).init([])
        return cls(world, optional_module("petsc4py.PETSc", EXTRA))

    def __reduce__(self) -> Any:
        """Refused: what lies with the ranks has no meaning in another process.

        Raises:
            ModelError: always.
        """
        raise ModelError(
            "what lies with the ranks of PETSc cannot be pickled or copied: answer.policy.save() "
            "keeps decisions, and answer.on(problem) is a Solution that can be pickled"
        )

    def agreed(self, make: Callable[[], _Made]) -> _Made:
        """What every rank makes by itself; where one cannot, all raise its error.

        Raises:
            Exception: of the rank itself, or else of the first rank that has one.
        """
        made, error = None, None
        try:
            made = make()
        except Exception as raised:
            error = raised
        packed = None if error is None else packed_error(Cargo(), error)
        for other in self.comm.allgather(packed):
            if other is not None:
                raise error or Cargo().unpack(other)
        return made  # type: ignore[return-value]

    def alike(self, what: str, mine: Mapping[str, Any]) -> None:
        """Check that every rank states the same.

        Args:
            what: is stated, for the error.
            mine: by name, as values that can be sent and compared.

        Raises:
            ModelError: naming two ranks and what they state, on every rank.
        """
        every = self.comm.allgather(dict(mine))
        for rank, other in enumerate(every):
            for name in dict.fromkeys([*every[0], *other]):
                one, two = every[0].get(name), other.get(name)
                if one != two:
                    raise ModelError(
                        f"the ranks state different {what}: {name} is {in_short(one)} on rank 0, "
                        f"{in_short(two)} on rank {rank}; every rank has to state the same"
                    )

    def together(self, make: Callable[[], _Made]) -> _Made:
        """What all ranks make with each other; an error of one of them ends all, unless it is ours.

        So does an interrupt, where there are several: the others would wait for what is left out.

        Raises:
            SSPError: which all of them raise.
        """
        try:
            return make()
        except SSPError:
            raise
        except (Exception, KeyboardInterrupt):
            if self.comm.size == 1:
                raise
            traceback.print_exc()
            sys.stderr.flush()
            self.comm.Abort(1)
            raise

    def order(
        self, name: str, shared: tuple[Any, ...] = (), own: Sequence[tuple[Any, ...]] | None = None
    ) -> list[Any]:
        """Have every rank of PETSc do something with its rows; what they make of it, by rank.

        Args:
            name: of a method of :class:`Share`.
            shared: arguments that all get.
            own: further ones, of each rank; None: none.

        Raises:
            SSPError: as of one of them.
            Stop: the time ended.
        """
        check_time()

        def gathered() -> list[Any]:
            """What the ranks make of it."""
            self.comm.bcast((name, shared, own is not None))
            mine = () if own is None else self.comm.scatter(own)
            return list(self.comm.gather(self._done(name, (*shared, *mine))))

        made = self.together(gathered)
        for one in made:
            if isinstance(one, SSPError):
                raise one
        return made

    def answered(self, cargo: Cargo, find: Callable[[], _Made]) -> _Made:
        """What PETSc's first rank finds, giving orders; the others serve until they hear of it.

        Args:
            cargo: packs and unpacks the answer.
            find: called on the first rank.

        Raises:
            Exception: what the first rank raised, on every rank.
        """
        if self.comm.rank > 0:
            answer: _Made = unpacked(cargo, self.together(self.serve))
            return answer
        packed = b""
        try:
            found = find()
            packed = cargo.pack(found)
        except BaseException as error:
            packed = packed_error(cargo, error)
            raise
        finally:
            self.dismiss(packed)
        return found

    def dismiss(self, answer: bytes) -> None:
        """Tell the other ranks of PETSc the answer, after which they take no orders."""
        self.comm.bcast(("answer", (answer,), False))
        self.hold(None)

    def serve(self) -> bytes:
        """Do what the first rank of PETSc orders, until there is an answer."""
        while True:
            name, shared, is_more = self.comm.bcast(None)
            if name == "answer":
                self.hold(None)
                answer: bytes = shared[0]
                return answer
            mine = self.comm.scatter(None) if is_more else ()
            self.comm.gather(self._done(name, (*shared, *mine)))

    def hold(self, share: Share | None) -> None:
        """Hold other rows, or none; all ranks of PETSc let go of its objects together."""
        if self.share is not None:
            self.messages += self.share.halo.messages
            self.bytes += self.share.halo.bytes
            self.share.clear()
        self.share, self.held_by, self.chosen = share, None, None

    def _done(self, name: str, given: tuple[Any, ...]) -> Any:
        """What this rank of PETSc makes of an order, or its error, if that is ours."""
        try:
            # the first rank looked at the time, for all; none begins again by itself
            with until(float("inf")), without_twins():
                if name == "take":
                    return self.hold(Share(self.comm, self.petsc, *given))
                if name == "label":
                    return self.hold(self.together(lambda: self._held.labelled_anew(*given)))
                return self.together(lambda: getattr(self._held, name)(*given))
        except SSPError as error:
            return error

    @property
    def _held(self) -> Share:
        """The rows that this rank of PETSc holds.

        Raises:
            SolverError: it holds none.
        """
        if self.share is None:
            raise SolverError("no rank of PETSc holds rows yet")
        return self.share


def packed_error(cargo: Cargo, error: BaseException) -> bytes:
    """An error of one of PETSc's ranks for the others; of one that cannot be pickled, its words."""
    try:
        return cargo.pack(error)
    except (pickle.PicklingError, AttributeError, TypeError):
        return cargo.pack(SolverError(f"the first rank ended in {type(error).__name__}: {error}"))


def unpacked(cargo: Cargo, answer: bytes) -> Any:
    """The answer of PETSc's first rank, or its error, which is raised."""
    found = cargo.unpack(answer)
    if isinstance(found, BaseException):
        raise found
    return found
