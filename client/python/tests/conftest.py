"""A server for the tests that need one."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

# The longest time for the server to stop, after which the test fails.
MAX_WAIT_S = 60


@dataclass(frozen=True)
class Server:
    """A running server: its addresses and its process."""

    url: str
    locator: str
    pid: int


@contextmanager
def serving(settings: Mapping[str, str]) -> Iterator[Server]:
    """A server on free ports of this machine, with its indices in memory. `settings` are variables of its environment."""
    binary = os.environ.get("WAYFOLD_SERVER_BINARY")
    if binary is None:
        pytest.skip("WAYFOLD_SERVER_BINARY names no server")
    arguments = ["--grpc", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0", "--data", "memory", "--log", "warn"]
    environment = {**os.environ, "WAYFOLD_HTTP__LISTEN": "off", **settings}
    environment.pop("WAYFOLD_SERVER_BINARY")
    process = subprocess.Popen([binary, *arguments], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    try:
        addresses = []
        for _ in range(2):
            line = process.stdout.readline().strip()
            assert line.startswith("listening on "), line
            addresses.append(line.removeprefix("listening on "))
        url, locator = addresses
        yield Server(url, locator, process.pid)
    finally:
        process.terminate()
        process.stdout.read()
        process.wait(MAX_WAIT_S)


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A server that everyone may call."""
    with serving({}) as server:
        yield server
