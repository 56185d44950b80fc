"""The comparison of the server with OMPL; `tests/ompl/run` starts it."""

import argparse
import os
import sys
import tempfile
import time

import grpc
import numpy as np

import problems
import reflection
from oracle import Figures, Mismatch, Oracle
from processes import Server, generate_stubs

SE3_VERTICES = 10_000
QUERIES = 3_000
K = 10
# Rows a call.
BATCH = 500
# The neighbours in the answer of Insert are compared for one in this many rows.
INSERTS_COMPARED = 10


class Client:
    """The calls of the comparison, on generated stubs."""

    def __init__(self, channel, modules):
        self.indexes_pb, self.points_pb, self.types_pb, indexes_grpc, points_grpc = modules
        self.indexes = indexes_grpc.IndexServiceStub(channel)
        self.points = points_grpc.PointServiceStub(channel)

    def create(self, name: str, space_text: str):
        self.indexes.CreateIndex(self.indexes_pb.CreateIndexRequest(name=name, space_text=space_text))

    def count(self, name: str) -> int:
        return self.indexes.GetIndex(self.indexes_pb.GetIndexRequest(index_name=name)).index.point_count

    def insert(self, index: str, rows: np.ndarray, first_id: int):
        """Inserts rows under ids from `first_id` up; yields each row's neighbours at that moment."""
        pb = self.points_pb
        for at in range(0, len(rows), BATCH):
            batch = rows[at : at + BATCH]
            answer = self.points.Insert(
                pb.InsertRequest(
                    index_name=index,
                    states=self._states(batch),
                    ids=range(first_id + at, first_id + at + len(batch)),
                    neighbor_spec=pb.NeighborSpec(k=K),
                )
            )
            if set(answer.outcomes) != {pb.OUTCOME_INSERTED}:
                raise Mismatch(f"rows from {at}: outcomes {list(answer.outcomes)}")
            yield from _rows(answer.neighbors)

    def knn(self, index: str, rows: np.ndarray, k: int):
        """Yields (ids, distances) of each row."""
        for at in range(0, len(rows), BATCH):
            request = self.points_pb.KnnRequest(index_name=index, states=self._states(rows[at : at + BATCH]), k=k)
            yield from _rows(self.points.Knn(request).neighbors)

    def query(self, index: str, rows: np.ndarray, radius: float):
        """Yields (ids, distances) of each row."""
        for at in range(0, len(rows), BATCH):
            states = self._states(rows[at : at + BATCH])
            request = self.points_pb.QueryRequest(index_name=index, states=states, radius=radius)
            yield from _rows(self.points.Query(request).neighbors)

    def _states(self, rows: np.ndarray):
        return self.types_pb.States(row_count=len(rows), coordinates=rows.ravel())


def _rows(neighbors):
    ids, distances, at = list(neighbors.ids), list(neighbors.distances), 0
    for count in neighbors.neighbor_counts:
        yield ids[at : at + count], distances[at : at + count]
        at += count
    if at != len(ids) or at != len(distances):
        raise Mismatch(f"counts sum to {at}, with {len(ids)} ids and {len(distances)} distances")


def compare(client: Client, name: str, make, minimum: int):
    """Inserts a roadmap's vertices and compares neighbours; prints the figures."""
    started = time.monotonic()
    roadmap = make()
    vertices = len(roadmap.vertices)
    took = time.monotonic() - started
    print(f"{roadmap.planner}: {vertices} vertices, {roadmap.edges} edges, made in {took:.1f} s")
    assert vertices >= minimum, f"the comparison needs {minimum} vertices at least"
    oracle = Oracle(roadmap)

    client.create(name, roadmap.space_text)
    started = time.monotonic()
    at_insert = list(client.insert(name, roadmap.rows(roadmap.vertices), 0))
    queries = roadmap.queries(QUERIES)
    rows = roadmap.rows(queries)
    nearest = list(client.knn(name, rows, K))
    # A radius that contains about thirty vertices of a typical neighbourhood.
    radius = float(np.median([distances[-1] for _, distances in nearest])) * 1.25
    within = list(client.query(name, rows, radius))
    took = time.monotonic() - started
    stored = client.count(name)
    assert stored == vertices, f"{stored} points stored"
    for what, answers, expected in (("Insert", at_insert, vertices), ("Knn", nearest, QUERIES), ("Query", within, QUERIES)):
        assert len(answers) == expected, f"{what} answered {len(answers)} of {expected} rows"

    started = time.monotonic()
    figures = {f"Knn, k = {K}": Figures(), f"Query, radius {radius:.3f}": Figures(), f"Insert, k = {K}": Figures()}
    knn, query, insert = figures.values()
    for state, near, ball in zip(queries, nearest, within):
        distances = oracle.distances(state, vertices)
        oracle.check_knn(knn, state, distances, K, *near)
        oracle.check_radius(query, state, distances, radius, *ball)
    # An inserted row sees the rows before it.
    for i in range(0, vertices, INSERTS_COMPARED):
        state = roadmap.vertices[i]
        oracle.check_knn(insert, state, oracle.distances(state, i), K, *at_insert[i])
    print(f"  server {took:.1f} s, OMPL's brute force {time.monotonic() - started:.1f} s")
    for what, figure in figures.items():
        print(f"  {what:<22}{figure}")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--server", required=True, help="the server's binary")
    arguments = parser.parse_args()
    problems.seed()
    with tempfile.TemporaryDirectory() as directory:
        modules = generate_stubs(directory, "index_service", "point_service")
        with Server(arguments.server) as server, grpc.insecure_channel(server.address) as channel:
            client = Client(channel, modules)
            print(f"grpcurl: {reflection.drive(server.address)}")
            compare(client, "prm", lambda: problems.prm_in_se3(SE3_VERTICES), SE3_VERTICES)
            compare(client, "rrt", problems.rrt_connect_in_se2, 1_000)
    print("The server and OMPL have the same neighbours.")


if __name__ == "__main__":
    try:
        main()
    except (AssertionError, RuntimeError, grpc.RpcError) as error:
        sys.exit(f"error: {error}")
    sys.stdout.flush()
    # At exit, OMPL's bindings report thousands of states that the interpreter has not freed.
    os._exit(0)
