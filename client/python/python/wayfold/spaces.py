"""Configuration spaces by name: `SE3(weight=0.15)` is the space of the text `R3*SO3:0.15`.

A weight in a product multiplies the squared distance of its factor; in a sum it multiplies the distance.
"""

from __future__ import annotations

from ._wayfold import Space

__all__ = ["OMPL_SE2", "OMPL_SE3", "SE2", "SE3", "SO2", "SO3", "R", "Space", "joints", "product", "sum", "torus"]


def R(n: int) -> Space:
    """Vectors of n numbers with the Euclidean distance."""
    return Space(f"R{n}")


def SO2(period: float | None = None) -> Space:
    """An angle, of period 2π unless given."""
    return Space("SO2" if period is None else f"SO2[{float(period)!r}]")


def SO3() -> Space:
    """A rotation as a unit quaternion x, y, z, w. Its distance is half the angle of the rotation between two."""
    return Space("SO3")


def SE2(*, weight: float = 1.0) -> Space:
    """x, y and an angle; `weight` multiplies the squared distance of the angle."""
    return product(R(2), (SO2(), weight))


def SE3(*, weight: float = 0.15) -> Space:
    """x, y, z and a rotation; `weight` multiplies the squared distance of the rotation."""
    return product(R(3), (SO3(), weight))


def torus(n: int) -> Space:
    """n angles in one product."""
    return Space(f"SO2^{n}")


def joints(n: int) -> Space:
    """A joint group of MoveIt: n numbers, whose distances are added."""
    return Space(f"sum(R1^{n})")


def OMPL_SE2() -> Space:
    """OMPL's `SE2StateSpace`."""
    return Space("ompl-se2")


def OMPL_SE3() -> Space:
    """OMPL's `SE3StateSpace`."""
    return Space("ompl-se3")


def product(*factors: Space | str | tuple[Space | str, float]) -> Space:
    """The product of factors, or of pairs of a factor and its weight: the root of the sum of weighted squares.

    A factor is a space, or its text; a product counts as one factor.
    """
    return Space("*".join(_terms(factors)))


def sum(*groups: Space | str | tuple[Space | str, float]) -> Space:
    """The sum of the distances of groups, or of pairs of a group and its weight. A group is a space, or its text."""
    return Space(f"sum({', '.join(_terms(groups))})")


def _terms(parts: tuple[Space | str | tuple[Space | str, float], ...]) -> list[str]:
    terms = []
    for part in parts:
        space, weight = part if isinstance(part, tuple) else (part, 1.0)
        # Without parentheses a weight would count for the last factor only, and the factors of a group as groups.
        term = f"({Space(space) if isinstance(space, str) else space})"
        terms.append(term if weight == 1.0 else f"{term}:{float(weight)!r}")
    return terms
