"""Processes of the suites, and stubs generated from the repository's .proto files."""

import importlib
import subprocess
import sys
from pathlib import Path

PROTO = Path(__file__).resolve().parents[2] / "proto"
# The maximum time for a process to start or to stop, after which the test fails.
MAX_WAIT_S = 120


def generate_stubs(directory: str):
    """Generates the stubs of the messages."""
    import grpc_tools
    from grpc_tools import protoc

    files = sorted(str(path.relative_to(PROTO)) for path in PROTO.glob("wayfold/v1/*.proto"))
    well_known = str(Path(grpc_tools.__file__).parent / "_proto")
    if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", f"--python_out={directory}", *files]) != 0:
        raise RuntimeError(f"protoc refused {files}")


def load_stubs(directory: str):
    """The modules of the messages: of the indices, of the points, and of what both share."""
    sys.path.insert(0, directory)
    return [importlib.import_module(f"wayfold.v1.{name}_pb2") for name in ("index_service", "point_service", "types")]


class Server:
    """The server's process; a context manager that yields itself with `uri` and `locator` set."""

    def __init__(self, binary):
        self.binary = binary

    def __enter__(self):
        arguments = ["--grpc", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0", "--data", "memory", "--log", "warn"]
        self.process = subprocess.Popen([self.binary, *arguments], stdout=subprocess.PIPE, text=True)
        self.uri, self.locator = (self._listening() for _ in range(2))
        return self

    def _listening(self) -> str:
        line = self.process.stdout.readline().strip()
        if not line.startswith("listening on "):
            self.process.kill()
            raise RuntimeError(f"the server said {line!r} and not that it listens")
        return line.removeprefix("listening on ")

    def __exit__(self, kind, error, trace):
        self.process.terminate()
        self.process.stdout.read()
        if self.process.wait(MAX_WAIT_S) != 0 and kind is None:
            raise RuntimeError(f"the server's exit status is {self.process.returncode}")
