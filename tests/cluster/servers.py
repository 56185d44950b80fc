"""Three servers that share a journal in three servers of NATS, all on this machine, for the programs that measure them."""

import contextlib
import json
import os
import socket
import subprocess
import time
import urllib.request

PROGRAMS = ["server-process", "cli-process", "inserters"]
INDEX = "cost"
SPACE = "R3*SO3:0.15"
SERVERS = 3
READY_SECONDS = 60


def wait(process, seconds):
    """Waits this long, and fails at once if the process ends meanwhile."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(seconds)
        raise RuntimeError(f"{process.args[0]} has ended by itself")


class Process:
    """A process, which can be killed and started again."""

    def __init__(self, command, **options):
        self.start = lambda: subprocess.Popen(command, text=True, **options)
        self.process = self.start()

    @property
    def pid(self):
        return self.process.pid

    def kill(self):
        self.process.kill()
        self.process.wait()

    def restart(self):
        self.process = self.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()


def free_ports(count):
    """Ports that were free a moment ago: NATS has to know those of the others before it starts."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [it.getsockname()[1] for it in sockets]
    for it in sockets:
        it.close()
    return ports


class Nats(contextlib.ExitStack):
    """Three servers of NATS that have found each other."""

    def __init__(self, directory):
        super().__init__()
        ports = free_ports(3 * SERVERS)
        clients, routes, pages = (ports[at::3] for at in range(3))
        all_routes = ", ".join(f"nats://127.0.0.1:{port}" for port in routes)
        self.urls = ",".join(f"nats://127.0.0.1:{port}" for port in clients)
        self.pages = [f"http://127.0.0.1:{port}" for port in pages]
        self.processes = []
        for at in range(SERVERS):
            config = directory / f"nats-{at}.conf"
            config.write_text(
                f'server_name: n{at}\nlisten: "127.0.0.1:{clients[at]}"\nhttp: "127.0.0.1:{pages[at]}"\n'
                f'jetstream {{ store_dir: "{directory}/nats-{at}", sync_interval: always }}\n'
                f'cluster {{ name: cost, listen: "127.0.0.1:{routes[at]}", routes: [{all_routes}] }}\n'
            )
            command = [os.environ["NATS_SERVER"], "--config", config]
            self.processes.append(self.enter_context(Process(command, stderr=subprocess.DEVNULL)))

    @property
    def pids(self):
        return [it.pid for it in self.processes]

    def leader(self, stream):
        """The number of the server that leads a stream."""
        for page in self.pages:
            found = json.load(urllib.request.urlopen(f"{page}/jsz?accounts=true&streams=true"))
            for it in found["account_details"][0].get("stream_detail", []):
                if it["name"] == stream and it["cluster"].get("leader"):
                    return int(it["cluster"]["leader"].removeprefix("n"))
        raise RuntimeError(f"stream {stream} has no leader")

    def restart(self, at):
        """Starts a killed server, and returns once it has what the others have."""
        self.processes[at].restart()
        until = time.monotonic() + READY_SECONDS
        while True:
            with contextlib.suppress(OSError):
                return urllib.request.urlopen(f"{self.pages[at]}/healthz").read()
            assert time.monotonic() < until, "a server of NATS does not come back"
            wait(self.processes[at].process, 0.2)


class Server(Process):
    """A server of Wayfold that serves at `uri`."""

    def __init__(self, programs, data, urls=None):
        faces = {"WAYFOLD_ZENOH__LISTEN": "off", "WAYFOLD_HTTP__LISTEN": "127.0.0.1:0"}
        cluster = {"WAYFOLD_CLUSTER__NATS": urls, "WAYFOLD_CLUSTER__LISTEN": "127.0.0.1:0"} if urls else {}
        command = [programs / "server-process", "--grpc", "127.0.0.1:0", "--data", data, "--log", "error"]
        super().__init__(command, stdout=subprocess.PIPE, env={**os.environ, **faces, **cluster})

    def ready(self):
        """Returns once it serves."""
        line = lambda: self.process.stdout.readline()
        self.uri, self.page = (line().removeprefix(it).strip() for it in ("listening on ", "metrics at "))
        return self

    def metric(self, name):
        """The value of a metric; None if there is none."""
        lines = urllib.request.urlopen(self.page).read().decode().splitlines()
        return next((it.removeprefix(name).strip() for it in lines if it.startswith(name)), None)


class Cluster(contextlib.ExitStack):
    """Three servers with an index."""

    def __init__(self, programs, directory, urls, index=INDEX):
        super().__init__()
        self.index = index
        started = [self.enter_context(Server(programs, directory / f"data-{at}", urls)) for at in range(SERVERS)]
        self.servers = [it.ready() for it in started]
        for it in self.servers:
            create(programs, it.uri, index)

    def owner(self):
        """The owner of the index, once all servers agree on it."""
        until = time.monotonic() + READY_SECONDS
        while True:
            heard = [it.metric('wayfold_cluster_members{state="live"}') for it in self.servers]
            own = [it for it in self.servers if it.metric(f'wayfold_index_owned{{index="{self.index}"}}') == "1"]
            if heard == [str(SERVERS)] * SERVERS and len(own) == 1:
                return own[0]
            assert time.monotonic() < until, "the servers do not find each other"
            wait(self.servers[0].process, 0.2)

    def others(self):
        own = self.owner()
        return [it for it in self.servers if it is not own]


def create(programs, uri, index):
    command = [programs / "cli-process", "--timeout", "60s", "--server", uri, "create", index, "--space", SPACE]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def insert(programs, target, *options):
    """A process that measures inserts; `target` names servers, or those of NATS for JetStream alone."""
    command = [programs / "inserters", *target, "--index", INDEX, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def figures(process):
    """What such a process has found."""
    printed, _ = process.communicate()
    assert process.returncode == 0, f"{process.args[0]} ended with {process.returncode}"
    return json.loads(printed)
