"""Processes: forks are refused, and other start methods work."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import wayfold
from conftest import Server

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


def in_fork(action: Callable[[], Any]) -> str:
    """The error that an action raises in a forked process."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        # It would wait for threads that it has not.
        signal.alarm(60)
        try:
            action()
            text = "nothing"
        except BaseException as error:
            text = f"{type(error).__name__}: {error}"
        os.write(write, text.encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    return text


def test_an_index_in_memory_is_not_used_after_a_fork() -> None:
    index = wayfold.Index("R2")
    index.insert_many(np.zeros((200, 2)))
    for action in (lambda: index.query([0.0, 0.0]), lambda: index.insert([0.0, 0.0]), lambda: len(index)):
        text = in_fork(action)
        assert text.startswith("Forked: this process was forked after an index was opened") and "'spawn'" in text
    # An index that the new process makes itself works.
    assert in_fork(lambda: wayfold.Index("R2").insert_many(np.zeros((5_000, 2)))) == "nothing"
    assert len(index) == 200


def test_an_index_of_a_server_is_not_used_after_a_fork(server: Server) -> None:
    shared = wayfold.shared(server.url, "forked", create="R2")
    remote = wayfold.remote(server.url, "forked")
    for index in (shared, remote):
        assert in_fork(lambda: index.insert([0.0, 0.0])).startswith("Forked: ")
    assert in_fork(lambda: wayfold.remote(server.url, "forked")).startswith("Forked: ")
    methods = (shared.pending, shared.status, shared.flush, shared.take_unsent, shared.close, shared.meanwhile)
    for method in (*methods, lambda: shared.wait_meanwhile(0.0), lambda: shared.__exit__(None, None, None)):
        assert in_fork(method).startswith("Forked: "), method
    assert in_fork(lambda: shared.payload_encoding).startswith("Forked: ")

    def raise_in_a_block() -> None:
        with shared:
            raise KeyError("body")

    assert in_fork(raise_in_a_block) == "KeyError: 'body'"
    shared.insert([1.0, 1.0])
    assert shared.close() == []
    remote.insert_many(np.zeros((100_000, 2)))
    scan = remote.scan()
    next(scan)
    assert in_fork(lambda: list(scan)).startswith("Forked: ")
    assert len(list(scan)) == 100_000


def nearest(index: wayfold.Index, state: list[float]) -> tuple[float, int]:
    distance, id = index.query(state)
    return float(distance), int(id)


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_workers_get_a_copy(method: str) -> None:
    index = wayfold.Index("R2")
    index.insert_many([[0.0, 0.0], [3.0, 0.0]])
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.starmap(nearest, [(index, [1.0, 0.0]), (index, [2.0, 0.0])]) == [(1.0, 0), (1.0, 1)]


def test_a_forked_worker_fails_with_a_sentence() -> None:
    global INHERITED
    INHERITED = wayfold.Index("R2")
    with multiprocessing.get_context("fork").Pool(1) as pool, pytest.raises(wayfold.Forked, match="forkserver"):
        pool.apply(inherited_length)


INHERITED: wayfold.Index


def inherited_length() -> int:
    return len(INHERITED)
