"""Trees of numpy arrays out of a pickle that nobody has to trust.

No name in the pickle is ever imported: the three that numpy writes for an array are replaced by stand-ins of this
module, which check shape, type and length and then read the bytes as numbers; every other name is refused.
"""

from __future__ import annotations

import itertools
import math
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from persist_cli.errors import CheckpointError

DEEPEST: Final = 16  # levels of a tree: far more than a network's, and an end to one that holds itself
MOST_ARRAYS: Final = 10_000  # of a tree, so that one branch shared by many does not grow without end
NUMBER_TYPES: Final = frozenset({"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"})

UNPICKLING_ERRORS: Final = (
    pickle.UnpicklingError, EOFError, LookupError, TypeError, ValueError, AttributeError, ImportError, OverflowError,
    MemoryError, RecursionError,
)  # fmt: skip


def read_pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a pickled tree of dictionaries, by their path joined with ".".

    Raises:
        CheckpointError: one line when the pickle asks for anything but arrays, is damaged, or is no such tree.
    """
    try:
        with path.open("rb") as file:
            leaves = list(itertools.islice(_leaves(_ArrayUnpickler(file).load(), "", 0), MOST_ARRAYS + 1))
        if not 0 < len(leaves) <= MOST_ARRAYS:
            raise pickle.UnpicklingError(f"no arrays, or more than {MOST_ARRAYS}")
        return dict(leaves)
    except UNPICKLING_ERRORS as error:
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"{path}: refused, not a pickle of plain arrays only ({cause})") from error


class _StandIn:
    """A replacement for an object of numpy in a pickle, which takes no attributes from the pickle."""

    __slots__ = ()

    def __setstate__(self, state: object) -> None:
        raise pickle.UnpicklingError("it changes what it must not")


class _NdArrayName(_StandIn):
    __slots__ = ()


class _Type(_StandIn):
    """A plain number type, first by its code and then by its byte order."""

    __slots__ = ("code", "order")

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "="

    def __setstate__(self, state: object) -> None:
        # (version, byte order, subtype, names, fields, size, alignment, flags): None for what plain numbers lack
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|") or any(state[2:5]):
            raise pickle.UnpicklingError("an array of no plain number type")
        self.order = state[1]


class _TypeMaker(_StandIn):
    __slots__ = ()

    def __call__(self, code: object, *_: object) -> _Type:
        if code not in NUMBER_TYPES:
            raise pickle.UnpicklingError(f"an array of type {code!r}")
        return _Type(str(code))


class _Array(_StandIn):
    __slots__ = ("values",)

    def __init__(self) -> None:
        self.values: np.ndarray | None = None

    def __setstate__(self, state: object) -> None:
        match state:
            case (_, tuple(shape), _Type() as kind, bool(columns_first), bytes(data)):
                self.values = _as_array(shape, kind, columns_first, data)
            case _:
                raise pickle.UnpicklingError("an array in a form that numpy does not write")


class _ArrayMaker(_StandIn):
    __slots__ = ()

    def __call__(self, kind: object, *_: object) -> _Array:
        if not isinstance(kind, _NdArrayName):
            raise pickle.UnpicklingError("an array of another class than numpy's own")
        return _Array()


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        match (module, name):
            case ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct"):
                return _ArrayMaker()
            case ("numpy", "ndarray"):
                return _NdArrayName()
            case ("numpy", "dtype"):
                return _TypeMaker()
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")

    def persistent_load(self, pid: object) -> NoReturn:
        raise pickle.UnpicklingError("it asks for a persistent object")


def _as_array(shape: tuple[Any, ...], kind: _Type, columns_first: bool, data: bytes) -> np.ndarray:
    number = np.dtype(kind.order + kind.code)
    if (
        not all(isinstance(side, int) and side >= 0 for side in shape)
        or len(data) != math.prod(shape) * number.itemsize
    ):
        raise pickle.UnpicklingError(f"{len(data)} bytes are no array of shape {shape}")
    return np.frombuffer(data, number).reshape(shape, order="F" if columns_first else "C")


def _leaves(tree: object, path: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(tree, _Array) and tree.values is not None:
        yield path, tree.values
        return
    if not isinstance(tree, dict) or depth > DEEPEST:
        raise pickle.UnpicklingError(f"{path or 'its root'} is no tree of arrays")
    for name, branch in tree.items():
        if not isinstance(name, str):
            raise pickle.UnpicklingError(f"{path or 'its root'} has a name that is no text")
        yield from _leaves(branch, f"{path}.{name}" if path else name, depth + 1)
