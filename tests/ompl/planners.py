"""OMPL's planners in the scene of the program `rigid`: its bounds, its questions and its collision checks.

OMPL's SE3StateSpace adds the distances in R3 and SO3, d = |p - q| + w * angle; ours is the root of the sum of squares,
d = sqrt(|p - q|^2 + 0.15 * angle^2), both with half the rotation's angle. With w = sqrt(0.15) they agree for a pure
translation and for a pure rotation, and OMPL's is larger by a factor of up to sqrt(2) otherwise. So its planners may choose
other neighbours; a motion is checked at the same states, by the same code.
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from ompl import base, geometric

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "src" / "rigid"))
from checks import Scene  # noqa: E402

ROTATION_WEIGHT = math.sqrt(0.15)
# The maximum time of a planner for a question, after which the comparison fails.
MAX_WAIT_S = 120.0
PLANNERS = {
    "PRM": lambda information: geometric.PRM(information),
    "PRM*": lambda information: geometric.PRM(information, True),
    "RRT-Connect": lambda information: geometric.RRTConnect(information),
}


@dataclass
class Run:
    """The figures of one run of a planner."""

    seconds: float
    nodes: int
    checks: int
    """The states that were checked for collisions."""
    calls: tuple[int, int]
    """How often OMPL called Python for a state, and for a motion."""
    lengths: list[float]
    """The lengths of the paths, in our metric."""


class Motions(base.MotionValidator):
    """Checks a motion and its second end in one call, as OMPL requires."""

    def __init__(self, information, problem):
        super().__init__(information)
        self.problem = problem

    def checkMotion(self, a, b, *last_valid):
        assert not last_valid, "no planner here asks how far a motion is free"
        self.problem.motions_asked += 1
        scene = self.problem.scene
        b = scene.row(row(b))
        return scene.is_free(b) and scene.is_free_way(row(a), b)


class Problem:
    """A new state space that counts the calls of the scene."""

    def __init__(self, scene: Scene):
        self.scene, self.checks_before = scene, scene.checks
        self.states_asked = self.motions_asked = 0
        self.space = base.SE3StateSpace()
        bounds = base.RealVectorBounds(3)
        for axis, (low, high) in enumerate(scene.bounds):
            bounds.setLow(axis, low)
            bounds.setHigh(axis, high)
        self.space.setBounds(bounds)
        self.space.setSubspaceWeight(1, ROTATION_WEIGHT)
        self.information = base.SpaceInformation(self.space)
        self.information.setStateValidityChecker(self.is_valid)
        # This reference keeps the Python override alive.
        self.motions = Motions(self.information, self)
        self.information.setMotionValidator(self.motions)
        self.information.setup()
        # Any path ends the run: PRM* would shorten it until its time is over.
        self.objective = base.PathLengthOptimizationObjective(self.information)
        self.objective.setCostThreshold(self.objective.infiniteCost())

    def is_valid(self, state) -> bool:
        self.states_asked += 1
        return self.scene.is_free(row(state))

    def state(self, row):
        state = self.information.allocState()
        state.setXYZ(*row[:3])
        turn = state.rotation()
        turn.x, turn.y, turn.z, turn.w = row[3:]
        return state

    def definition(self, task):
        definition = base.ProblemDefinition(self.information)
        definition.setStartAndGoalStates(self.state(task["start"]), self.state(task["goal"]))
        definition.setOptimizationObjective(self.objective)
        return definition

    def run(self, seconds: float, nodes: int, lengths) -> Run:
        calls = (self.states_asked, self.motions_asked)
        return Run(seconds, nodes, self.scene.checks - self.checks_before, calls, lengths)


def row(state) -> tuple:
    """A state as a row of Wayfold."""
    turn = state.rotation()
    return (state.getX(), state.getY(), state.getZ(), turn.x, turn.y, turn.z, turn.w)


def answer(scene: Scene, name: str) -> Run:
    """Solves all questions one after the other: PRM on one roadmap, RRT-Connect with new trees for each."""
    problem = Problem(scene)
    planner = PLANNERS[name](problem.information)
    single_query = name == "RRT-Connect"
    definitions = [problem.definition(task) for task in scene.tasks]
    planner.setProblemDefinition(definitions[0])
    planner.setup()
    seconds, nodes = 0.0, 0
    for definition in definitions:
        if single_query:
            planner.clear()
        # The roadmap stays, so the ends of the previous question are milestones of it.
        planner.setProblemDefinition(definition)
        began = time.perf_counter()
        solved = planner.solve(base.timedPlannerTerminationCondition(MAX_WAIT_S))
        seconds += time.perf_counter() - began
        if not solved or not definition.hasExactSolution():
            raise RuntimeError(f"{name} found no path in {MAX_WAIT_S:.0f} s")
        if single_query:
            nodes += vertices(problem, planner)
    run = problem.run(seconds, nodes or planner.milestoneCount(), [])
    for task, definition in zip(scene.tasks, definitions):
        path = [row(state) for state in definition.getSolutionPath().getStates()]
        if not scene.is_free_path(path):
            raise AssertionError(f"{name}, {task['name']}: the path collides")
        run.lengths.append(sum(map(scene.distance, path, path[1:])))
    return run


def vertices(problem: Problem, planner) -> int:
    data = base.PlannerData(problem.information)
    planner.getPlannerData(data)
    return data.numVertices()


def grow(scene: Scene, milestones: int) -> Run:
    """A roadmap of PRM* with this many milestones."""
    problem = Problem(scene)
    planner = PLANNERS["PRM*"](problem.information)
    definition = problem.definition(scene.tasks[0])
    planner.setProblemDefinition(definition)
    planner.setup()
    began = time.perf_counter()
    planner.growRoadmapPtc(base.PlannerTerminationCondition(lambda: planner.milestoneCount() >= milestones))
    return problem.run(time.perf_counter() - began, planner.milestoneCount(), [])


def calls_us(scene: Scene, calls: int = 20_000) -> tuple[float, float]:
    """The cost of OMPL's calls of Python without any check, for a state and for a motion, in microseconds:
    states become rows, and the library is called as often as for a free motion. The way from here to OMPL and
    back is included."""
    problem = Problem(scene)
    state = problem.state(scene.tasks[0]["start"])
    problem.scene = Idle(scene)
    information = problem.information
    costs = []
    for ask in (lambda: information.isValid(state), lambda: information.checkMotion(state, state)):
        began = time.perf_counter()
        for _ in range(calls):
            ask()
        costs.append((time.perf_counter() - began) / calls * 1e6)
    return tuple(costs)


class Idle:
    """A scene with the same calls that checks nothing."""

    def __init__(self, scene: Scene):
        self.row, self.is_free = scene.row, scene.nothing

    def is_free_way(self, a, b) -> bool:
        self.row(a)
        return self.is_free(b)
