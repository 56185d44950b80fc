"""The types that an index takes as a state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import wayfold
from wayfold import spaces


def test_rotations_of_scipy_are_states_of_so3() -> None:
    rotations = Rotation.random(20, np.random.default_rng(3))
    index = wayfold.Index(spaces.SO3())
    ids = index.insert_many(rotations)
    assert ids.tolist() == list(range(20))
    distances, found = index.query(rotations)
    assert found.tolist() == ids.tolist() and np.all(distances < 1e-7)
    one = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    distance, id = index.query(one)
    halves = (rotations * one.inv()).magnitude() / 2
    assert id == halves.argmin() and distance == pytest.approx(halves.min())
    assert index.insert_many([one, one]).tolist() == [20, 21]


def test_a_translation_and_a_rotation_are_a_state_of_se3() -> None:
    index = wayfold.Index(spaces.SE3())
    turn = Rotation.from_euler("z", 90, degrees=True)
    id = index.insert(([1.0, 2.0, 3.0], turn))
    point = index.get(id)
    assert point is not None
    np.testing.assert_allclose(point.state, [1, 2, 3, 0, 0, 0.5**0.5, 0.5**0.5])
    many = index.insert_many((np.zeros((4, 3)), Rotation.random(4)))
    assert many.shape == (4,)
    # One rotation for all translations, and a list of pairs.
    assert index.query((np.zeros((2, 5, 3)), turn))[0].shape == (2, 5)
    assert index.insert_many([([0, 0, 0], turn), ([1, 1, 1], turn)]).shape == (2,)


def test_a_tuple_of_rotations_is_a_state_of_as_many() -> None:
    index = wayfold.Index("SO3*SO3")
    one, two = Rotation.from_euler("xz", [[10, 0], [0, 20]], degrees=True)
    assert index.insert_many([(one, two), (two, one)]).tolist() == [0, 1]
    assert index.query((two, one))[1] == 1
    assert index.query((Rotation.concatenate([two, one]), one))[1].tolist() == [1, 0]


def test_rigid_transforms_of_scipy_are_states_of_se3() -> None:
    index = wayfold.Index(spaces.SE3())
    turns = Rotation.from_euler("z", [[0], [90]], degrees=True)
    poses = RigidTransform.from_components([[1, 2, 3], [4, 5, 6]], turns)
    assert index.insert_many(poses).tolist() == [0, 1]
    assert index.insert_many([poses[0], poses[1]]).tolist() == [2, 3]
    assert index.query(poses[1], 2)[1].tolist() == [1, 3]
    _, _, found = index.scan().columns()
    np.testing.assert_array_equal(found[:2], found[2:])


def test_a_rotation_in_the_wrong_place_is_refused() -> None:
    index = wayfold.Index(spaces.SE3())
    with pytest.raises(ValueError, match="a rotation, 3 numbers, where a state of this space is x, y, z, qx"):
        index.insert((Rotation.identity(), [1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match="a rotation, where"):
        index.query(Rotation.identity())
    with pytest.raises(ValueError, match="where one state belongs"):
        index.insert(np.zeros((2, 7)))
    with pytest.raises(ValueError, match="states: a number"):
        index.query(1.0)
    with pytest.raises(ValueError, match="states: "):
        index.query([[0, 0, 0], [1]])


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", ">i4"])
@pytest.mark.parametrize("packed", [True, False])
def test_numbers_are_read_wherever_they_lie(dtype: str, packed: bool) -> None:
    # One byte before the numbers: a row of the packed structure is no multiple of the size of a number.
    table = np.zeros(50, np.dtype([("flag", "i1"), ("state", dtype, (3,))], align=not packed))
    table["state"] = np.arange(150).reshape(50, 3)
    plain = np.arange(150.0).reshape(50, 3)
    index = wayfold.Index("R3")
    assert index.insert_many(table["state"]).shape == (50,)
    np.testing.assert_array_equal(index.scan().columns()[2], plain)
    for row in (0, 1, 49):
        assert index.query(table["state"][row]) == (0.0, row)
        assert index.query(table["state"][row, ::-1]) == index.query(plain[row, ::-1])
    np.testing.assert_array_equal(index.query(table["state"][::-2])[1], np.arange(49, -1, -2))
    column = wayfold.Index("R1")
    assert column.insert_many(table["state"][:, 1:2]).tolist() == list(range(50))
    assert column.query(table["state"][7, 1:2]) == (0.0, 7)


@pytest.mark.parametrize(
    ("state", "problem"),
    [
        (np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]), "masked"),
        ([np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False])], "masked"),
        (np.array([1 + 2j, 2, 3]), "complex128, where real numbers"),
        ([1 + 2j, 2, 3], "complex128, where real numbers"),
        (np.array([1, 2, 3], "M8[s]"), "datetime64.*, where real numbers"),
        (np.array([1, 2, 3], "m8[s]"), "timedelta64.*, where real numbers"),
        ([np.datetime64(5, "s"), 2, 3], "datetime64.*, where real numbers"),
        (np.array([np.timedelta64(5, "s"), 2, 3], object), "timedelta64.*, where real numbers"),
        (np.array([np.complex128(1 + 2j), 2, 3], object), "complex128, where real numbers"),
        ([10**400, 0, 0], "too large"),
        (["a", 2, 3], "could not convert"),
        ((["a"], Rotation.identity()), "could not convert"),
        ((np.zeros((5, 3)), Rotation.random(4)), "broadcast"),
        ([([0, 0, 0], Rotation.identity()), [0, 0, 0]], "same shape"),
    ],
)
def test_what_is_no_row_of_numbers_is_refused(state: Any, problem: str) -> None:
    index = wayfold.Index("R3*SO3" if "Rotation" in repr(state) else "R3")
    for call in (index.insert, index.insert_many, index.query):
        with pytest.raises(wayfold.InvalidArgument, match=f"states: .*{problem}"):
            call(state)
    assert len(index) == 0


def test_an_array_without_masked_numbers_is_a_state() -> None:
    index = wayfold.Index("R2")
    index.insert(np.ma.array([1.0, 2.0], mask=[False, False]))
    assert index.insert_many(np.ma.array([[3.0, 4.0]])).tolist() == [1]
    assert index.scan().columns()[2].tolist() == [[1, 2], [3, 4]]


def test_the_parts_of_a_space_stay_whole() -> None:
    two = spaces.sum(spaces.torus(2), "R3")
    assert two == wayfold.Space("sum((SO2^2), R3)")
    assert two.distance([0, 0, 0, 0, 0], [0.3, 0.4, 0, 3, 4]) == pytest.approx(5.5)
    assert spaces.sum("R1^7") == wayfold.Space("R1^7")
    weighted = spaces.product(spaces.SE2(), (spaces.SE2(), 0.25))
    assert weighted.distance([0] * 6, [0, 0, 0, 2, 0, 0]) == 1.0
    assert spaces.product(spaces.R(2), (spaces.torus(2), 4.0)).distance([0] * 4, [0, 0, 1, 0]) == 2.0
    rotation = spaces.SO3()
    half = rotation.distance([0, 0, 0, 1], [0, 0, 1, 1] / np.sqrt(2))
    scaled = spaces.sum((spaces.product((rotation, 4.0)), 3.0), "mpnn-se3")
    apart = scaled.distance([0, 0, 0, 1] + [0] * 6 + [1], [*([0, 0, 1, 1] / np.sqrt(2)), *[0] * 6, 1])
    assert apart == pytest.approx(6 * half)


def test_spaces_have_names() -> None:
    assert str(spaces.SE3(weight=0.15)) == "R3*SO3:0.15" == spaces.SE3().text
    assert spaces.SE2() == wayfold.Space("R2*SO2")
    assert spaces.OMPL_SE3() == spaces.sum(spaces.R(3), spaces.SO3())
    assert spaces.OMPL_SE2() == spaces.sum(spaces.R(2), (spaces.SO2(), 0.5))
    assert spaces.joints(7) == wayfold.Space("moveit-joints-7")
    assert spaces.sum(spaces.SE2(), spaces.R(1)).text == "sum(R2*SO2, R1)"
    assert spaces.SO2(1.0).names == ("theta",)
    assert spaces.SO2(np.float64(1.5)) == wayfold.Space("SO2[1.5]")
    assert spaces.SE3().distance([0, 0, 0, 0, 0, 0, 1], [3, 4, 0, 0, 0, 0, 1]) == 5.0
    assert len({spaces.SE3(), wayfold.Space("R3*RP3:0.15")}) == 1
    with pytest.raises(ValueError, match="space: "):
        wayfold.Index("R3*banana")
    for wrong, problem in (([0, np.nan], r"\.coords\[1\]: NaN"), ([0], ": 1 numbers, where")):
        for row, states in enumerate(((wrong, [0, 0]), ([0, 0], wrong))):
            with pytest.raises(ValueError, match=rf"states\[{row}\]{problem}"):
                spaces.R(2).distance(*states)
