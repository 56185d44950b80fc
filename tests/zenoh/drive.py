"""Drives the server over Zenoh; `tests/zenoh/run` starts it."""

import argparse
import json
import queue
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import zenoh

import mixed
from faces import PREFIX, Json, Protobuf, Refused, connect, only
from planner import entry
from processes import MAX_WAIT_S, Server, generate_stubs

README = Path(__file__).resolve().parents[2] / "README.md"
# The server's address in the README.
README_ADDRESS = "tcp/127.0.0.1:7448"
ROUNDS = 120
MILESTONES = 150
ROWS = [[0.0, 0.0], [3.0, 4.0], [6.0, 8.0]]


def expect(found, expected):
    if found != expected:
        raise AssertionError(f"{found!r} is not {expected!r}")


def refused(code: int, reason: str, ask):
    try:
        ask()
    except Refused as refusal:
        expect((refusal.code, refusal.reason), (code, reason))
    else:
        raise AssertionError(f"{reason} was expected")


def drive(face, index_pb, pb, types):
    """Every operation, on an index of its own."""
    name = face.name
    create = index_pb.CreateIndexRequest(name=name, space_text="R2")
    created = face.ask("create", create, index_pb.CreateIndexResponse)
    expect((created.created, created.index.space.real_vector.dimensions), (True, 2))
    uid = created.index.revision.uid
    expect(face.ask("create", create, index_pb.CreateIndexResponse).created, False)

    samples = queue.Queue()
    events = face.session.declare_subscriber(f"{PREFIX}/{name}/{face.events}", samples.put)

    def event():
        return face.read(samples.get(timeout=MAX_WAIT_S), pb.WatchResponse)

    expect(event().revision, types.Revision(uid=uid, number=0))

    states = types.States(row_count=3, coordinates=[number for row in ROWS for number in row])
    insert = pb.InsertRequest(
        index_name=name,
        states=states,
        ids=[1, 2, 2**60],
        tags=[0, 1, 2**64 - 1],
        payloads=[b"", b"\x00\xff", b"x"],
        neighbor_spec=pb.NeighborSpec(k=1, include=types.Include(with_states=True)),
        operation_id="once",
    )
    inserted = face.ask(f"{name}/insert", insert, pb.InsertResponse)
    expect(list(inserted.outcomes), [pb.OUTCOME_INSERTED] * 3)
    expect((inserted.revision.number, list(inserted.neighbors.neighbor_counts)), (1, [0, 1, 1]))
    expect(list(inserted.neighbors.distances), [5.0, 5.0])
    expect(list(inserted.neighbors.states.coordinates), [0.0, 0.0, 3.0, 4.0])
    expect(face.ask(f"{name}/insert", insert, pb.InsertResponse), inserted)
    published = event().mutations
    expect([list(mutation.stored.ids) for mutation in published], [[1, 2, 2**60]])
    expect(list(published[0].stored.payloads), [b"", b"\x00\xff", b"x"])

    update = pb.UpdateRequest(index_name=name, ids=[1, 2], tags=[7], tag_mask=7)
    updated = face.ask(f"{name}/update", update, pb.UpdateResponse)
    expect((updated.updated_count, updated.revision.number), (2, 2))
    columns = types.Include(with_states=True, with_tags=True, with_payloads=True)
    get = face.ask(f"{name}/get", pb.GetRequest(index_name=name, ids=[2, 2**60], include=columns), pb.GetResponse)
    expect(list(get.points.revisions), [])
    expect(list(get.points.tags), [7, 2**64 - 1])
    expect(list(get.points.payloads), [b"\x00\xff", b"x"])
    expect(list(get.points.states.coordinates), [3.0, 4.0, 6.0, 8.0])

    knn = pb.KnnRequest(index_name=name, states=states, k=2, filter=types.Filter(tag_mask=1, tag_value=1))
    nearest = face.ask(f"{name}/knn", knn, pb.KnnResponse)
    expect(list(nearest.neighbors.neighbor_counts), [2, 2, 2])
    expect(list(nearest.neighbors.ids), [1, 2, 2, 1, 2**60, 2])
    near = face.ask(f"{name}/query", pb.QueryRequest(index_name=name, states=states, radius=5.0), pb.QueryResponse)
    expect(list(near.neighbors.ids), [1, 2, 2, 1, 2**60, 2**60, 2])

    removed = face.ask(f"{name}/remove", pb.RemoveRequest(index_name=name, ids=[1, 99]), pb.RemoveResponse)
    expect((removed.removed_count, removed.missing_count, removed.revision.number), (1, 1, 3))
    first = pb.WatchRequest(index_name=name, after_revision=types.Revision(uid=uid, number=1))
    log = face.ask(f"{name}/log", first, pb.WatchResponse)
    expect([mutation.revision.number for mutation in log.mutations], [2, 3])
    expect(list(log.mutations[1].removed_ids), [1])
    described = face.ask(f"{name}/info", index_pb.GetIndexRequest(index_name=name), index_pb.GetIndexResponse)
    expect((described.index.point_count, described.index.revision.number), (2, 3))
    listed = face.ask("list", index_pb.ListIndexesRequest(), index_pb.ListIndexesResponse)
    expect(name in [index.name for index in listed.indexes], True)

    wrong = pb.KnnRequest(index_name=name, states=types.States(row_count=1, coordinates=[1.0, 2.0, 3.0]), k=1)
    refused(3, "WIDTH", lambda: face.ask(f"{name}/knn", wrong, pb.KnnResponse))
    refused(5, "INDEX_NOT_FOUND", lambda: face.ask("nobody/info", index_pb.GetIndexRequest(), None))
    refused(3, "CONFLICT", lambda: face.ask(f"{name}/knn?k=9", knn, pb.KnnResponse))
    other = pb.RemoveRequest(index_name=name, ids=[2], uid="another")
    refused(9, "UID_MISMATCH", lambda: face.ask(f"{name}/remove", other, pb.RemoveResponse))

    tokens = face.session.liveliness().get(f"{PREFIX}/{name}/@alive", timeout=MAX_WAIT_S)
    expect([str(token.ok.key_expr) for token in tokens], [f"{PREFIX}/{name}/@alive"])
    deleted = face.ask("delete", index_pb.DeleteIndexRequest(index_name=name, uid=uid), index_pb.DeleteIndexResponse)
    expect(deleted.uid, uid)
    events.undeclare()
    print(f"every operation, {name}: as expected")


def by_hand(session: zenoh.Session):
    """Handwritten JSON."""

    def ask(key: str, body=None):
        payload = None if body is None else json.dumps(body)
        reply = only(session, key, payload=payload)
        return json.loads(reply.ok.payload.to_string())

    ask("create", {"name": "hand", "space_text": "R2"})
    expect(ask("hand/insert", {"states": ROWS})["ids"], [0, 1, 2])
    nearest = ask("hand/knn", {"states": ROWS, "k": 1})
    expect((nearest["ids"], nearest["distances"]), ([[0], [1], [2]], [[0.0], [0.0], [0.0]]))
    expect(ask("hand/knn?k=2;r=4", [0.0, 1.0])["ids"], [[0]])
    expect(ask("hand/get?ids=1")["points"]["states"], [[3.0, 4.0]])
    infos = [str(reply.ok.key_expr) for reply in session.get(f"{PREFIX}/*/info")]
    expect(infos, [f"{PREFIX}/hand/info"])
    print("JSON by hand: as expected")


def readme(session: zenoh.Session, server: Server):
    """The example of the README runs."""
    text = README.read_text()
    example = text.split("```python\n")[1].split("```")[0]
    expect(example.count(README_ADDRESS), 1)
    exec(example.replace(README_ADDRESS, server.locator), {})
    reply = only(session, "wrist/info")
    expect(json.loads(reply.ok.payload.to_string())["index"]["point_count"], 2)


def share(server: Server, programs: Path, directory: str, face: Protobuf, pb, types):
    """Two planners over Zenoh and two over gRPC share an index; each of their answers equals brute force."""
    only(face.session, "create", payload=json.dumps({"name": "roadmap", "space_text": "R3*SO3:0.15"}))
    # Assigned ids are above this one, the planners' own ids below.
    pose = types.States(row_count=1, coordinates=[5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 1.0])
    root = pb.InsertRequest(index_name="roadmap", states=pose, ids=[1 << 48])
    rooted = face.ask("roadmap/insert", root, pb.InsertResponse)
    Path(directory, "root.ledger").write_bytes(entry(0, root, rooted))
    ledgers = [f"{directory}/{planner}.ledger" for planner in range(4)]
    planner = Path(__file__).with_name("planner.py")
    commands = [
        [programs / "planner-process", server.uri, "roadmap", str(seed), str(ROUNDS), ledgers[seed]]
        for seed in range(2)
    ] + [
        [sys.executable, planner, server.locator, "roadmap", form, str(seed), str(ROUNDS), ledgers[seed], directory]
        for seed, form in ((2, "json"), (3, "protobuf"))
    ]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    planners = [subprocess.Popen(command, **pipes) for command in commands]
    try:
        for process in planners:
            expect(process.stdout.readline().strip(), "ready")
        for process in planners:
            process.stdin.write("go\n")
            process.stdin.flush()
        for process in planners:
            expect(process.wait(MAX_WAIT_S), 0)
    finally:
        for process in planners:
            process.kill()
    check = [programs / "ledger-check", server.uri, "roadmap", f"{directory}/root.ledger", *ledgers]
    subprocess.run(check, check=True, timeout=MAX_WAIT_S)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", type=Path, required=True, help="the directory of the suites' programs")
    milestones = "how many milestones the roadmap has that planners over Zenoh and gRPC build together"
    parser.add_argument("--milestones", type=int, default=MILESTONES, help=milestones)
    arguments = parser.parse_args()
    programs = arguments.programs.resolve()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as directory, Server(programs / "server-process") as server:
        index_pb, pb, types = generate_stubs(directory)
        session = connect(server.locator)
        for face in (Json(session), Protobuf(session, types.Status)):
            drive(face, index_pb, pb, types)
        by_hand(session)
        readme(session, server)
        share(server, programs, directory, Protobuf(session, types.Status), pb, types)
        only(session, "create", payload=json.dumps({"name": mixed.INDEX, "space_text": "R3*SO3:0.15"}))
        built = mixed.build(server, programs, directory, arguments.milestones)
        print(f"a roadmap by planners over gRPC and Zenoh, as in a serial replay: {built}")
        session.close()
    print(f"done in {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
