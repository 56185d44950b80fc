"""Shared and remote indices on a server."""

from __future__ import annotations

import faulthandler
import math
import os
import pickle
import signal
import threading
import time
import warnings
from collections.abc import Callable

import numpy as np
import pytest

import wayfold
from conftest import Server, serving

# The longest time until a write of one process is seen by another.
MAX_WAIT_S = 30.0


def wait_for_length(index: wayfold.Index, length: int) -> None:
    end = time.monotonic() + MAX_WAIT_S
    while len(index) != length:
        assert time.monotonic() < end, f"{len(index)} points"
        time.sleep(0.005)


def test_a_dropped_index_warns_of_lost_writes() -> None:
    with serving({}) as server:
        shared = wayfold.shared(server.url, "dropped", create="R1")
        shared.insert([0.0])
        shared.flush()
    shared.insert([1.0])
    with pytest.warns(RuntimeWarning, match=r"\(1 pending\)"):
        del shared


def test_a_dropped_index_warns_of_refused_writes_and_opens_no_session(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving({"WAYFOLD_LIMITS__MAX_POINTS_PER_INDEX": "1"}) as server:
        shared = wayfold.shared(server.url, "dropped", create="R1")
        remote = wayfold.remote(server.url, "dropped")
        shared.insert_many([[0.0], [1.0]])
        with pytest.raises(wayfold.Error, match="refused a write"):
            shared.flush()
        shown: list[tuple[str, int]] = []

        def show(message: Warning | str, *_: object) -> None:
            # After the drop, a session that is being opened would be given up.
            shown.append((str(message), remote.insert([0.0])))

        monkeypatch.setattr(warnings, "showwarning", show)
        del shared
    [(text, id)] = shown
    # Each session reserves 65,536 ids.
    assert "(2 refused)" in text and id < 2 * 65_536


def test_a_warning_of_lost_writes_hides_no_exception() -> None:
    with serving({}) as server:
        opened = [wayfold.shared(server.url, "hidden", create="R1") for _ in range(2)]

    def grown(number: int) -> wayfold.Index:
        index = opened.pop()
        index.insert([0.0])
        if number == 1:
            raise KeyError(number)
        return index

    with pytest.warns(RuntimeWarning, match="pending"), pytest.raises(KeyError):
        [grown(number) for number in range(2)]


def test_an_exception_that_ends_a_block_stays_and_lost_writes_are_warned_of() -> None:
    with (
        serving({"WAYFOLD_LIMITS__MAX_POINTS_PER_INDEX": "1"}) as server,
        pytest.warns(RuntimeWarning, match=r"lost \(2\)"),
        pytest.raises(KeyError, match="body"),
        wayfold.shared(server.url, "raised", create="R1") as index,
    ):
        index.insert_many([[0.0], [1.0]])
        raise KeyError("body")


def test_a_block_whose_writes_are_all_stored_late_raises_nothing() -> None:
    with serving({}) as server:
        # The flush of the block ends before the server goes on, and the close of the index does not.
        with wayfold.shared(server.url, "late", create="R1", timeout=1.0) as index:
            os.kill(server.pid, signal.SIGSTOP)
            timer = threading.Timer(2.5, os.kill, (server.pid, signal.SIGCONT))
            timer.start()
            index.insert_many(np.arange(100.0)[:, None])
        timer.join()
        assert len(wayfold.remote(server.url, "late")) == 100


def test_all_forms_answer_alike(server: Server) -> None:
    rng = np.random.default_rng(5)
    states = np.column_stack([rng.uniform(-1, 1, (500, 2)), rng.uniform(-3, 3, 500)])
    queries = states[:20] + 0.01
    memory = wayfold.Index("R2*SO2")
    shared = wayfold.shared(server.url, "alike", create=wayfold.spaces.SE2())
    ids = shared.insert_many(states)
    for id, state in zip(ids.tolist(), states, strict=True):
        memory.insert(state, id=id)
    shared.flush()
    assert shared.pending() == 0
    remote = wayfold.remote(server.url, "alike", latest=True)
    assert (memory.form, shared.form, remote.form) == ("memory", "shared", "remote")
    for index in (shared, remote):
        assert len(index) == 500 and index.space == memory.space
        for k in (1, 7, [2, 3]):
            for ours, theirs in zip(memory.query(queries, k), index.query(queries, k), strict=True):
                np.testing.assert_array_equal(ours, theirs)
        assert index.query(queries[0]) == memory.query(queries[0])
        for radius in (0.3, np.linspace(0.0, 0.5, len(queries))):
            balls = index.query_ball_point(queries, radius, workers=2)
            assert balls.tolist() == memory.query_ball_point(queries, radius).tolist()
        _, _, rows = index.scan().columns()
        np.testing.assert_array_equal(rows, memory.scan().columns()[2])
    searches = [wayfold.Search(k) for k in range(1, len(queries) + 1)]
    for ours, theirs in zip(memory.search_each(queries, searches), shared.search_each(queries, searches), strict=True):
        np.testing.assert_array_equal(ours.ids, theirs.ids)
        np.testing.assert_array_equal(ours.distances, theirs.distances)
    with pytest.raises(ValueError, match="searches: "):
        remote.search_each(queries, searches)
    assert shared.close() == []


def test_two_shared_indices_and_a_remote_one(server: Server) -> None:
    with (
        wayfold.shared(server.url, "two", create="R2") as first,
        wayfold.shared(server.url, "two") as second,
    ):
        remote = wayfold.remote(server.url, "two")
        inserted = first.insert_with([0.0, 0.0], wayfold.Search(5), tag=3, payload=b"edges")
        assert len(inserted.neighbors) == 0
        wait_for_length(second, 1)
        answers = first.wait_meanwhile(MAX_WAIT_S)
        assert [answer.id for answer in answers.answers] == [inserted.id]
        assert second.payload(inserted.id) == b"edges" == remote.payload(inserted.id)
        for index in (first, second, remote):
            assert index.payloads([inserted.id, inserted.id + 1]) == [b"edges", None]
        changes = second.changes(0)
        assert changes is None or [point.tag for point in changes.stored] == [3]
        assert remote.remove(inserted.id)
        wait_for_length(first, 0)
        status = first.status()
        assert status is not None and status.name == "following"
        with pytest.raises(wayfold.NotInMemory, match="only an index in memory"):
            first.clear()
    with pytest.raises(wayfold.Error, match="closed"):
        first.insert([0.0, 0.0])


def test_a_flush_waits_as_long_as_it_is_told() -> None:
    with serving({}) as server:
        index = wayfold.shared(server.url, "flushed", create="R2")
        index.insert([0.0, 0.0])
        index.flush_within(MAX_WAIT_S)
        assert index.pending() == 0
    index.insert([1.0, 1.0])
    with pytest.raises(wayfold.Timeout):
        index.flush_within(0.01)
    assert [write.kind for write in index.close(0.0)] == ["put"]
    with pytest.raises(ValueError, match="timeout: -1"):
        index.flush_within(-1.0)


def test_a_signal_handler_ends_a_call_that_waits() -> None:
    def leave() -> None:
        with index:
            pass

    with serving({}) as server:
        url, name = server.url, "interrupted"
        index = wayfold.shared(url, name, create="R1", timeout=math.inf, max_pending_bytes=16_000)
        remote = wayfold.remote(url, name, timeout=math.inf)
        # Few of the rows of the first call have room.
        waits: list[Callable[[], object]] = [
            lambda: index.insert_many(np.zeros((1_000, 1))),
            index.flush,
            lambda: index.flush_within(math.inf),
            lambda: index.wait_meanwhile(math.inf),
            leave,
            lambda: len(remote),
            lambda: list(remote.scan()),
            lambda: wayfold.shared(url, name, timeout=math.inf),
            lambda: index.close(math.inf),
        ]
        # A call that is not interrupted would never end.
        faulthandler.dump_traceback_later(4 * MAX_WAIT_S, exit=True)
        handler = signal.signal(signal.SIGALRM, signal.default_int_handler)
        os.kill(server.pid, signal.SIGSTOP)
        try:
            index.insert_with([0.0], wayfold.Search(1))
            for wait in waits:
                signal.setitimer(signal.ITIMER_REAL, 0.2)
                with pytest.raises(KeyboardInterrupt) as caught:
                    wait()
                if wait is waits[0]:
                    partial = caught.value.__cause__
        finally:
            os.kill(server.pid, signal.SIGCONT)
            signal.signal(signal.SIGALRM, handler)
            faulthandler.cancel_dump_traceback_later()
        assert isinstance(partial, wayfold.Error) and partial.reason == "PARTIAL" and 0 < partial.done < 1_000
        # The writes were pending all the time.
        assert index.close(MAX_WAIT_S) == [] and len(remote) == 1 + partial.done


def test_an_insert_that_fails_in_an_outage_tells_its_stored_rows() -> None:
    states = np.arange(100_000.0)[:, None]
    with serving({}) as server:
        index = wayfold.shared(server.url, "outage", create="R1", timeout=3.0)
        index.insert([-1.0])
        index.flush()
    with pytest.raises(wayfold.Timeout, match="of 100000 took effect") as caught:
        index.insert_many(states)
    error = pickle.loads(pickle.dumps(caught.value))
    assert (error.code, error.reason) == ("DEADLINE_EXCEEDED", "PARTIAL")
    assert 0 < error.done == len(index) - 1 < len(states)
    ids, _, rows = index.scan().columns()
    assert ids[1:].tolist() == error.ids
    np.testing.assert_array_equal(rows[1:], states[: error.done])
    assert [write.id for write in index.close(0.0)] == error.ids


def test_an_insert_of_which_a_part_is_refused_tells_its_stored_rows() -> None:
    limits = {"WAYFOLD_LIMITS__MAX_ROWS_PER_CALL": "1000", "WAYFOLD_LIMITS__MAX_POINTS_PER_INDEX": "2500"}
    with serving(limits) as server:
        index = wayfold.remote(server.url, "refused", create="R1")
        message = "rows 0 to 1999 of 3000 took effect; then: .*, reason QUOTA_EXCEEDED$"
        with pytest.raises(wayfold.Error, match=message) as caught:
            index.insert_many(np.arange(3_000.0)[:, None])
        error = caught.value
        assert (error.code, error.reason, error.done) == ("RESOURCE_EXHAUSTED", "PARTIAL", 2_000)
        assert error.ids == [point.id for point in index.scan()]
        with pytest.raises(wayfold.Error) as caught:
            index.insert_many(np.arange(1_000.0)[:, None])
        assert (caught.value.reason, caught.value.done, caught.value.ids) == ("QUOTA_EXCEEDED", 0, [])


def test_errors_have_classes(server: Server) -> None:
    with pytest.raises(wayfold.NotFound) as caught:
        wayfold.shared(server.url, "nowhere")
    assert caught.value.code == "NOT_FOUND" and caught.value.reason
    assert pickle.loads(pickle.dumps(caught.value)).reason == caught.value.reason
    wayfold.remote(server.url, "other", create="R2")
    with pytest.raises(wayfold.AlreadyExists):
        wayfold.remote(server.url, "other", create="R3")
    wayfold.shared(server.url, "declared", create="R2", payload_encoding="edges")
    with pytest.raises(wayfold.AlreadyExists, match="PAYLOAD_ENCODING_EDGES, not PAYLOAD_ENCODING_WEIGHTED_EDGES"):
        wayfold.remote(server.url, "declared", create="R2", payload_encoding="weighted-edges")
    for create in ("R2", None):
        with pytest.raises(ValueError, match="payload_encoding: \"lines\" is neither"):
            wayfold.remote(server.url, "declared", create=create, payload_encoding="lines")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="payload_encoding: only an index to create"):
        wayfold.shared(server.url, "declared", payload_encoding="edges")
    with pytest.raises(ValueError, match="not the address of a server"):
        wayfold.remote("no address", "other")
    with pytest.raises(ConnectionError):
        wayfold.remote("http://127.0.0.1:1", "other", timeout=0.5)
    with pytest.raises(ValueError, match="token: it has characters that no token has"):
        wayfold.remote(server.url, "other", token="two\nlines")
    with pytest.raises(ValueError, match="timeout: -1"):
        wayfold.remote(server.url, "other", timeout=-1)


@pytest.mark.parametrize("encoding", ["edges", "weighted-edges", None])
def test_an_index_tells_how_its_payloads_hold_edges(server: Server, encoding: object) -> None:
    name = f"payloads-{encoding}".lower()
    created = wayfold.remote(server.url, name, create="R2", payload_encoding=encoding)  # type: ignore[arg-type]
    for index in (created, wayfold.remote(server.url, name), wayfold.shared(server.url, name)):
        assert index.payload_encoding == encoding
    assert wayfold.Index("R2").payload_encoding is None


@pytest.mark.parametrize("opened", [wayfold.shared, wayfold.remote])
def test_an_index_of_a_server_is_not_pickled(server: Server, opened: object) -> None:
    index = opened(server.url, "pickled", create="R2")  # type: ignore[operator]
    with pytest.raises(TypeError, match="open it in the other process by its name"):
        pickle.dumps(index)
