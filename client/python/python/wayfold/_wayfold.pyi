"""The extension module."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from os import PathLike
from types import TracebackType
from typing import Any, ClassVar, Literal, Protocol, TypeAlias, type_check_only

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

@type_check_only
class _Rotation(Protocol):
    """A rotation of scipy."""

    def as_quat(self) -> Any: ...

@type_check_only
class _RigidTransform(Protocol):
    """A rigid transform of scipy."""

    def as_components(self) -> Any: ...

# One state or many: an array of shape (..., m), a rotation, or the parts of states with a rotation among them.
_Parts: TypeAlias = tuple[npt.ArrayLike | _Rotation, ...]
_States: TypeAlias = npt.ArrayLike | _Rotation | _RigidTransform | _Parts | Sequence[_Rotation | _RigidTransform | _Parts]
_Ids: TypeAlias = npt.NDArray[np.int64]
_Floats: TypeAlias = npt.NDArray[np.float64]
_Unsigned: TypeAlias = npt.NDArray[np.uint64]

class Space:
    """A configuration space with its metric, made of its text, such as `R3*SO3:0.15`."""

    def __new__(cls, text: str) -> Self: ...
    @property
    def text(self) -> str: ...
    @property
    def coordinates(self) -> int:
        """The number of coordinates of a state."""
    @property
    def dimension(self) -> int:
        """The dimension of the space as a manifold: 6 for SE(3), whose states have 7 coordinates."""
    @property
    def names(self) -> tuple[str, ...]:
        """A name for each coordinate."""
    def distance(self, a: _States, b: _States) -> float:
        """The distance of two states."""
    def canonicalize(self, state: _States) -> _Floats:
        """The state in canonical form."""
    def __eq__(self, other: object) -> bool: ...
    def __hash__(self) -> int: ...

class ScaledRadius:
    """The radius of PRM* and RRT*: r(n) = min(max, factor · (ln n / n)^(1/d))."""

    def __new__(cls, factor: float, *, max: float | None = None) -> Self: ...

class Scaling:
    """The factors of the number of neighbours and of the radius that the literature proves."""

    K_FACTOR: ClassVar[float]
    @staticmethod
    def k_bound(dimension: int) -> float: ...
    @staticmethod
    def prm_star_bound(dimension: int, free_volume: float) -> float: ...
    @staticmethod
    def rrt_star_bound(dimension: int, free_volume: float) -> float: ...

class Search:
    """A search: the number of neighbours, the radius, and the points that count.

    `tag` is a mask and a value: points with `tag & mask == value` count. `since` is the `read_revision` of an
    earlier answer: only points that it could not find count. `timeout` is in seconds.
    """

    def __new__(
        cls,
        k: int | None = None,
        *,
        k_factor: float | None = None,
        radius: float | ScaledRadius | None = None,
        tag: tuple[int, int] | None = None,
        since: int | None = None,
        epsilon: float = 0.0,
        timeout: float | None = None,
    ) -> Self: ...

class Neighbor:
    """A stored point and its distance."""

    @property
    def id(self) -> int: ...
    @property
    def distance(self) -> float: ...

class SearchResult:
    """The neighbours of a state, nearest first and at equal distances by id."""

    @property
    def ids(self) -> _Ids: ...
    @property
    def distances(self) -> _Floats: ...
    @property
    def read_revision(self) -> int: ...
    def __len__(self) -> int: ...

class InsertedPoint:
    """The id of an inserted point, and the neighbours that its insert found."""

    @property
    def id(self) -> int: ...
    @property
    def neighbors(self) -> SearchResult: ...

class StoredPoint:
    """One stored point, its state in canonical form."""

    @property
    def id(self) -> int: ...
    @property
    def tag(self) -> int: ...
    @property
    def state(self) -> _Floats: ...

class StoredPoints(Iterator[StoredPoint]):
    """All points of an index as they were when the scan began."""

    def __iter__(self) -> Self: ...
    def __next__(self) -> StoredPoint: ...
    def columns(self) -> tuple[_Ids, _Unsigned, _Floats]:
        """The ids, the tags and the states of the points that the iterator has not returned."""

class Changes:
    """Everything that changed after an earlier answer."""

    @property
    def stored(self) -> list[StoredPoint]: ...
    @property
    def removed(self) -> list[int]: ...
    @property
    def read_revision(self) -> int: ...

class Meanwhile:
    """An own point's place in the index's order, and the neighbours that its insert could not see, or left out because its
    scaled `k` was smaller then."""

    @property
    def id(self) -> int: ...
    @property
    def points_before(self) -> int: ...
    @property
    def ids(self) -> _Ids: ...
    @property
    def distances(self) -> _Floats: ...
    @property
    def is_superset(self) -> bool: ...

class MeanwhileAnswers:
    """The answers to the searches of inserts, as far as the server has stored the points."""

    @property
    def answers(self) -> list[Meanwhile]: ...
    @property
    def open(self) -> int: ...
    @property
    def has_dropped(self) -> bool: ...

class ConnectionStatus:
    """The state of a shared index's connection."""

    @property
    def name(self) -> Literal["following", "reloading", "disconnected", "refused", "ended", "closed", "unknown"]: ...
    @property
    def behind(self) -> int | None: ...
    @property
    def why(self) -> str | None: ...

class UnsentWrite:
    """A write that was not sent, or that the server refused."""

    @property
    def kind(self) -> Literal["put", "replace", "remove", "set_tag", "set_payload"]: ...
    @property
    def id(self) -> int: ...
    @property
    def tag(self) -> int | None: ...
    @property
    def state(self) -> _Floats | None: ...
    @property
    def payload(self) -> bytes | None: ...

class Index:
    """A dynamic set of states with exact nearest-neighbour search, in memory unless `shared` or `remote` opened it.

    Any number of threads may call it, and every call releases the interpreter's lock. With `inline`, an insert that
    fills a level merges it itself, and no thread is started.
    """

    def __new__(cls, space: str | Space, *, inline: bool = False) -> Self: ...
    @property
    def space(self) -> Space: ...
    @property
    def form(self) -> Literal["memory", "shared", "remote"]: ...
    @property
    def payload_encoding(self) -> Literal["edges", "weighted-edges"] | None:
        """How the payloads hold edges, as the index declared when it was created: see `shared`. None in memory, and if it
        declares nothing."""
    def __len__(self) -> int: ...
    def __bool__(self) -> Literal[True]: ...
    def __contains__(self, id: int) -> bool: ...
    def is_empty(self) -> bool: ...
    def insert(self, state: _States, *, id: int | None = None, tag: int = 0, payload: bytes | None = None) -> int:
        """Stores a state and returns its id.

        It fails if a point has the given `id`, which is below 2^63. A shared index looks in its copy: of two processes
        that store the same id at once, the later one replaces the point, and both calls succeed. Ids in a block that the
        server reserved for another process are refused, which ends the writes of this one until `take_unsent`. Choose a
        range above all assigned ids, well below 2^63, then store and flush its last id first: the server assigns only
        greater ids from then on, and the ids below it stay the caller's.
        """
    def insert_with(
        self, state: _States, search: Search, *, id: int | None = None, tag: int = 0, payload: bytes | None = None
    ) -> InsertedPoint:
        """Stores a state, and searches the points before it at once. `insert` tells about ids.

        A remote index does not end this search by its `timeout`, but by that of the call.
        """
    def insert_many(self, states: _States) -> _Ids:
        """Stores many states at once and returns their ids, which ascend.

        An index in memory stores all or none. The other forms may divide many rows, and a part may fail after others were
        stored. The `reason` of the error is PARTIAL then, and its `done` and `ids` tell the stored rows, from the first
        on. Repeat only the rows after them: a repeated row is a second point. The next rows of a remote insert may be
        stored too if the `code` is DEADLINE_EXCEEDED, CANCELLED, UNKNOWN, INTERNAL, DATA_LOSS or UNAVAILABLE: look before
        you repeat them. If a shared index was closed, or the server refused its writes, those of the stored rows that the
        server had not taken are among the unsent writes instead.
        """
    def remove(self, id: int) -> bool:
        """Removes a point. False if there is none with this id."""
    def replace(self, id: int, state: _States) -> bool:
        """Moves a point; it keeps its tag and loses its payload. False if there is none with this id.

        A remote index makes two calls: a tag that another process sets between them is lost, and a removal is undone. It
        returns True then too.
        """
    def set_tag(self, id: int, tag: int) -> bool:
        """Sets the tag of a point. False if there is none with this id."""
    def set_payload(self, id: int, payload: bytes) -> bool:
        """Sets the payload of a point. False if there is none with this id."""
    def get(self, id: int) -> StoredPoint | None:
        """The point with this id."""
    def payload(self, id: int) -> bytes | None:
        """The payload of a point: empty if it has none, None if there is no such point."""
    def payloads(self, ids: Sequence[int] | _Ids | _Unsigned) -> list[bytes | None]:
        """The payloads of points, in their order: empty without one, None if there is no such point."""
    def nearest(self, state: _States) -> Neighbor | None:
        """The nearest point; None if there are no points."""
    def nearest_k(self, state: _States, k: int) -> SearchResult:
        """The `k` nearest points, nearest first."""
    def nearest_r(self, state: _States, radius: float | ScaledRadius) -> SearchResult:
        """All points at distance `radius` or nearer, nearest first."""
    def search(self, state: _States, search: Search) -> SearchResult:
        """Answers any search."""
    def search_many(self, states: _States, search: Search) -> list[SearchResult]:
        """Answers a search of many states, which see the same points.

        A remote index divides more than 1,000 states, or a large answer, among calls, which may see different
        revisions: take the least `read_revision` for `since`.
        """
    def search_each(self, states: _States, searches: Sequence[Search]) -> list[SearchResult]:
        """Answers a search for each of many states, which see the same points. A remote index takes only one search."""
    def scan(self) -> StoredPoints:
        """All points as they are now, by ascending id."""
    def changes(self, since: int) -> Changes | None:
        """Everything that changed after the revision that an earlier answer read; None if some of it is forgotten."""
    def clear(self) -> None:
        """Forgets all points of an index in memory; their ids stay used."""
    def remove_all(self) -> None:
        """Removes all points that the index has now, for everybody: it reads all their ids first."""
    def query(
        self,
        x: _States,
        k: int | Iterable[int] = 1,
        *,
        eps: float = 0.0,
        distance_upper_bound: float = ...,
        workers: int = 1,
    ) -> tuple[Any, Any]:
        """The distances and the ids of the nearest neighbours, as scipy's `KDTree.query`.

        (..., m) in, (..., k) out, squeezed for k = 1. A missing neighbour has the distance inf and the id −1. `k` may
        be a list of ranks from 1. `workers` threads search, but at most one for each processor, as with −1. An answer
        that no memory holds is a `MemoryError`. The server of a remote index refuses a `k` above its `limits.max_k`,
        10,000 by default, also if the index has fewer points.
        """
    def query_ball_point(
        self,
        x: _States,
        r: npt.ArrayLike,
        *,
        eps: float = 0.0,
        workers: int = 1,
        return_sorted: bool | None = None,
        return_length: bool = False,
    ) -> Any:
        """The ids of all points at distance `r` or nearer, as scipy's `KDTree.query_ball_point`.

        A remote index asks for the greatest of several radii, and leaves out what is too far here.
        """
    def flush(self) -> None:
        """Waits until the server has acknowledged every write before this call. At once for the other forms."""
    def flush_within(self, timeout: float) -> None:
        """Acts like `flush`, but waits at most `timeout` seconds instead of the index's own timeout."""
    def pending(self) -> int:
        """The number of writes that the server has not acknowledged; 0 for the other forms."""
    def status(self) -> ConnectionStatus | None:
        """The state of a shared index's connection; None for the other forms."""
    def meanwhile(self) -> MeanwhileAnswers:
        """The answers about own points that were inserted with a search."""
    def wait_meanwhile(self, timeout: float) -> MeanwhileAnswers:
        """Acts like `meanwhile`, but waits for an answer, at most `timeout` seconds, if one is to come."""
    def take_unsent(self) -> list[UnsentWrite]:
        """Every write from the first one on that the server refused for good, in order.

        The server may have taken the first batch of them: after the reconnection look whether its points are there.
        Store a put again without its id if the index assigned it: the id stays reserved for the session that ended.
        """
    def close(self, timeout: float = 30.0) -> list[UnsentWrite]:
        """Takes no more writes, waits for the pending ones, and returns those that are not acknowledged in time."""
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Flushes and closes; raises if the server does not take the writes in time. They are lost then.

        If an exception ends the block, it only closes, and the exception stays: writes that the server does not take
        within 30 s are lost, with a `RuntimeWarning`.
        """
    def save(self, path: str | PathLike[str]) -> None:
        """Writes all points of an index in memory to a file. No other thread should write meanwhile."""
    @classmethod
    def load(cls, path: str | PathLike[str]) -> Index:
        """The index in memory that `save` wrote to a file."""
    def __reduce__(self) -> tuple[Callable[..., Index], tuple[Any, ...]]: ...

def shared(
    url: str,
    name: str,
    *,
    create: str | Space | None = None,
    payload_encoding: Literal["edges", "weighted-edges"] | None = None,
    timeout: float = 30.0,
    max_pending_bytes: int = 16 << 20,
    token: str | None = None,
    ca_certificate: bytes | None = None,
    client_certificate: tuple[bytes, bytes] | None = None,
) -> Index:
    """The index of this name on a server, with a copy of it in this process.

    `create` is the space to create it with if it is missing, and `payload_encoding` tells programs that show it how its
    payloads hold edges: "edges" are the ids at the other ends, 8 bytes each, little-endian; "weighted-edges" are 16 bytes
    each, the id and the cost (float64). The certificates and the key are PEM.
    """

def remote(
    url: str,
    name: str,
    *,
    create: str | Space | None = None,
    payload_encoding: Literal["edges", "weighted-edges"] | None = None,
    timeout: float = 30.0,
    latest: bool = False,
    token: str | None = None,
    ca_certificate: bytes | None = None,
    client_certificate: tuple[bytes, bytes] | None = None,
) -> Index:
    """The index of this name on a server, without a copy: each call goes to the server.

    With `latest`, reads see all that any server of a cluster acknowledged before; otherwise they see the caller's own
    writes, and may lag behind those of others.
    """

def _restore(
    space: str | Space,
    inline: bool,
    next_id: int,
    ids: _Unsigned,
    tags: _Unsigned,
    states: _Floats,
    holders: _Unsigned,
    ends: _Unsigned,
    payloads: bytes,
) -> Index: ...
def _seconds_in_rust(index: Index, states: _States, k: int, is_one_call: bool) -> float: ...
