"""Problems and answers as sent to other Python processes: models are named, not contained.

Each model is sent once, in a file that any process maps into memory. All other pickles name the
model by its place in this file, so problems and answers are small. An answer that arrives is
connected to the caller's own model.
"""

from __future__ import annotations

import mmap
import pickle
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from types import FunctionType
from typing import Any, BinaryIO

import numpy as np
from joblib.externals.loky.cloudpickle_wrapper import dumps, loads

from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.product import ProductSSP
from ssp_lp.problem import Problem

_ALIGNED = 64  # bytes: arrays in a file begin at multiples, for the compiled loops


def models_of(problems: Iterable[Problem]) -> list[SSP]:
    """Return the distinct models of the problems; a product comes after its original model."""
    models: dict[int, SSP] = {}
    for problem in problems:
        chain: list[SSP] = []
        model: SSP | None = problem.model
        while model is not None and id(model) not in models:
            chain.append(model)
            model = model.original if isinstance(model, ProductSSP) else None
        models |= {id(one): one for one in reversed(chain)}
    return [*models.values()]


class _Pickler(pickle.Pickler):
    """A pickler that replaces each model by its place in the file of models."""

    places: Mapping[int, int]  # id of a model -> place

    def persistent_id(self, thing: Any) -> int | None:
        """Return the place of a model in the file; None for any other object."""
        return self.places.get(id(thing)) if isinstance(thing, SSP) else None

    def reducer_override(self, thing: Any) -> Any:
        """Pickle objects that need another form than the default.

        Functions and classes of a script are pickled by value. An array of equal numbers is pickled
        as one number and its shape.
        """
        if isinstance(thing, (FunctionType, type)):  # lambdas and locals cannot be imported either
            if thing.__module__ == "__main__" or "<l" in thing.__qualname__:
                return loads, (dumps(thing),)
        elif type(thing) is np.ndarray and thing.strides == (0,) and thing.size > 1:
            return np.broadcast_to, (thing[:1].copy(), thing.shape)
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    """An unpickler that replaces each place in the file of models by its model."""

    persistent_load: Callable[[Any], SSP]


class Store:
    """Problems and answers in transit, whose models are stored in a file.

    Outside the file a model is named by its place, a position in the file. For each model the file
    contains the arrays, aligned so that any process can map them into memory. They are followed, at
    the model's place, by a pickle of the rest of the model and the positions of its arrays.
    """

    def __init__(self, content: bytes | memoryview = b"") -> None:
        """Begin with no model in memory.

        Args:
            content: content of a file of models that another process wrote; empty: no such file.
        """
        self._content = memoryview(content)
        self._models: dict[int, SSP] = {}  # place -> model
        self._places: dict[int, int] = {}  # id of a model -> place

    def load(self, models: Iterable[SSP], file: BinaryIO) -> None:
        """Write models to a file for other processes, an original model before its product.

        Raises:
            ModelError: a model cannot be pickled.
        """
        file.write(b"ssp-lp")  # an empty file cannot be mapped
        for model in models:
            buffers, spans = list[pickle.PickleBuffer](), []
            stream = self.pack(model, buffers.append)
            for buffer in buffers:
                file.write(bytes(-file.tell() % _ALIGNED))
                begin = file.tell()
                file.write(buffer.raw())
                spans.append((begin, file.tell()))
            self.register(file.tell(), model)
            pickle.dump((stream, spans), file)

    def pack(
        self, thing: object, keep: Callable[[pickle.PickleBuffer], None] | None = None
    ) -> bytes:
        """Pickle a problem or an answer without its models; if given, ``keep`` receives its arrays.

        Raises:
            ModelError: the problem or answer cannot be pickled.
        """
        stream = BytesIO()
        pickler = _Pickler(stream, protocol=5, buffer_callback=keep)
        pickler.places = self._places
        try:
            pickler.dump(thing)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ModelError(f"the problem cannot be pickled ({error}): use solve") from error
        return stream.getvalue()

    def unpack(self, packed: bytes, buffers: Iterable[memoryview] = ()) -> Any:
        """Return a problem or an answer that was packed, with the models of this process."""
        unpickler = _Unpickler(BytesIO(packed), buffers=buffers)
        unpickler.persistent_load = self._model_at
        return unpickler.load()

    def register(self, place: int, model: SSP) -> None:
        """Register a model under its place in the file, unless one is registered there already."""
        self._places[id(self._models.setdefault(place, model))] = place

    def _model_at(self, place: int) -> SSP:
        """Return the model at a place in the file; it is read on first use."""
        if place not in self._models:
            stream, spans = pickle.loads(self._content[place:])  # noqa: S301 (the caller's process)
            buffers = [self._content[begin:end] for begin, end in spans]
            self.register(place, self.unpack(stream, buffers))
        return self._models[place]


@dataclass(frozen=True)
class Models:
    """A file of models. ``content`` is its content, for processes that cannot read the file."""

    path: str
    content: bytes | None = field(default=None, compare=False, repr=False)


@lru_cache(maxsize=1)
def loaded(models: Models) -> Store:
    """Return the cargo of a shipment in this process.

    The last one is cached, so that a worker reads the models of a call once.

    Raises:
        OSError: the file cannot be read from here.
    """
    if models.content is not None:
        return Store(models.content)
    with Path(models.path).open("rb") as file:
        return Store(memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))
