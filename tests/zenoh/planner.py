"""A planner that shares an index: planner.py LOCATOR INDEX FORM SEED ROUNDS LEDGER STUBS.

It prints "ready", waits for a line, and then inserts, removes and searches in an order drawn from its seed. It writes the
answers to the ledger, which ledger-check reads.
"""

import math
import random
import sys

from faces import Json, Protobuf, connect
from processes import load_stubs


class Planner:
    def __init__(self, face, pb, types, index: str, seed: int):
        self.face, self.pb, self.types, self.index = face, pb, types, index
        self.random = random.Random(seed)
        self.next_id = (seed + 1) << 32
        self.own = []
        self.revision = 0

    def act(self):
        """One call: its kind in the ledger, the request, the answer."""
        draw = self.random.randrange(10)
        if draw < 5:
            return self.insert()
        if draw == 5:
            return self.remove()
        return self.knn() if draw < 9 else self.query()

    def insert(self):
        rows = self.random.randint(1, 8)
        request = self.pb.InsertRequest(
            index_name=self.index,
            states=self.states(rows),
            ids=range(self.next_id, self.next_id + rows),
            tags=[self.random.randrange(4) for _ in range(rows)],
            payloads=[bytes([row, 255]) for row in range(rows)],
            min_separation=self.random.choice([0.0, 0.0, 0.9]),
            neighbor_spec=self.pb.NeighborSpec(k=self.random.randint(1, 12)),
        )
        self.next_id += rows
        answer = self.face.ask(f"{self.index}/insert", request, self.pb.InsertResponse)
        stored = zip(answer.outcomes, answer.ids)
        self.own += [id for outcome, id in stored if outcome == self.pb.OUTCOME_INSERTED]
        return 0, request, answer

    def remove(self):
        gone = [self.own.pop() for _ in range(min(3, len(self.own)))]
        request = self.pb.RemoveRequest(index_name=self.index, ids=[*gone, 0])
        return 1, request, self.face.ask(f"{self.index}/remove", request, self.pb.RemoveResponse)

    def knn(self):
        request = self.pb.KnnRequest(
            index_name=self.index, states=self.states(self.random.randint(1, 4)), k=self.random.randint(1, 20)
        )
        return 2, request, self.face.ask(f"{self.index}/knn", request, self.pb.KnnResponse)

    def query(self):
        request = self.pb.QueryRequest(
            index_name=self.index, states=self.states(2), radius=self.random.uniform(0.0, 3.0)
        )
        return 3, request, self.face.ask(f"{self.index}/query", request, self.pb.QueryResponse)

    def states(self, rows: int):
        """States of R3*SO3."""
        coordinates = []
        for _ in range(rows):
            coordinates += [self.random.uniform(0.0, 10.0) for _ in range(3)]
            q = [self.random.gauss(0.0, 1.0) for _ in range(4)]
            norm = math.sqrt(sum(x * x for x in q))
            coordinates += [x / norm for x in q]
        return self.types.States(row_count=rows, coordinates=coordinates)


def entry(kind: int, request, answer) -> bytes:
    """A call in a ledger."""
    return bytes([kind]) + delimited(request) + delimited(answer)


def delimited(message) -> bytes:
    """A message after its length."""
    length, head = message.ByteSize(), bytearray()
    while length > 127:
        head.append(length % 128 + 128)
        length //= 128
    return bytes([*head, length]) + message.SerializeToString()


def main():
    locator, index, form, seed, rounds, ledger, stubs = sys.argv[1:]
    _, pb, types = load_stubs(stubs)
    session = connect(locator)
    face = Json(session) if form == "json" else Protobuf(session, types.Status)
    planner = Planner(face, pb, types, index, int(seed))
    print("ready", flush=True)
    sys.stdin.readline()
    with open(ledger, "wb") as file:
        for _ in range(int(rounds)):
            kind, request, answer = planner.act()
            assert answer.revision.number >= planner.revision, "an answer from the past"
            planner.revision = answer.revision.number
            file.write(entry(kind, request, answer))
    session.close()


if __name__ == "__main__":
    main()
