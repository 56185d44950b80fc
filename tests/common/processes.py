"""The server's process, and stubs generated from the repository's .proto files."""

import importlib
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

PROTO = Path(__file__).resolve().parents[2] / "proto"
READY = "listening on "
# The maximum time for a process to start or to stop, after which the suite fails.
MAX_WAIT_S = 120


def generate_stubs(directory: str, *services: str):
    """Generates the stubs, and loads them."""
    import grpc_tools
    from grpc_tools import protoc

    files = sorted(str(path.relative_to(PROTO)) for path in PROTO.glob("wayfold/v1/*.proto"))
    well_known = str(Path(grpc_tools.__file__).parent / "_proto")
    outputs = [f"--python_out={directory}", f"--grpc_python_out={directory}"]
    if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", *outputs, *files]) != 0:
        raise RuntimeError(f"protoc refused {files}")
    return load_stubs(directory, *services)


def load_stubs(directory: str, *services: str):
    """The modules of the messages: of the indices, of the points, and of what both share. Those of these services follow."""
    sys.path.insert(0, directory)
    names = ["index_service_pb2", "point_service_pb2", "types_pb2", *(f"{name}_pb2_grpc" for name in services)]
    return [importlib.import_module(f"wayfold.v1.{name}") for name in names]


class Server:
    """The server's process; a context manager that yields itself with `uri`, `address` and `locator` set."""

    def __init__(self, binary):
        self.binary = binary

    def __enter__(self):
        self.stderr = tempfile.TemporaryFile(mode="w+")
        arguments = ["--grpc", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0", "--http", "off", "--data", "memory"]
        self.process = subprocess.Popen([self.binary, *arguments], stdout=subprocess.PIPE, stderr=self.stderr, text=True)
        watchdog = threading.Timer(MAX_WAIT_S, self.process.kill)
        watchdog.start()
        lines = [self.process.stdout.readline().strip() for _ in range(2)]
        watchdog.cancel()
        if not all(line.startswith(READY) for line in lines):
            self.process.kill()
            raise RuntimeError(f"the server said {lines} and not that it listens\n{self._log()}")
        self.uri, self.locator = (line.removeprefix(READY) for line in lines)
        self.address = self.uri.removeprefix("http://")
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
