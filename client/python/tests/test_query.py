"""`query` and `query_ball_point` against brute force and scipy."""

from __future__ import annotations

import math
import pickle
import resource
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import wayfold
from wayfold import spaces

Floats = npt.NDArray[np.float64]

SPACES = {
    "R3": spaces.R(3),
    "SE2": spaces.SE2(weight=0.5),
    "SE3": spaces.SE3(weight=0.15),
    "OMPL": spaces.OMPL_SE3(),
    "torus": spaces.torus(2),
}


def strided(states: Floats) -> Floats:
    """The states with gaps between their numbers."""
    wide = np.full((*states.shape[:-1], 2 * states.shape[-1]), math.nan)
    wide[..., ::2] = states
    return wide[..., ::2]


# The same numbers in other orders of memory.
LAYOUTS: dict[str, Callable[[Floats], Floats]] = {
    "C": lambda states: np.ascontiguousarray(states),
    "Fortran": lambda states: np.asfortranarray(states),
    "transposed": lambda states: np.moveaxis(np.ascontiguousarray(np.moveaxis(states, -1, 0)), 0, -1),
    "strided": strided,
    "backwards": lambda states: np.ascontiguousarray(states[..., ::-1])[..., ::-1],
}
layouts = st.sampled_from(sorted(LAYOUTS))


def random_states(rng: np.random.Generator, name: str, n: int) -> Floats:
    match name:
        case "R3":
            return rng.uniform(-1, 1, (n, 3))
        case "SE2":
            return np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(-4, 4, n)])
        case "torus":
            return rng.uniform(-4, 4, (n, 2))
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.column_stack([rng.uniform(-1, 1, (n, 3)), quaternions])


def arc(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.abs((a - b + math.pi) % (2 * math.pi) - math.pi))


def half_angle(a: Floats, b: Floats) -> Floats:
    """Half the angle of the rotation between two, by scipy."""
    return np.asarray((Rotation.from_quat(a) * Rotation.from_quat(b).inv()).magnitude() / 2)


def brute_force(name: str, state: Floats, points: Floats) -> Floats:
    moved = np.asarray(np.linalg.norm(points[:, :3] - state[:3], axis=1))
    match name:
        case "R3":
            return moved
        case "SE2":
            planar = np.linalg.norm(points[:, :2] - state[:2], axis=1)
            return np.asarray(np.sqrt(planar**2 + 0.5 * arc(points[:, 2], state[2]) ** 2))
        case "torus":
            return np.asarray(np.sqrt(arc(points[:, 0], state[0]) ** 2 + arc(points[:, 1], state[1]) ** 2))
        case "SE3":
            return np.asarray(np.sqrt(moved**2 + 0.15 * half_angle(points[:, 3:], state[3:]) ** 2))
        case _:
            return np.asarray(moved + half_angle(points[:, 3:], state[3:]))


@pytest.mark.parametrize("name", SPACES)
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 300),
    k=st.integers(1, 20),
    removed=st.integers(0, 50),
    layout=layouts,
)
def test_query_equals_brute_force(name: str, seed: int, n: int, k: int, removed: int, layout: str) -> None:
    rng = np.random.default_rng(seed)
    points, queries = (LAYOUTS[layout](random_states(rng, name, count)) for count in (n, 4))
    index = wayfold.Index(SPACES[name], inline=bool(seed % 2))
    ids = index.insert_many(points)
    gone = set(rng.integers(0, n, removed).tolist())
    for id in gone:
        assert index.remove(id)
    kept = np.array([id not in gone for id in ids], dtype=bool)
    distances, found = index.query(queries, k)
    assert distances.shape == found.shape == ((4, k) if k > 1 else (4,))
    for row, state in enumerate(queries):
        expected = np.sort(brute_force(name, state, points[kept]))[:k] if kept.any() else np.empty(0)
        row_distances, row_ids = np.atleast_1d(distances[row]), np.atleast_1d(found[row])
        count = len(expected)
        np.testing.assert_allclose(row_distances[:count], expected, rtol=1e-9, atol=2e-8)
        assert np.all(np.isinf(row_distances[count:])) and np.all(row_ids[count:] == -1)
        own = brute_force(name, state, points[row_ids[:count]]) if count else np.empty(0)
        np.testing.assert_allclose(row_distances[:count], own, rtol=1e-9, atol=2e-8)
        assert not gone.intersection(row_ids.tolist())
        # One state has the same answer as many, to the bit.
        one_distances, one_ids = index.query(state, k)
        assert np.array_equal(one_distances, distances[row]) and np.array_equal(one_ids, found[row])


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 200),
    k=st.one_of(st.integers(1, 12), st.lists(st.integers(1, 12), min_size=1, max_size=4)),
    bound=st.sampled_from([math.inf, 0.5, 0.1, 0.0]),
    shape=st.sampled_from([(), (1,), (5,), (2, 3), (0,)]),
    workers=st.sampled_from([1, 2, -1]),
    layout=layouts,
)
def test_query_equals_scipy_in_r3(
    seed: int, n: int, k: Any, bound: float, shape: tuple[int, ...], workers: int, layout: str
) -> None:
    rng = np.random.default_rng(seed)
    points, queries = (LAYOUTS[layout](rng.uniform(-1, 1, (*rows, 3))) for rows in ((n,), shape))
    tree, index = cKDTree(points), wayfold.Index("R3")
    index.insert_many(points)
    expected, expected_ids = tree.query(queries, k, distance_upper_bound=bound)
    distances, ids = index.query(queries, k, distance_upper_bound=bound, workers=workers)
    assert np.shape(distances) == np.shape(expected) and np.shape(ids) == np.shape(expected_ids)
    np.testing.assert_allclose(distances, expected, rtol=1e-13)
    np.testing.assert_array_equal(ids, np.where(np.isinf(expected), -1, expected_ids))
    radius = rng.uniform(0, 1, shape) if seed % 2 else float(rng.uniform(0, 1))
    lengths = index.query_ball_point(queries, radius, return_length=True, workers=workers)
    np.testing.assert_array_equal(lengths, tree.query_ball_point(queries, radius, return_length=True))
    found = index.query_ball_point(queries, radius, return_sorted=True, workers=workers)
    expected_balls: Any = tree.query_ball_point(queries, radius, return_sorted=True)
    if shape == ():
        assert found == expected_balls
    else:
        assert found.shape == expected_balls.shape == shape
        assert found.ravel().tolist() == expected_balls.ravel().tolist()


def test_the_bound_of_a_query_is_open_and_a_ball_is_closed() -> None:
    index = wayfold.Index("R1")
    index.insert([1.0])
    assert index.query([0.0], distance_upper_bound=1.0) == (math.inf, -1)
    assert index.query([0.0], distance_upper_bound=math.nextafter(1.0, 2.0)) == (1.0, 0)
    assert index.query_ball_point([0.0], 1.0) == [0]


@pytest.mark.parametrize(("states", "radii"), [((), (1,)), ((1,), (1,)), ((5,), (1, 1)), ((5,), (1,)), ((2, 3), (3,))])
def test_radii_broadcast_as_scipy_s(states: tuple[int, ...], radii: tuple[int, ...]) -> None:
    tree, index = cKDTree(np.zeros((1, 3))), wayfold.Index("R3")
    index.insert([0.0, 0.0, 0.0])
    queries, radius = np.zeros((*states, 3)), np.ones(radii)
    try:
        expected = np.shape(tree.query_ball_point(queries, radius, return_length=True))
    except ValueError:
        with pytest.raises(ValueError):
            index.query_ball_point(queries, radius, return_length=True)
    else:
        assert np.shape(index.query_ball_point(queries, radius, return_length=True)) == expected


def test_many_radii_see_one_state_of_the_index() -> None:
    # A writer changes the number of points all the time: all states of a call find as many.
    index = wayfold.Index("R1")
    is_over = threading.Event()

    def store() -> None:
        while not is_over.is_set():
            for id in index.insert_many([[0.0]] * 50).tolist():
                index.remove(id)

    index.insert_many([[0.0]] * 50)
    writer = threading.Thread(target=store)
    writer.start()
    try:
        for _ in range(50):
            lengths = index.query_ball_point(np.zeros((100, 1)), np.linspace(1, 2, 100), return_length=True)
            assert len(set(lengths.tolist())) == 1
    finally:
        is_over.set()
        writer.join()


def test_lengths_are_counted_in_blocks_of_states() -> None:
    rng = np.random.default_rng(11)
    index = wayfold.Index("R3")
    index.insert_many(rng.uniform(size=(4_000, 3)))
    queries, radii = rng.uniform(size=(8_000, 3)), rng.uniform(0, 0.3, 8_000)
    # All neighbours would be 512 MB, and those of a block are 64 MB.
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert set(index.query_ball_point(queries, 2.0, return_length=True).tolist()) == {4_000}
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 256_000
    expected = [len(ids) for ids in index.query_ball_point(queries, radii)]
    queries[7_400, 1] = math.nan
    for workers in (1, 2):
        lengths = index.query_ball_point(queries[:7_400], radii[:7_400], return_length=True, workers=workers)
        assert lengths.tolist() == expected[:7_400]
        with pytest.raises(ValueError, match=r"states\[7400\]\.coords\[1\]: NaN"):
            index.query_ball_point(queries, radii, return_length=True, workers=workers)


def test_an_answer_that_no_memory_holds_is_a_memory_error() -> None:
    index = wayfold.Index("R1")
    index.insert([1.0])
    states = np.zeros((2**22, 1))
    with pytest.raises(MemoryError, match="4194304 rows of 4294967295 neighbours"):
        index.query(states, 2**32 - 1)
    # Few of many ranks are few numbers.
    distances, ids = index.query([0.0], [1, 2**32 - 1])
    assert distances.tolist() == [1.0, math.inf] and ids.tolist() == [0, -1]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_numbers_are_read_in_the_order_of_their_indices(layout: str, tmp_path: Path) -> None:
    rows = np.arange(12.0).reshape(4, 3)
    states, grid, radii = map(LAYOUTS[layout], (rows, rows.reshape(2, 2, 3), np.array([[0.0, 6.0], [0.0, 0.0]])))
    index = wayfold.Index("R3")
    assert index.insert_many(states).tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(index.scan().columns()[2], rows)
    assert index.query(states)[0].tolist() == [0.0] * 4 and index.query(states)[1].tolist() == [0, 1, 2, 3]
    assert index.query(grid)[1].tolist() == index.query(grid, 2)[1][..., 0].tolist() == [[0, 1], [2, 3]]
    assert index.query_ball_point(states, 0.0).tolist() == [[0], [1], [2], [3]]
    # Neighbouring rows are √27 apart.
    assert index.query_ball_point(grid, radii).tolist() == [[[0], [0, 1, 2]], [[2], [3]]]
    many = index.search_many(states, wayfold.Search(1))
    each = index.search_each(states, [wayfold.Search(1)] * 4)
    assert [found.ids.tolist() for found in many] == [found.ids.tolist() for found in each] == [[0], [1], [2], [3]]
    path = tmp_path / "saved"
    index.save(path)
    content = {**np.load(path), "states": states}
    with open(path, "wb") as file:
        np.savez(file, **content)
    for copy in (wayfold.Index.load(path), pickle.loads(pickle.dumps(index))):
        np.testing.assert_array_equal(copy.scan().columns()[2], rows)


def test_types_are_scipys() -> None:
    index = wayfold.Index("R3")
    index.insert_many(np.eye(3))
    distances, ids = index.query(np.eye(3), 2)
    assert distances.dtype == np.float64 and ids.dtype == np.int64
    assert index.query([1, 0, 0]) == (0.0, 0)
    assert index.query(np.eye(3, dtype=np.float32)[0]) == (0.0, 0)
    assert index.query(np.eye(3)[:, ::-1][::-1])[1].tolist() == [0, 1, 2]
    assert index.query(np.arange(6.0)[::2] * [0, 0, 0.25])[1] == 2
    # One state with gaps between its numbers, or backwards in memory.
    assert index.query(np.array([0.0, 9.0, 1.0, 9.0, 0.0, 9.0])[::2]) == (0.0, 1)
    assert index.query(np.array([1.0, 0.0, 0.0])[::-1]) == (0.0, 2)
    # The few numbers of one answer are a copy, and the many are not; both are arrays to write to.
    index.insert_many(np.zeros((2_000, 3)))
    for k in (3, 1_500):
        distances, ids = index.query([1, 0, 0], k)
        assert distances.shape == ids.shape == (k,) and distances.flags.writeable and ids[0] == 0


def test_eps_stays_within_its_factor() -> None:
    rng = np.random.default_rng(7)
    index = wayfold.Index(SPACES["SE3"])
    index.insert_many(random_states(rng, "SE3", 2000))
    queries = random_states(rng, "SE3", 50)
    exact, near = index.query(queries)[0], index.query(queries, eps=0.5)[0]
    assert np.all(near >= exact) and np.all(near <= 1.5 * exact)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"k": 0}, "k: 0"),
        ({"k": [1, 0]}, "k: 0"),
        ({"k": []}, "k: an empty list"),
        ({"eps": -1.0}, "eps: -1"),
        ({"eps": math.nan}, "eps: NaN"),
        ({"distance_upper_bound": math.nan}, "distance_upper_bound: NaN"),
        ({"workers": 0}, "workers: 0"),
    ],
)
def test_a_wrong_argument_is_named(arguments: dict[str, Any], problem: str) -> None:
    index = wayfold.Index("R2")
    with pytest.raises(ValueError, match=problem):
        index.query(np.zeros((1, 2)), **arguments)


@pytest.mark.parametrize("k", [2.0, [1.0, 2.0], np.array([1.0]), "2", [None]])
def test_a_k_that_is_no_whole_number_is_named(k: Any) -> None:
    with pytest.raises(TypeError, match="^k: .*integer"):
        wayfold.Index("R2").query([0.0, 0.0], k)
    with pytest.raises(TypeError, match="^k: .*integer"):
        wayfold.Search(k)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_an_error_names_row_and_coordinate(workers: int) -> None:
    index = wayfold.Index("R3*SO3:0.15")
    states = np.tile([0.0, 0, 0, 0, 0, 0, 1], (6, 1))
    states[4, 2] = math.nan
    with pytest.raises(ValueError, match=r"states\[4\]\.coords\[2\]: NaN"):
        index.query(states, workers=workers)
    with pytest.raises(ValueError, match=r"states\[4\]\.coords\[2\]: NaN"):
        index.insert_many(states)
    with pytest.raises(wayfold.InvalidArgument, match="6 numbers, where a state of this space has 7") as caught:
        index.query(states[:, :6])
    assert caught.value.code == "INVALID_ARGUMENT"
    assert len(index) == 0
