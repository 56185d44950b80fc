"""A server process on a port of its own, and stubs generated from the repository's .proto files."""

import importlib
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import grpc_tools
from grpc_tools import protoc

PROTO = Path(__file__).resolve().parents[2] / "proto"
READY = "listening on http://"
# The maximum time for the server to start or to stop, after which the comparison fails.
MAX_WAIT_S = 60


def generate_stubs(directory: str):
    """Generates the stubs; returns the modules of both services' messages and stubs, and of the shared messages."""
    files = sorted(str(path.relative_to(PROTO)) for path in PROTO.glob("wayfold/v1/*.proto"))
    well_known = str(Path(grpc_tools.__file__).parent / "_proto")
    outputs = [f"--python_out={directory}", f"--grpc_python_out={directory}"]
    if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", *outputs, *files]) != 0:
        raise RuntimeError(f"protoc refused {files}")
    sys.path.insert(0, directory)
    return [importlib.import_module(f"wayfold.v1.{name}") for name in MODULES]


MODULES = ("index_service_pb2", "index_service_pb2_grpc", "point_service_pb2", "point_service_pb2_grpc", "types_pb2")


class Server:
    """The server's process; a context manager that yields itself with `address` set."""

    def __init__(self, binary: str):
        self.binary = binary

    def __enter__(self):
        self.stderr = tempfile.TemporaryFile(mode="w+")
        self.process = subprocess.Popen(
            [self.binary, "--grpc", "127.0.0.1:0", "--zenoh", "off", "--http", "off", "--data", "memory"],
            stdout=subprocess.PIPE,
            stderr=self.stderr,
            text=True,
        )
        watchdog = threading.Timer(MAX_WAIT_S, self.process.kill)
        watchdog.start()
        first = self.process.stdout.readline().strip()
        watchdog.cancel()
        if not first.startswith(READY):
            self.process.kill()
            raise RuntimeError(f"the server said {first!r} and not that it listens\n{self._log()}")
        self.address = first.removeprefix(READY)
        # The rest is discarded, because a full pipe would stop the server.
        threading.Thread(target=self.process.stdout.read, daemon=True).start()
        return self

    def __exit__(self, kind, error, trace):
        self.process.terminate()
        try:
            status = self.process.wait(MAX_WAIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = "none: it did not stop"
        if kind is not None:
            print(self._log(), file=sys.stderr)
        elif status != 0:
            raise RuntimeError(f"the server's exit status is {status}\n{self._log()}")

    def _log(self) -> str:
        self.stderr.seek(0)
        return f"the server's log:\n{self.stderr.read()}"
