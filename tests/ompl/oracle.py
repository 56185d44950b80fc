"""Compares answers with OMPL's own distance() over all vertices.

OMPL takes rotations within 1e-4 rad of each other for equal; the server computes the small angle. A distance may therefore
differ by that much where OMPL's rotations collapsed, and by rounding elsewhere. The ids must have the same order, unless two
distances are tied within that difference.
"""

from dataclasses import dataclass

import numpy as np

from problems import Roadmap

ROUNDING = 1e-9
COLLAPSED = 1e-4


class Mismatch(AssertionError):
    """The server and OMPL disagree."""


@dataclass
class Figures:
    """The counts of the comparison."""

    queries: int = 0
    neighbors: int = 0
    equal_ids: int = 0
    ties: int = 0
    collapsed: int = 0
    worst: float = 0.0
    worst_collapsed: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.queries:>6} queries, {self.neighbors:>7} neighbours: {self.equal_ids} ids equal, {self.ties} tied, "
            f"max |Δd| {self.worst:.1e} ({self.worst_collapsed:.1e} in {self.collapsed} that OMPL collapsed)"
        )


class Oracle:
    """Brute force by OMPL over a roadmap's vertices; the id of a vertex is its number."""

    def __init__(self, roadmap: Roadmap):
        self.roadmap = roadmap

    def distances(self, query, vertices: int) -> np.ndarray:
        """OMPL's distance from a state to each of the first vertices."""
        distance = self.roadmap.space.distance
        return np.fromiter((distance(query, v) for v in self.roadmap.vertices[:vertices]), float, vertices)

    def check_knn(self, figures: Figures, query, d: np.ndarray, k: int, ids, distances):
        """Compares one answer of Knn, given the query's `distances()`."""
        k = min(k, len(d))
        within = np.partition(d, k - 1)[k - 1] if k else -1.0
        self._check_order(figures, query, d, self._nearest(d, within)[:k], ids, distances)

    def check_radius(self, figures: Figures, query, d: np.ndarray, radius: float, ids, distances):
        """Compares one answer of Query: the closed ball, nearest first."""
        expected = set(np.flatnonzero(d <= radius).tolist())
        for vertex in expected.symmetric_difference(ids):
            if abs(d[vertex] - radius) > self._tolerance(query, vertex):
                raise Mismatch(f"vertex {vertex} at {d[vertex]!r} is on the wrong side of radius {radius!r}")
        # A vertex whose distance equals the radius within the tolerance may be inside or outside.
        self._check_order(figures, query, d, self._nearest(d, radius, set(ids)), ids, distances)

    @staticmethod
    def _nearest(d: np.ndarray, within: float, of: set | None = None) -> np.ndarray:
        candidates = np.flatnonzero(d <= within) if of is None else np.array(sorted(of), dtype=int)
        return candidates[np.lexsort((candidates, d[candidates]))]

    def _check_order(self, figures: Figures, query, d, expected, ids, distances):
        if len(ids) != len(expected) or len(set(ids)) != len(ids):
            raise Mismatch(f"{len(ids)} neighbours with {len(set(ids))} ids, expected {len(expected)}")
        if any(b < a for a, b in zip(distances, distances[1:])):
            raise Mismatch(f"neighbours out of order: {distances}")
        figures.queries += 1
        for vertex, found, distance in zip(expected.tolist(), ids, distances):
            tolerance = self._tolerance(query, found)
            difference = abs(d[found] - distance)
            if difference > tolerance:
                raise Mismatch(f"vertex {found}: distance {distance!r}, OMPL says {d[found]!r}")
            figures.neighbors += 1
            if tolerance == COLLAPSED:
                figures.collapsed += 1
                figures.worst_collapsed = max(figures.worst_collapsed, difference)
            else:
                figures.worst = max(figures.worst, difference)
            if found == vertex:
                figures.equal_ids += 1
            elif abs(d[found] - d[vertex]) <= tolerance + self._tolerance(query, vertex):
                figures.ties += 1
            else:
                raise Mismatch(f"vertex {found} at {d[found]!r} in the place of {vertex} at {d[vertex]!r}")

    def _tolerance(self, query, vertex: int) -> float:
        return COLLAPSED if self.roadmap.collapsed(query, self.roadmap.vertices[vertex]) else ROUNDING
