"""The exceptions of the package."""

from __future__ import annotations

from collections.abc import Sequence


class Error(Exception):
    """The error of a call. `code` is the gRPC status code or the nearest one, `reason` the server's reason or empty.

    The reason PARTIAL means that an insert stored the first `done` of its rows, under `ids`, before it failed; `ids` is
    empty if the answer was too large to read. Otherwise `done` is 0.
    """

    def __init__(
        self, message: str, code: str = "UNKNOWN", reason: str = "", done: int = 0, ids: Sequence[int] = ()
    ) -> None:
        super().__init__(message)
        self.code = code
        self.reason = reason
        self.done = done
        self.ids = list(ids)

    def __reduce__(self) -> tuple[type[Error], tuple[str, str, str, int, list[int]]]:
        return type(self), (str(self), self.code, self.reason, self.done, self.ids)


class InvalidArgument(Error, ValueError):
    """An argument is wrong. The message names the row and the coordinate of a state, as `states[37].coords[3]: NaN`."""


class AlreadyExists(Error, ValueError):
    """The id is taken, or the index exists with another space or encoding of payloads."""


class NotFound(Error, LookupError):
    """There is no such index."""


class Timeout(Error, TimeoutError):
    """A call had no answer in time, or a search did not end in time."""


class Unavailable(Error, ConnectionError):
    """The server cannot be reached, or cannot answer now."""


class NotInMemory(Error):
    """The call is for indices in memory only."""


class Forked(Error, RuntimeError):
    """The index belongs to the process before a fork."""


_REMEDY = (
    "; start the process with multiprocessing's 'spawn' or 'forkserver' method, and hand an index in memory over as an"
    " argument, which pickles it"
)

_KINDS: dict[str, type[Error]] = {
    "INVALID_ARGUMENT": InvalidArgument,
    "OUT_OF_RANGE": InvalidArgument,
    "ALREADY_EXISTS": AlreadyExists,
    "NOT_FOUND": NotFound,
    "DEADLINE_EXCEEDED": Timeout,
    "UNAVAILABLE": Unavailable,
    "NOT_IN_MEMORY": NotInMemory,
    "FORKED": Forked,
}


def make(kind: str, code: str, reason: str, message: str, done: int = 0, ids: Sequence[int] = ()) -> Error:
    """The exception for an error of the extension."""
    remedy = _REMEDY if kind == "FORKED" else ""
    return _KINDS.get(kind, Error)(message + remedy, code, reason, done, ids)
