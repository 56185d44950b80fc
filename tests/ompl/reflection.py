"""Drives the server with grpcurl, which knows the server only by reflection."""

import json
import subprocess
import sys
from pathlib import Path

GRPCURL = Path(sys.executable).parent / "grpcurl"


def drive(address: str) -> str:
    """Lists, describes, creates, inserts, searches and makes errors; returns a summary."""
    services = _grpcurl(address, "list").split()
    expected = ["wayfold.v1.IndexService", "wayfold.v1.PointService", "grpc.health.v1.Health"]
    missing = [service for service in expected if service not in services]
    assert not missing, f"reflection lists {services}, without {missing}"

    described = _grpcurl(address, "describe", "wayfold.v1.PointService")
    for call in ("Insert", "Update", "Remove", "Get", "Knn", "Query", "StreamKnn", "Scan"):
        assert f"rpc {call} (" in described, f"no {call} in {described}"
    assert "epsilon" in _grpcurl(address, "describe", "wayfold.v1.KnnRequest")

    health = _call(address, "grpc.health.v1.Health/Check", {"service": "wayfold.v1.PointService"})
    assert health == {"status": "SERVING"}, health

    created = _call(address, "wayfold.v1.IndexService/CreateIndex", {"name": "curl", "spaceText": "R2*SO2"})
    assert created["created"] and created["index"]["coordinateCount"] == 3, created

    states = {"rowCount": 3, "coordinates": [0, 0, 0, 3, 4, 0, 0, 0, 1]}
    inserted = _call(address, "wayfold.v1.PointService/Insert", {"indexName": "curl", "states": states, "ids": [7, 8, 9]})
    assert inserted["outcomes"] == ["OUTCOME_INSERTED"] * 3 and inserted["revision"]["number"] == "1", inserted

    query = {"indexName": "curl", "states": {"rowCount": 1, "coordinates": [0, 0, 0]}, "k": 10}
    found = _call(address, "wayfold.v1.PointService/Knn", query)
    neighbors = found["neighbors"]
    assert neighbors == {"neighborCounts": [3], "ids": ["7", "9", "8"], "distances": [0, 1, 5]}, neighbors
    assert found["revision"] == inserted["revision"], found

    query["states"] = {"rowCount": 1, "coordinates": [0, "NaN", 0]}
    refused = _grpcurl(address, "-d", json.dumps(query), "wayfold.v1.PointService/Knn", fails=True)
    for part in ("InvalidArgument", "states[0].coords[1]: NaN", "google.rpc.ErrorInfo", "google.rpc.BadRequest"):
        assert part in refused, f"no {part!r} in {refused}"
    return f"{len(services)} services listed, 1 described, 4 calls answered, 1 refused with its details"


def _call(address: str, method: str, message: dict) -> dict:
    return json.loads(_grpcurl(address, "-d", json.dumps(message), method))


def _grpcurl(address: str, *arguments: str, fails: bool = False) -> str:
    # grpcurl wants its flags before the address.
    flags = arguments[:2] if arguments[0] == "-d" else ()
    verb = arguments[len(flags) :]
    done = subprocess.run(
        [GRPCURL, "-plaintext", "-max-time", "60", *flags, address, *verb], capture_output=True, text=True
    )
    if (done.returncode != 0) != fails:
        raise AssertionError(f"grpcurl {' '.join(arguments)}: status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stderr if fails else done.stdout
