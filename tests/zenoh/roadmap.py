"""A worker of the program `rigid` in Python, over Zenoh:
roadmap.py LOCATOR INDEX FORM NUMBER SEED MILESTONES MIN_MILESTONES PROGRAMS STUBS.

It stores milestones in the form of `examples/src/rigid/milestone.rs`, and makes the same ones as `worker.rs`. It searches
for its first state, reports that it is ready, and waits for a line. Then it extends the roadmap to MILESTONES milestones, at
least MIN_MILESTONES of them its own. It reports its progress like the program's own workers.
"""

import json
import math
import random
import sys
from dataclasses import dataclass
from pathlib import Path

from faces import Json, Protobuf, connect
from processes import load_stubs

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "src" / "rigid"))
from checks import Scene  # noqa: E402

PENDING = 1
# k(n) of PRM*.
K_FACTOR = 2.0 * math.e
# The maximum number of draws, far more than a free state takes; a failure means that the scene has changed.
MAX_DRAWS = 10_000


@dataclass
class Candidate:
    """A milestone that is near enough for an edge."""

    id: int
    distance: float
    state: list[float]
    free: bool | None = None


@dataclass
class CheckedState:
    """A free state that is not stored yet; its motions to the existing milestones are checked."""

    state: list[float]
    earlier: list[Candidate]
    edges: list[int]


class Worker:
    def __init__(self, face, pb, types, index: str, revision, scene: Scene, number: int, seed: int):
        self.face, self.pb, self.types, self.index = face, pb, types, index
        self.scene, self.number = scene, number
        self.random = random.Random(f"{seed}, {number}")
        # Its reads see the newest revision that an answer named.
        self.revision = revision
        self.account = {"samples": 0, "milestones": 0, "edges": 0, "meanwhile": 0}

    def sample(self) -> list[float]:
        """A free state."""
        for _ in range(MAX_DRAWS):
            self.account["samples"] += 1
            position = [self.random.uniform(low, high) for low, high in self.scene.bounds]
            turn = [self.random.gauss(0.0, 1.0) for _ in range(4)]
            norm = math.hypot(*turn)
            state = self.scene.canonical(position + [number / norm for number in turn])
            if self.scene.is_free(state):
                return state
        raise RuntimeError(f"none of {MAX_DRAWS} states is free")

    def look(self, state: list[float]) -> CheckedState:
        """The first step: checks the motions to the k(n) nearest existing milestones."""
        request = self.pb.KnnRequest(
            index_name=self.index,
            states=self.one(state),
            include=self.types.Include(with_states=True),
            min_revision=self.revision,
            k_factor=K_FACTOR,
        )
        answer = self.face.ask(f"{self.index}/knn", request, self.pb.KnnResponse)
        earlier = self.candidates(answer.neighbors)
        return CheckedState(state, earlier, self.check(state, earlier))

    def insert(self, checked: CheckedState):
        """The second step: stores the state with these edges; returns its id and its k(n) nearest earlier milestones."""
        around = self.pb.NeighborSpec(k_factor=K_FACTOR, include=self.types.Include(with_states=True))
        request = self.pb.InsertRequest(
            index_name=self.index,
            states=self.one(checked.state),
            tags=[self.number << 1 | PENDING],
            payloads=[payload(checked.edges)],
            neighbor_spec=around,
            uid=self.revision.uid,
        )
        answer = self.face.ask(f"{self.index}/insert", request, self.pb.InsertResponse)
        assert list(answer.outcomes) == [self.pb.OUTCOME_INSERTED], answer.outcomes
        self.revision = answer.revision
        return answer.ids[0], self.candidates(answer.neighbors)

    def complete(self, id: int, checked: CheckedState, near: list[Candidate]):
        """The last step: checks the motions that are not checked yet, and marks the milestone as complete."""
        free = {candidate.id: candidate.free for candidate in checked.earlier}
        self.account["meanwhile"] += sum(candidate.id not in free for candidate in near)
        for candidate in near:
            candidate.free = free.get(candidate.id)
        edges = self.check(checked.state, near)
        request = self.pb.UpdateRequest(
            index_name=self.index,
            ids=[id],
            tags=[0],
            tag_mask=PENDING,
            payloads=[payload(edges)] if edges != checked.edges else [],
            uid=self.revision.uid,
        )
        answer = self.face.ask(f"{self.index}/update", request, self.pb.UpdateResponse)
        self.revision = answer.revision
        self.account["milestones"] += 1
        self.account["edges"] += len(edges)

    def check(self, state: list[float], candidates: list[Candidate]) -> list[int]:
        """Checks the unchecked motions; returns the ids at the ends of the free ones, ascending."""
        for candidate in candidates:
            if candidate.free is None:
                candidate.free = self.scene.is_free_way(state, candidate.state)
        return sorted(candidate.id for candidate in candidates if candidate.free)

    def candidates(self, neighbors) -> list[Candidate]:
        """The candidates in the answer about one state."""
        width, numbers = self.scene.coordinates, list(neighbors.states.coordinates)
        rows = [numbers[at : at + width] for at in range(0, len(numbers), width)]
        return [Candidate(*near) for near in zip(neighbors.ids, neighbors.distances, rows, strict=True)]

    def one(self, state: list[float]):
        return self.types.States(row_count=1, coordinates=state)


def payload(edges: list[int]) -> bytes:
    """The payload that keeps these edges."""
    return b"".join(id.to_bytes(8, "little") for id in edges)


def tell(line):
    print(json.dumps(line), flush=True)


def main():
    locator, index, form, number, seed, milestones, least, programs, stubs = sys.argv[1:]
    index_pb, pb, types = load_stubs(stubs)
    session = connect(locator)
    face = Json(session) if form == "json" else Protobuf(session, types.Status)

    def described():
        request = index_pb.GetIndexRequest(index_name=index)
        return face.ask(f"{index}/info", request, index_pb.GetIndexResponse).index

    worker = Worker(face, pb, types, index, described().revision, Scene(Path(programs)), int(number), int(seed))
    checked = worker.look(worker.sample())
    tell("ready")
    sys.stdin.readline()
    enough = False
    while not enough:
        id, near = worker.insert(checked)
        worker.complete(id, checked, near)
        enough = described().point_count >= int(milestones) and worker.account["milestones"] >= int(least)
        if not enough:
            checked = worker.look(worker.sample())
    tell({"done": worker.account | {"checks": worker.scene.checks}})
    session.close()


if __name__ == "__main__":
    main()
