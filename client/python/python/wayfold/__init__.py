"""Exact, dynamic nearest-neighbour indices for motion planners.

`Index(space)` is in memory, `shared(url, name)` keeps a copy of a server's index in step with others', and
`remote(url, name)` calls a server.
"""

from . import spaces
from ._errors import AlreadyExists, Error, Forked, InvalidArgument, NotFound, NotInMemory, Timeout, Unavailable
from ._wayfold import (
    Changes,
    ConnectionStatus,
    Index,
    InsertedPoint,
    Meanwhile,
    MeanwhileAnswers,
    Neighbor,
    ScaledRadius,
    Scaling,
    Search,
    SearchResult,
    Space,
    StoredPoint,
    StoredPoints,
    UnsentWrite,
    remote,
    shared,
)

__all__ = [
    "AlreadyExists",
    "Changes",
    "ConnectionStatus",
    "Error",
    "Forked",
    "Index",
    "InsertedPoint",
    "InvalidArgument",
    "Meanwhile",
    "MeanwhileAnswers",
    "Neighbor",
    "NotFound",
    "NotInMemory",
    "ScaledRadius",
    "Scaling",
    "Search",
    "SearchResult",
    "Space",
    "StoredPoint",
    "StoredPoints",
    "Timeout",
    "Unavailable",
    "UnsentWrite",
    "remote",
    "shared",
    "spaces",
]
