"""The roadmaps: OMPL's PRM in SE(3) and its RRT-Connect in SE(2), from a fixed seed."""

from dataclasses import dataclass
from typing import Any, Callable

import numpy as np
from ompl import base, geometric, util

SEED = 20_090_401


@dataclass
class Roadmap:
    """The vertices of a planner, and their forms for OMPL and for the server."""

    planner: str
    space_text: str
    """The space in Wayfold's text form: the same metric as `space.distance`."""
    space: Any
    vertices: list
    """OMPL states, in the order of the PlannerData's vertices."""
    edges: int
    row: Callable[[Any], list[float]]
    """A state as a row of coordinates."""
    collapsed: Callable[[Any, Any], bool]
    """True if OMPL took the two states' rotations for equal."""
    keep: tuple
    """The objects that must outlive the vertices."""

    def rows(self, states) -> np.ndarray:
        return np.array([self.row(state) for state in states])

    def queries(self, count: int) -> list:
        """States in equal parts drawn from the whole space, near vertices, and the vertices themselves."""
        sampler = self.space.allocDefaultStateSampler()
        rng = np.random.default_rng(SEED)
        chosen = rng.integers(len(self.vertices), size=count)
        states = []
        for i, vertex in enumerate(chosen):
            state = self.space.allocState()
            near = self.vertices[vertex]
            match i % 3:
                case 0:
                    sampler.sampleUniform(state)
                case 1:
                    # The distances range from a collision-checking step down to far below OMPL's smallest rotation.
                    sampler.sampleUniformNear(state, near, 10.0 ** -(i % 7))
                case _:
                    self.space.copyState(state, near)
            states.append(state)
        return states


def seed():
    """Seeds OMPL; call it before OMPL draws a random number."""
    util.setLogLevel(util.LOG_WARN)
    util.RNG.setSeed(SEED)


def prm_in_se3(vertices: int) -> Roadmap:
    """A rod of five balls among the boxes of two walls with a window each."""
    space = base.SE3StateSpace()
    space.setBounds(_bounds([(0.0, 10.0)] * 3))
    # Low corner, high corner.
    boxes = [
        ((3.0, 0.0, 0.0), (3.5, 10.0, 4.0)),
        ((3.0, 0.0, 6.5), (3.5, 10.0, 10.0)),
        ((3.0, 0.0, 4.0), (3.5, 4.0, 6.5)),
        ((6.5, 0.0, 0.0), (7.0, 7.0, 10.0)),
        ((6.5, 9.5, 0.0), (7.0, 10.0, 10.0)),
        ((4.5, 6.0, 2.0), (5.5, 7.0, 8.0)),
    ]
    radius = 0.3

    def valid(state) -> bool:
        x, y, z, q = state.getX(), state.getY(), state.getZ(), state.rotation()
        qx, qy, qz, qw = q.x, q.y, q.z, q.w
        # The rod lies along the body's first axis.
        ax, ay, az = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qz * qw), 2 * (qx * qz - qy * qw)
        for t in (-0.8, -0.4, 0.0, 0.4, 0.8):
            px, py, pz = x + t * ax, y + t * ay, z + t * az
            for (lx, ly, lz), (hx, hy, hz) in boxes:
                dx = max(lx - px, px - hx, 0.0)
                dy = max(ly - py, py - hy, 0.0)
                dz = max(lz - pz, pz - hz, 0.0)
                if dx * dx + dy * dy + dz * dz < radius * radius:
                    return False
        return True

    si = _information(space, valid)
    start, goal = si.allocState(), si.allocState()
    for state, at in ((start, (1.5, 1.5, 1.5)), (goal, (8.5, 5.0, 5.0))):
        state.setXYZ(*at)
        state.rotation().setIdentity()
    problem = base.ProblemDefinition(si)
    problem.setStartAndGoalStates(start, goal)
    planner = geometric.PRM(si)
    planner.setProblemDefinition(problem)
    planner.setup()
    # The limit is a count, not a time, so the roadmap is the same on every machine. Vertices without an edge are not in
    # the PlannerData.
    wanted = vertices + vertices // 20
    planner.growRoadmapPtc(base.PlannerTerminationCondition(lambda: planner.milestoneCount() >= wanted))

    rotations = space.getSubspace(1)
    return _roadmap(
        planner,
        si,
        planner_name="PRM in SE(3)",
        space_text="ompl-se3",
        row=lambda s: [s.getX(), s.getY(), s.getZ(), s.rotation().x, s.rotation().y, s.rotation().z, s.rotation().w],
        collapsed=lambda a, b: rotations.distance(a.rotation(), b.rotation()) == 0.0,
        keep=(problem, valid),
    )


def rrt_connect_in_se2() -> Roadmap:
    """A C-shaped body among the walls of a maze."""
    space = base.SE2StateSpace()
    space.setBounds(_bounds([(0.0, 20.0), (0.0, 20.0)]))
    # Low corner, high corner.
    walls = [
        ((4.0, 0.0), (4.5, 15.0)),
        ((8.5, 5.0), (9.0, 20.0)),
        ((13.0, 0.0), (13.5, 15.0)),
        ((13.5, 7.5), (17.0, 8.0)),
        ((16.0, 11.5), (20.0, 12.0)),
    ]
    radius = 0.3
    body = [(0.8, 1.0), (0.2, 1.0), (-0.5, 0.6), (-0.8, 0.0), (-0.5, -0.6), (0.2, -1.0), (0.8, -1.0)]

    def valid(state) -> bool:
        x, y, yaw = state.getX(), state.getY(), state.getYaw()
        cos, sin = np.cos(yaw), np.sin(yaw)
        for bx, by in body:
            px, py = x + cos * bx - sin * by, y + sin * bx + cos * by
            if not (radius < px < 20.0 - radius and radius < py < 20.0 - radius):
                return False
            for (lx, ly), (hx, hy) in walls:
                dx, dy = max(lx - px, px - hx, 0.0), max(ly - py, py - hy, 0.0)
                if dx * dx + dy * dy < radius * radius:
                    return False
        return True

    si = _information(space, valid)
    start, goal = si.allocState(), si.allocState()
    for state, (x, y, yaw) in ((start, (2.0, 2.0, 0.0)), (goal, (18.0, 18.0, 3.0))):
        state.setXY(x, y)
        state.setYaw(yaw)
    problem = base.ProblemDefinition(si)
    problem.setStartAndGoalStates(start, goal)
    planner = geometric.RRTConnect(si, True)
    planner.setRange(0.5)
    planner.setProblemDefinition(problem)
    planner.setup()
    solved = planner.solve(base.plannerNonTerminatingCondition())
    assert solved, "RRT-Connect found no path"
    return _roadmap(
        planner,
        si,
        planner_name="RRT-Connect in SE(2)",
        space_text="ompl-se2",
        row=lambda s: [s.getX(), s.getY(), s.getYaw()],
        collapsed=lambda a, b: False,
        keep=(problem, valid),
    )


def _bounds(ranges) -> base.RealVectorBounds:
    bounds = base.RealVectorBounds(len(ranges))
    for i, (low, high) in enumerate(ranges):
        bounds.setLow(i, low)
        bounds.setHigh(i, high)
    return bounds


def _information(space, valid) -> base.SpaceInformation:
    si = base.SpaceInformation(space)
    si.setStateValidityChecker(valid)
    si.setStateValidityCheckingResolution(0.02)
    si.setup()
    return si


def _roadmap(planner, si, planner_name, space_text, row, collapsed, keep) -> Roadmap:
    data = base.PlannerData(si)
    planner.getPlannerData(data)
    return Roadmap(
        planner=planner_name,
        space_text=space_text,
        space=si.getStateSpace(),
        vertices=[data.getVertex(i).getState() for i in range(data.numVertices())],
        edges=data.numEdges(),
        row=row,
        collapsed=collapsed,
        keep=(planner, si, data, *keep),
    )
