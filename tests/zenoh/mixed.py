"""Planners over gRPC and over Zenoh, in Rust and in Python, build one roadmap, which equals a serial replay."""

import json
import queue
import subprocess
import sys
import threading
from pathlib import Path

from processes import MAX_WAIT_S, Server

INDEX = "prm"
SEED = 5
# The workers of the program `rigid`, and the source of their neighbours.
SOURCES = ["remote", "shared"]
FORMS = ["protobuf", "json"]
# The minimum number of milestones of each worker over Zenoh.
MIN_MILESTONES = 15


class Planner:
    """A worker's process, and the lines of its output."""

    def __init__(self, command):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, **pipes)
        self.lines = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.put(json.loads(line))
        self.lines.put(None)

    def next(self):
        line = self.lines.get(timeout=MAX_WAIT_S)
        if line is None:
            raise RuntimeError(f"a worker ended early: status {self.process.wait(MAX_WAIT_S)}")
        return line

    def begin(self):
        self.process.stdin.write("go\n")
        self.process.stdin.flush()

    def account(self, milestones: int):
        """Its first account with this many milestones of its own, or its last one."""
        while True:
            line = self.next()
            progress = line.get("progress", {"milestones": 0})
            if "done" in line or progress["milestones"] >= milestones:
                return line.get("done", progress)


def build(server: Server, programs: Path, stubs: str, milestones: int) -> str:
    """Builds a roadmap in the index, which exists, and checks it; returns a summary."""
    rigid, worker = programs / "rigid", Path(__file__).with_name("roadmap.py")
    planners = []
    try:
        for number, source in enumerate(SOURCES):
            job = {"server": server.uri, "index": INDEX, "number": number, "seed": SEED, "milestones": milestones}
            job |= {"source": source, "max_pending": 3, "min_separation": 0.0, "progress_ms": 0}
            planners.append(Planner([rigid, "work", json.dumps(job)]))
        for number, form in enumerate(FORMS, len(SOURCES)):
            job = [server.locator, INDEX, form, number, SEED, milestones, MIN_MILESTONES, programs, stubs]
            planners.append(Planner([sys.executable, worker, *map(str, job)]))
        for planner in planners:
            if planner.next() != "ready":
                raise AssertionError("a worker begins before its start signal")
        # The workers over Zenoh have read the empty roadmap. In any schedule, they therefore meet milestones of each of
        # the others when they insert.
        grpc, zenoh = planners[: len(SOURCES)], planners[len(SOURCES) :]
        for planner in grpc:
            planner.begin()
        for planner in grpc:
            if planner.account(1)["milestones"] < 1:
                raise AssertionError("a worker over gRPC is done without a milestone")
        for planner in zenoh:
            planner.begin()
        accounts = [planner.account(sys.maxsize) for planner in zenoh]
        for planner in planners:
            if planner.process.wait(MAX_WAIT_S) != 0:
                raise AssertionError(f"a worker's exit status is {planner.process.returncode}")
    finally:
        for planner in planners:
            planner.process.kill()
            planner.process.wait(MAX_WAIT_S)

    audit = [rigid, "audit", f"--server={server.uri}", f"--index={INDEX}"]
    audited = subprocess.run(audit, check=True, stdout=subprocess.PIPE, text=True, timeout=MAX_WAIT_S)
    report = json.loads(audited.stdout)
    made = {int(number): count for number, count in report["workers"].items()}
    if sorted(made) != list(range(len(planners))) or report["milestones"] < milestones:
        raise AssertionError(f"not all workers made milestones, or too few: {report}")
    for number, account in enumerate(accounts, len(SOURCES)):
        if account["milestones"] != made[number] or made[number] < MIN_MILESTONES or account["meanwhile"] < 2:
            raise AssertionError(f"worker {number} says {account}, and made {made[number]}")
    shares = ", ".join(f"{count} by worker {number}" for number, count in sorted(made.items()))
    return f"{report['milestones']} milestones ({shares}), {report['edges']} edges"
