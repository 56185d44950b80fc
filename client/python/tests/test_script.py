"""The script of operations, whose answers brute force has written, in each form of the index."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import wayfold
from conftest import Server

SCRIPT = Path(__file__).resolve().parents[2] / "tests" / "script" / "operations.txt"

Make = Callable[[str, str], wayfold.Index]


def bits(number: float) -> str:
    return struct.pack(">d", number).hex()


def joined(words: Iterable[str]) -> str:
    return " ".join(words) or "none"


def pairs(ids: Iterable[int], distances: Iterable[float]) -> str:
    return joined(f"{id}:{bits(distance)}" for id, distance in zip(ids, distances, strict=True))


def text(found: wayfold.SearchResult) -> str:
    return pairs(found.ids.tolist(), found.distances.tolist())


def state_of(words: list[str]) -> npt.NDArray[np.float64]:
    return np.array([float(word) for word in words], dtype=np.float64)


def nearest_k(index: wayfold.Index, k: int, state: npt.NDArray[np.float64]) -> str:
    answer = text(index.nearest_k(state, k))
    # The shapes of scipy have the same neighbours, and inf and -1 beyond them.
    distances, ids = index.query(state[np.newaxis], [*range(1, k + 1)])
    found = np.count_nonzero(ids[0] >= 0)
    assert pairs(ids[0, :found].tolist(), distances[0, :found].tolist()) == answer
    return answer


def search_of(k: str, radius: str, mask: str, value: str, epsilon: str) -> wayfold.Search:
    return wayfold.Search(
        None if k == "-" else int(k), radius=float(radius), tag=(int(mask), int(value)), epsilon=float(epsilon)
    )


def answer(index: wayfold.Index, line: str) -> str:
    match line.split():
        case ["insert", *state]:
            return str(index.insert(state_of(state)))
        case ["insert_with", id, tag, *state]:
            return str(index.insert(state_of(state), id=None if id == "-" else int(id), tag=int(tag)))
        case ["insert_many", count, *states]:
            return joined(map(str, index.insert_many(state_of(states).reshape(int(count), -1)).tolist()))
        case ["replace", id, *state]:
            return str(index.replace(int(id), state_of(state))).lower()
        case ["remove", id]:
            return str(index.remove(int(id))).lower()
        case ["set_tag", id, tag]:
            return str(index.set_tag(int(id), int(tag))).lower()
        case ["get", id]:
            point = index.get(int(id))
            return "none" if point is None else joined([str(point.tag), *map(bits, point.state.tolist())])
        case ["len"]:
            return str(len(index))
        case ["nearest", *state]:
            nearest = index.nearest(state_of(state))
            return "none" if nearest is None else pairs([nearest.id], [nearest.distance])
        case ["nearest_k", k, *state]:
            return nearest_k(index, int(k), state_of(state))
        case ["nearest_r", radius, *state]:
            return text(index.nearest_r(state_of(state), float(radius)))
        case ["search", k, radius, mask, value, epsilon, *state]:
            return text(index.search(state_of(state), search_of(k, radius, mask, value, epsilon)))
    raise AssertionError(f"no operation: {line}")


def replay(make: Make) -> None:
    index, answers = None, 0
    for number, line in enumerate(SCRIPT.read_text().splitlines(), 1):
        if not line or line.startswith("#"):
            continue
        if line.startswith("space "):
            if index is not None:
                assert index.close() == []
            index = make(line.removeprefix("space "), f"script-{number}")
            continue
        operation, _, expected = line.partition(" = ")
        assert index is not None
        try:
            found = answer(index, operation)
        except wayfold.Error as error:
            found = f"{error.code} {error}"
        assert found == expected, f"line {number}"
        answers += 1
    assert index is not None and index.close() == [] and answers > 0


@pytest.mark.parametrize("inline", [False, True])
def test_in_memory(inline: bool) -> None:
    replay(lambda space, name: wayfold.Index(space, inline=inline))


@pytest.mark.parametrize("opened", [wayfold.shared, wayfold.remote])
def test_on_a_server(server: Server, opened: Callable[..., wayfold.Index]) -> None:
    replay(lambda space, name: opened(server.url, f"{opened.__name__}-{name}", create=space))
