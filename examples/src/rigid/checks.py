"""The scene of the program `rigid`, for planners in Python: the functions of `abi.rs`, called by ctypes.

    cargo build --release -p wayfold-examples --example rigid-checks
"""

import ctypes
import json
import sys
from pathlib import Path

FREE, NOT_FREE = 1, 0


class Scene:
    """The library's answers about the scene. It counts the states that it checks."""

    def __init__(self, programs: Path):
        """`programs` is the directory into which cargo puts programs, and in it `examples`."""
        suffix = {"darwin": "dylib"}.get(sys.platform, "so")
        self._library = library = ctypes.CDLL(str(Path(programs, "examples", f"librigid_checks.{suffix}").resolve()))
        library.rigid_problem.restype = ctypes.c_char_p
        problem = json.loads(library.rigid_problem())
        self.space, self.coordinates = problem["space"], problem["coordinates"]
        self.bounds, self.resolution, self.tasks = problem["bounds"], problem["resolution"], problem["tasks"]

        self._row = row = ctypes.c_double * self.coordinates
        numbers, size = ctypes.POINTER(ctypes.c_double), ctypes.c_size_t
        library.rigid_canonicalize.argtypes = [numbers, size]
        library.rigid_is_free.argtypes = [numbers, size]
        library.rigid_is_free_way.argtypes = [numbers, numbers, size, ctypes.POINTER(ctypes.c_uint64)]
        library.rigid_distance.argtypes = [numbers, numbers, size]
        library.rigid_distance.restype = ctypes.c_double
        library.rigid_is_free_path.argtypes = [numbers, size, size]
        assert ctypes.sizeof(row) == 8 * self.coordinates
        self._checks = ctypes.c_uint64(0)
        self._checks_at = ctypes.byref(self._checks)

    @property
    def checks(self) -> int:
        """How many states were checked since it was made."""
        return self._checks.value

    def row(self, numbers):
        """A row as the library takes it: where it is asked about more than once, it need not be made again."""
        return numbers if type(numbers) is self._row else self._row(*numbers)

    def canonical(self, row) -> list[float]:
        """The row as the server keeps it."""
        numbers = self._row(*row)
        if self._library.rigid_canonicalize(numbers, len(numbers)) != FREE:
            raise ValueError(f"{row} is no state")
        return list(numbers)

    def is_free(self, row) -> bool:
        """True if a state is free."""
        self._checks.value += 1
        return self._free(self._library.rigid_is_free(self.row(row), self.coordinates))

    def is_free_way(self, a, b) -> bool:
        """True if the motion between two free states is free: a function of the two, in this order."""
        a, b = self.row(a), self.row(b)
        return self._free(self._library.rigid_is_free_way(a, b, self.coordinates, self._checks_at))

    def distance(self, a, b) -> float:
        """The distance in the space's metric."""
        return self._library.rigid_distance(self.row(a), self.row(b), self.coordinates)

    def is_free_path(self, path) -> bool:
        """True if a path is free by a finer check and other code, which is not counted."""
        numbers = [number for row in path for number in row]
        rows = (ctypes.c_double * len(numbers))(*numbers)
        return self._free(self._library.rigid_is_free_path(rows, len(path), self.coordinates))

    def nothing(self, row) -> bool:
        """Calls the library where there is nothing to check: what a call costs by itself."""
        return self._free(self._library.rigid_is_free_path(self.row(row), 0, self.coordinates))

    @staticmethod
    def _free(verdict: int) -> bool:
        if verdict not in (FREE, NOT_FREE):
            raise ValueError("a checked row is not a state of the space")
        return verdict == FREE
