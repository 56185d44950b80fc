"""The methods of an index in memory."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wayfold


def plane() -> wayfold.Index:
    index = wayfold.Index("R2")
    index.insert([0.0, 0.0], tag=1, payload=b"origin")
    index.insert([1.0, 0.0], tag=2)
    index.insert([5.0, 0.0], id=40, payload=b"far")
    return index


def test_points_change() -> None:
    index = plane()
    assert len(index) == 3 and 40 in index and 2 not in index and not index.is_empty()
    assert index.insert([9.0, 9.0]) == 41
    with pytest.raises(wayfold.AlreadyExists):
        index.insert([0.0, 0.0], id=40)
    assert index.payload(40) == b"far" and index.payload(1) == b"" and index.payload(7) is None
    assert index.payloads([40, 1, 7]) == [b"far", b"", None] and index.payloads([]) == []
    assert index.payloads(index.scan().columns()[0]) == [b"origin", b"", b"far", b""]
    assert index.replace(40, [4.0, 0.0]) and not index.replace(7, [0.0, 0.0])
    assert index.payload(40) == b""
    assert index.set_tag(40, 2**64 - 1) and index.set_payload(40, b"x") and not index.set_tag(7, 1)
    point = index.get(40)
    assert point is not None and (point.id, point.tag, point.state.tolist()) == (40, 2**64 - 1, [4.0, 0.0])
    assert index.get(7) is None
    assert index.remove(0) and not index.remove(0)
    assert [point.id for point in index.scan()] == [1, 40, 41]
    ids, tags, states = index.scan().columns()
    assert ids.tolist() == [1, 40, 41] and tags[0] == 2 and states.shape == (3, 2)
    index.clear()
    assert len(index) == 0 and index.nearest([0.0, 0.0]) is None
    assert index.insert([0.0, 0.0]) == 42
    index.remove_all()
    assert index.is_empty() and index


def test_searches() -> None:
    index = plane()
    nearest = index.nearest([0.9, 0.0])
    assert nearest is not None and nearest.id == 1 and nearest.distance == pytest.approx(0.1)
    found = index.nearest_k([0.0, 0.0], 2)
    assert found.ids.tolist() == [0, 1] and found.distances.tolist() == [0.0, 1.0] and len(found) == 2
    assert index.nearest_r([0.0, 0.0], 1.0).ids.tolist() == [0, 1]
    assert index.nearest_r([0.0, 0.0], wayfold.ScaledRadius(1.0, max=0.5)).ids.tolist() == [0]
    assert index.search([0.0, 0.0], wayfold.Search(3, tag=(0b11, 2))).ids.tolist() == [1]
    assert index.search([0.0, 0.0], wayfold.Search(k_factor=wayfold.Scaling.K_FACTOR)).ids.tolist() == [0, 1, 40]
    many = index.search_many([[0, 0], [5, 0]], wayfold.Search(1))
    assert [found.ids.tolist() for found in many] == [[0], [40]]
    each = index.search_each([[0, 0], [5, 0]], [wayfold.Search(2), wayfold.Search(radius=0.5)])
    assert [found.ids.tolist() for found in each] == [[0, 1], [40]]
    assert [found.distances.tolist() for found in each] == [[0.0, 1.0], [0.0]]
    with pytest.raises(ValueError, match="searches: 1 of them for 2 states"):
        index.search_each([[0, 0], [5, 0]], [wayfold.Search(1)])
    with pytest.raises(ValueError, match="k, k_factor or radius"):
        wayfold.Search()


@pytest.mark.parametrize("states", [[], (), np.empty((0, 2))])
def test_no_states_are_no_error(states: Any) -> None:
    index = plane()
    ids = index.insert_many(states)
    assert ids.shape == (0,) and ids.dtype == np.int64 and len(index) == 3
    assert index.search_many(states, wayfold.Search(1)) == [] and index.search_each(states, []) == []
    with pytest.raises(ValueError, match="states"):
        index.insert([])
    with pytest.raises(ValueError, match="states"):
        index.nearest([])


def test_an_answer_says_what_it_has_seen() -> None:
    index = plane()
    found = index.nearest_k([0.0, 0.0], 1)
    inserted = index.insert_with([0.1, 0.0], wayfold.Search(10))
    assert inserted.neighbors.ids.tolist() == [0, 1, 40]
    assert index.search([0.0, 0.0], wayfold.Search(10, since=found.read_revision)).ids.tolist() == [inserted.id]
    index.remove(1)
    changes = index.changes(found.read_revision)
    assert changes is not None and changes.removed == [1]
    assert [point.id for point in changes.stored] == [inserted.id]


def test_other_forms_methods_do_nothing_in_memory() -> None:
    with plane() as index:
        index.flush()
        index.flush_within(0.0)
        assert index.pending() == 0 and index.status() is None and index.take_unsent() == []
        assert index.meanwhile().answers == [] and index.wait_meanwhile(0.0).open == 0
        assert index.close() == [] and index.form == "memory"


@pytest.mark.parametrize("way", ["pickle", "file"])
def test_a_copy_has_all_points(way: str, tmp_path: Path) -> None:
    index = plane()
    index.insert([7.0, 7.0])
    index.remove(41)
    if way == "pickle":
        copy = pickle.loads(pickle.dumps(index))
    else:
        path = tmp_path / "plane.wayfold"
        index.save(path)
        index.save(path)
        assert [path.name for path in tmp_path.iterdir()] == ["plane.wayfold"]
        with np.load(path) as file:
            assert file["ids"].dtype == file["tags"].dtype == np.uint64
        copy = wayfold.Index.load(path)
    assert copy.space == index.space
    for ours, theirs in zip(index.scan().columns(), copy.scan().columns(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [copy.payload(id) for id in (0, 1, 40)] == [b"origin", b"", b"far"]
    # No id is given twice.
    assert copy.insert([0.0, 0.0]) == index.insert([0.0, 0.0]) == 42
    empty = pickle.loads(pickle.dumps(wayfold.Index("R3*SO3")))
    assert len(empty) == 0 and empty.insert([0, 0, 0, 0, 0, 0, 1]) == 0


def test_a_saved_file_has_the_permissions_of_any_other(tmp_path: Path) -> None:
    index, (other, path, link) = plane(), (tmp_path / name for name in ("other", "plane", "link"))
    other.touch()
    index.save(path)
    assert path.stat().st_mode == other.stat().st_mode
    path.chmod(0o640)
    link.symlink_to(path)
    index.save(link)
    assert link.is_symlink() and path.stat().st_mode & 0o777 == 0o640
    assert len(wayfold.Index.load(link)) == len(index)


def test_no_point_has_an_id_out_of_range() -> None:
    index = plane()
    assert all(id not in index for id in (2**63, 2**64 - 1, 2**64))
    _, ids = index.query([0.0, 0.0], len(index) + 2)
    assert ids[-1] == -1 and ids[-1] not in index
    assert index.payloads(ids)[-2:] == [None, None]
    assert index.payloads(ids)[:-2] == [index.payload(id) for id in ids[:-2]]
    assert index.get(-1) is None and index.payload(-1) is None and index.get(2**70) is None
    assert index.get(2**127) is None and -(2**127) not in index and index.payloads([2**127]) == [None]
    assert not (index.remove(-1) or index.replace(-1, [0, 0]) or index.set_tag(-1, 1) or index.set_payload(-1, b""))


@pytest.mark.parametrize("wrong", [-1, 2**64])
def test_a_number_out_of_range_is_named(wrong: int) -> None:
    index = plane()
    calls: dict[str, Callable[[], object]] = {
        "id": lambda: index.insert([0, 0], id=wrong),
        "tag": lambda: index.insert_with([0, 0], wayfold.Search(1), tag=wrong),
        "since": lambda: index.changes(wrong),
        "dimension": lambda: wayfold.Scaling.k_bound(wrong),
        "max_pending_bytes": lambda: wayfold.shared("http://127.0.0.1:1", "none", max_pending_bytes=wrong),
    }
    for field, call in calls.items():
        with pytest.raises(wayfold.InvalidArgument, match=f"{field}: {wrong}; numbers are at least 0"):
            call()
    k = rf"k: {wrong}; it is at (least 1|most 4294967295)"
    for search in (lambda: wayfold.Search(wrong), lambda: index.nearest_k([0, 0], wrong), lambda: index.query([0, 0], wrong)):
        with pytest.raises(wayfold.InvalidArgument, match=k):
            search()
    with pytest.raises(wayfold.InvalidArgument, match=f"tag: {wrong};"):
        index.set_tag(0, wrong)
    with pytest.raises(wayfold.InvalidArgument, match=rf"tag: \({wrong}, 5\);"):
        wayfold.Search(1, tag=(wrong, 5))
    with pytest.raises(wayfold.InvalidArgument, match=f"since: {wrong};"):
        wayfold.Search(1, since=wrong)
    with pytest.raises(TypeError):
        index.insert([0, 0], tag="1")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="(?s)'float' object .* integer.*processing 'id'"):
        index.get(1.0)  # type: ignore[arg-type]
    assert len(index) == 3


def test_ids_have_one_type() -> None:
    index = plane()
    ids, tags, _ = index.scan().columns()
    assert ids.dtype == index.insert_many(np.zeros((2, 2))).dtype == np.int64 and tags.dtype == np.uint64
    rest = np.setdiff1d(ids, index.nearest_k([5.0, 0.0], 1).ids)
    assert rest.dtype == np.int64 and [index.remove(id) for id in rest] == [True, True]


def test_a_wrong_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wrong"
    path.write_bytes(b"no archive")
    with pytest.raises(wayfold.InvalidArgument, match="not the file of an index"):
        wayfold.Index.load(path)
    with open(path, "wb") as file:
        np.savez(file, states=np.zeros(3))
    with pytest.raises(ValueError, match="not the file of an index"):
        wayfold.Index.load(path)
    plane().save(path)
    content = dict(np.load(path))
    content["states"][1, 1] = np.nan
    with open(path, "wb") as file:
        np.savez(file, **content)
    with pytest.raises(ValueError, match=r"states\[1\]\.coords\[1\]: NaN"):
        wayfold.Index.load(path)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "damaged"
    plane().save(path)
    content = path.read_bytes()
    # The last 22 bytes say where the archive's directory is.
    for at in range(len(content) - 22, len(content)):
        for byte in {0, 255} - {content[at]}:
            path.write_bytes(content[:at] + bytes([byte]) + content[at + 1 :])
            try:
                wayfold.Index.load(path)
            except wayfold.InvalidArgument as error:
                assert "not the file of an index" in str(error)


@pytest.mark.parametrize(
    ("member", "old", "new"),
    [("payload_ends", b"(600,)", b"(200,)"), ("payload_ids", b"(600,)", b"(200,)"), ("ids", b"}", b"|")],
)
def test_a_damaged_header_of_a_column_is_refused(tmp_path: Path, member: str, old: bytes, new: bytes) -> None:
    path = tmp_path / "damaged"
    index = wayfold.Index("R1")
    for at in range(600):
        index.insert([at], payload=b"x")
    index.save(path)
    content = path.read_bytes()
    at = content.index(old, content.index(f"{member}.npy".encode()))
    path.write_bytes(content[:at] + new + content[at + len(old) :])
    with pytest.raises(wayfold.InvalidArgument):
        wayfold.Index.load(path)


def test_a_file_that_cannot_be_read_is_an_error_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        wayfold.Index.load(tmp_path / "missing")
    with pytest.raises(IsADirectoryError):
        wayfold.Index.load(tmp_path)


def test_searches_release_the_interpreters_lock() -> None:
    rng = np.random.default_rng(1)
    index = wayfold.Index("R6")
    index.insert_many(rng.uniform(size=(20_000, 6)))
    queries = rng.uniform(size=(3_000, 6))
    thread = threading.Thread(target=lambda: index.query(queries, 50))
    steps = 0
    thread.start()
    while thread.is_alive():
        index.insert(queries[steps % len(queries)])
        steps += 1
    # With the lock held, the search would end before this thread gets its turn.
    assert steps > 20
