"""Methods of tensor arithmetic, recorded once and replayed as one compiled kernel.

A control step calls some 400 small torch operations, and on a CPU their calls cost more than their arithmetic. The code
stays as it is: a method is recorded as a function of the attributes it reads (:mod:`eagle_rl.kernels`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from operator import attrgetter, itemgetter
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, fx

from eagle_rl import kernels
from eagle_rl.errors import CompileError, EagleWarning

Attributes = tuple[tuple[str, ...], tuple[str, ...]]
"""Paths of what a method reads and of what it writes."""


class Attribute(NamedTuple):
    """An attribute that holds a tensor, or a dataclass of tensors."""

    path: str
    """From the owner, e.g. ``commands.command``."""
    kind: type | None
    """The dataclass; None for a tensor."""
    holder: Callable[[object], object]
    """Finds whose attribute it is, given the owner."""
    name: str
    """By which that has it."""

    @classmethod
    def at(cls, path: str, kind: type | None = None) -> Attribute:
        """The attribute that is found there."""
        way, _, name = path.rpartition(".")
        return cls(path, kind, attrgetter(way) if way else _itself, name)

    @classmethod
    def of(cls, owner: object, path: str) -> Attribute:
        """The attribute as it is now."""
        value = attrgetter(path)(owner)
        return cls.at(path, type(value) if is_dataclass(value) else None)

    def paths(self) -> list[str]:
        """Of its tensors."""
        return [self.path] if self.kind is None else [f"{self.path}.{f.name}" for f in fields(self.kind)]

    def put(self, owner: object, tensors: Iterator[Tensor | None]) -> None:
        """Set it to the next of these tensors, as many as it takes."""
        value = next(tensors) if self.kind is None else self.kind(**{f.name: next(tensors) for f in fields(self.kind)})
        setattr(self.holder(owner), self.name, value)


class Recording:
    """Stands in for a method of an object, see the module.

    Inputs are the method's arguments and the attributes it reads; results are what it returns, a tuple, and the
    attributes it writes. A result is an input as it came, or a tensor of its own. Attributes that are None are left
    out, and there is one kernel for each set of those that are not.
    """

    def __init__(
        self,
        owner: object,
        method: Callable[..., Any],
        reads: Sequence[str],
        writes: Sequence[str] = (),
        scratch: Sequence[str] = (),
    ) -> None:
        """Record and compile at the first call or :meth:`make`; a call that cannot be compiled warns and is as before.

        Args:
            owner: object whose attributes are read and written, by their paths.
            method: bound method of it.
            reads: every attribute that the method reads and that may change, or is as large as the pool.
            writes: every attribute that the method sets.
            scratch: attributes, None before each call, that the method sets for itself.
        """
        self._owner, self._method = owner, method
        self._reads, self._writes, self._scratch = tuple(reads), tuple(writes), tuple(scratch)
        self._look = _getter(self._reads)
        self._replays: dict[tuple[bool, ...], _Replay] = {}
        self._gave_up = False

    def __call__(self, *args: Tensor) -> Any:
        """Do what the method does."""
        if _Replay.in_the_making or self._gave_up:
            return self._method(*args)
        try:
            replay = self.make(*args)
        except CompileError as error:
            self._gave_up = True
            warnings.warn(f"{error} Training goes on without, a little slower.", EagleWarning, stacklevel=2)
            return self._method(*args)
        return replay(*args)

    def make(self, *args: Tensor) -> _Replay:
        """What is replayed for arguments like these and the attributes as they are, recorded and compiled at first.

        Raises:
            CompileError: there is no C++ compiler, or it failed.
        """
        present = [value is not None for value in self._look(self._owner)]
        replay = self._replays.get(tuple(present))
        if replay is None:
            reads = [path for path, there in zip(self._reads, present, strict=True) if there]
            replay = self._replays[tuple(present)] = _Replay(
                self._owner, self._method, args, reads, self._writes, self._scratch
            )
        return replay

    @property
    def graphs(self) -> list[fx.GraphModule]:
        """What was recorded, for tests."""
        return [replay.graph for replay in self._replays.values()]


class InBlocks:
    """Stands in for a method of any number of rows: its recording for so many, as often as it takes."""

    MOST = 8
    """Blocks; with twice as many the method itself is as quick (``docs/performance.md``)."""

    def __init__(self, recording: Recording, method: Callable[[Tensor], Any], size: int) -> None:
        """Use ``recording`` of ``method`` for ``size`` rows, whose results are tuples of tensors."""
        self.graphs = recording.graphs
        self._recording, self._method = recording, method
        self._size = size
        self._fill: dict[int, Tensor] = {}

    def __call__(self, ids: Tensor) -> Any:
        """Do what the method does."""
        if not 0 < len(ids) <= self._size * self.MOST:
            return self._method(ids)
        blocks = [self._block(block) for block in ids.split(self._size)]
        if len(blocks) == 1:
            return blocks[0]
        results = (None if parts[0] is None else torch.cat(parts) for parts in zip(*blocks, strict=True))
        return type(blocks[0])(*results)

    def _block(self, ids: Tensor) -> Any:
        """Of up to so many rows."""
        count = len(ids)
        if count not in self._fill:
            self._fill[count] = torch.arange(self._size, device=ids.device).clamp(max=count - 1)
        results = self._recording(ids[self._fill[count]])
        return type(results)(*(None if x is None else x[:count] for x in results))


class _Replay:
    """A kernel and the way tensors get into it and out."""

    in_the_making: ClassVar[bool] = False
    """While one is made, methods that its own calls are to be run as they are."""

    def __init__(
        self,
        owner: Any,
        method: Callable[..., Any],
        args: Sequence[Tensor],
        reads: Sequence[str],
        writes: Sequence[str],
        scratch: Sequence[str],
    ) -> None:
        self._owner, self._scratch = owner, [Attribute.at(path) for path in scratch]
        self._reads = [Attribute.of(owner, path) for path in reads]
        self._writes = [Attribute.of(owner, path) for path in writes]
        self._returned: tuple[type, tuple[bool, ...]] = (tuple, ())
        paths = [path for attribute in self._reads for path in attribute.paths()]
        given = (*args, *_getter(paths)(owner))
        inputs = [x.detach().clone(memory_format=torch.contiguous_format) for x in given]
        with torch.inference_mode(False), torch.no_grad():
            tried = [x.clone() for x in inputs]
            results = self._run(method, len(args), tried)  # makes the constants the method keeps
            passed = [next((i for i, x in enumerate(tried) if x is result), None) for result in results]

            def make(*tensors: Tensor) -> list[Tensor]:
                made = zip(self._run(method, len(args), tensors), passed, strict=True)
                return [x.clone(memory_format=torch.contiguous_format) for x, source in made if source is None]

            self.graph = kernels.record(make, inputs)
        used = kernels.drop_unused(self.graph)
        self._kernel = kernels.compile_graph(self.graph, [inputs[i] for i in used])
        kept = [i for i in range(len(given)) if i < len(args) or i in used or i in passed]
        self._collect = _getter([paths[i - len(args)] for i in kept[len(args) :]])
        self._used = [kept.index(i) for i in used]
        self._dtypes = [inputs[i].dtype for i in used]
        made, count = iter(range(len(passed))), passed.count(None)
        order = [next(made) if i is None else count + kept.index(i) for i in passed]
        self._pick = itemgetter(*order, 0)  # with one more than is used, since of one alone it makes no tuple
        """From what the kernel made, followed by what it was given."""

    def __call__(self, *args: Tensor) -> Any:
        given = (*args, *self._collect(self._owner))
        inputs = [given[i] for i in self._used]
        if not all(map(Tensor.is_contiguous, inputs)) or [x.dtype for x in inputs] != self._dtypes:
            inputs = [x.to(dtype).contiguous() for x, dtype in zip(inputs, self._dtypes, strict=True)]
        results = iter(self._pick((*self._kernel(*inputs), *given)))
        for attribute in self._writes:
            attribute.put(self._owner, results)
        kind, present = self._returned
        values = [next(results) if there else None for there in present]
        return tuple(values) if kind is tuple else kind(*values)

    def _run(self, method: Callable[..., Any], num_args: int, tensors: Sequence[Tensor]) -> list[Tensor]:
        """What the method writes and returns, given its inputs; leaves the owner as it was."""
        with self._kept():
            given = iter(tensors[num_args:])
            for attribute in self._reads:
                attribute.put(self._owner, given)
            for attribute in self._scratch:
                attribute.put(self._owner, iter((None,)))
            returned = method(*tensors[:num_args])
            self._returned = type(returned), tuple(value is not None for value in returned)
            written = [attrgetter(path)(self._owner) for attribute in self._writes for path in attribute.paths()]
        return [*written, *(value for value in returned if value is not None)]

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """Put back, in the end, whatever is set in between."""
        attributes = list(
            {attribute.path: attribute for attribute in (*self._writes, *self._reads, *self._scratch)}.values()
        )
        before = [attrgetter(attribute.path)(self._owner) for attribute in attributes]
        _Replay.in_the_making = True
        try:
            yield
        finally:
            _Replay.in_the_making = False
            for attribute, value in zip(attributes, before, strict=True):
                setattr(attribute.holder(self._owner), attribute.name, value)


def _itself(owner: object) -> object:
    """Whose attribute has no dot in its path."""
    return owner


def _getter(paths: Sequence[str]) -> Callable[[object], tuple[Any, ...]]:
    """Looks up all these attributes in one call, which for many is far quicker than one by one."""
    if len(paths) > 1:
        return attrgetter(*paths)
    return lambda owner: tuple(attrgetter(path)(owner) for path in paths)
