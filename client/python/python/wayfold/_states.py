"""Arrays of states from what planners hold: lists, rotations of scipy, pairs of a translation and a rotation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ._errors import InvalidArgument

_QUATERNION = ("qx", "qy", "qz", "qw")


def to_array(states: Any, names: tuple[str, ...]) -> npt.NDArray[np.float64]:
    """The states as an array of shape (..., m). `names` are the names of the coordinates of the space."""
    try:
        if _has_rotation(states, names):
            return _compose(states, names)
        if isinstance(states, (list, tuple)) and any(_has_rotation(state, names) for state in states):
            return np.stack([to_array(state, names) for state in states])
        return _numbers(states)
    except InvalidArgument:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidArgument(f"states: {error}", "INVALID_ARGUMENT") from error


def broadcast(values: Any, shape: Sequence[int]) -> list[float]:
    """A number for each of the states of this shape."""
    try:
        numbers = _numbers(values)
        # scipy takes one number of any shape for all states.
        numbers = numbers.reshape(()) if numbers.size == 1 else numbers
        return np.broadcast_to(numbers, tuple(shape)).ravel().tolist()
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidArgument(f"r: {error}", "INVALID_ARGUMENT") from error


def array_of_lists(lists: list[list[int]], shape: Sequence[int]) -> npt.NDArray[np.object_]:
    """An array of lists, as scipy returns the points of many balls."""
    array = np.empty(len(lists), dtype=object)
    for row, ids in enumerate(lists):
        array[row] = ids
    return array.reshape(tuple(shape))


def _numbers(values: Any) -> npt.NDArray[np.float64]:
    """Aligned numbers in the byte order of this machine. numpy would drop masks, imaginary parts and units of time."""
    parts = values if isinstance(values, (list, tuple)) else [values]
    if any(isinstance(part, np.ma.MaskedArray) and np.ma.is_masked(part) for part in parts):
        raise ValueError("an array with masked numbers")
    array = np.asanyarray(values)
    # A list of numbers and dates becomes an array of objects.
    for one in array.flat if array.dtype.kind == "O" else [array]:
        if np.asarray(one).dtype.kind not in "biufSUO":
            raise ValueError(f"an array of {np.asarray(one).dtype}, where real numbers belong")
    return np.require(array, dtype=np.float64, requirements=["C", "A"])


def _has_rotation(state: Any, names: tuple[str, ...]) -> bool:
    return _is_rotation(state) or _is_transform(state) or _is_composed(state, names)


def _is_rotation(state: Any) -> bool:
    return hasattr(state, "as_quat")


def _is_transform(state: Any) -> bool:
    """True for a `RigidTransform` of scipy."""
    return hasattr(state, "as_components")


def _is_composed(state: Any, names: tuple[str, ...]) -> bool:
    """True for the parts of a state, one of which is a rotation: a translation and a rotation."""
    if not isinstance(state, tuple) or not any(map(_is_rotation, state)):
        return False
    # Rotations alone are as many states, unless a state has as many of them.
    return not all(map(_is_rotation, state)) or len(names) == len(_QUATERNION) * len(state) > len(_QUATERNION)


def _compose(state: Any, names: tuple[str, ...]) -> npt.NDArray[np.float64]:
    """The parts of states, one beside the other; a part for one state belongs to all."""
    if _is_transform(state):
        state = state.as_components()
    parts: list[npt.NDArray[np.float64]] = []
    kinds: list[str] = []
    for part in (state,) if _is_rotation(state) else state:
        if _is_rotation(part):
            parts.append(np.asarray(part.as_quat(), dtype=np.float64))
            kinds += _QUATERNION
        else:
            parts.append(np.atleast_1d(_numbers(part)))
            kinds += ["number"] * parts[-1].shape[-1]
    expected = [name[:2] if name[:2] in _QUATERNION else "number" for name in names]
    if kinds != expected:
        raise InvalidArgument(
            f"states: {_describe(kinds)}, where a state of this space is {', '.join(names)}", "INVALID_ARGUMENT"
        )
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return np.concatenate([np.broadcast_to(part, shape + part.shape[-1:]) for part in parts], axis=-1)


def _describe(kinds: list[str]) -> str:
    """The parts in words: three numbers and a rotation."""
    words, numbers = [], 0
    for kind in [*kinds, "end"]:
        if kind == "number":
            numbers += 1
            continue
        if numbers:
            words.append(f"{numbers} numbers")
            numbers = 0
        if kind == "qx":
            words.append("a rotation")
    return ", ".join(words)
