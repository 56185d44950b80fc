"""The stock client of an overloaded server; `tests/overload/run` starts it."""

import argparse
import asyncio
import collections
import itertools
import math
import os
import random
import sys
import tempfile
import time

import grpc

from processes import MAX_WAIT_S, Server, generate_stubs

CONNECTIONS = 50
POINTS = 10_000
ROWS = 200
K = 10
DEADLINE_S = 0.5
# A round asks for more than the server can answer before the deadline: 4,000 calls at once.
ROUNDS = 3
CALLS_OF_ROUND = 80
# The calls that measure what the server can answer are under way all the time.
CALLS_OF_PEAK = 64
# The pace of the checks of health and of a load: nothing is waited for by it.
TICK_S = 0.005
# The client ends each call at its deadline itself. With all processors busy it has been seen to forget one.
MAX_LATE_S = 10
MAX_TEST_S = 300


class Clients:
    """Connections that ask for the neighbours of stored points, each of which is its own nearest one."""

    def __init__(self, address, modules):
        self.indexes_pb, self.points_pb, self.types_pb, indexes_grpc, points_grpc = modules
        options = [("grpc.use_local_subchannel_pool", 1), ("grpc.enable_retries", 0)]
        self.channels = [grpc.aio.insecure_channel(address, options) for _ in range(CONNECTIONS + 1)]
        *asking, self.bystander = self.channels
        self.indexes = indexes_grpc.IndexServiceStub(self.bystander)
        self.points = [points_grpc.PointServiceStub(channel) for channel in asking]
        self.outcomes = collections.Counter()

    async def fill(self):
        """Stores the points, once all connections are open."""
        await asyncio.gather(*(channel.channel_ready() for channel in self.channels))
        await self.indexes.CreateIndex(self.indexes_pb.CreateIndexRequest(name="arm", space_text="R3*SO3"))
        numbers = random.Random(7)
        rows = [random_state(numbers) for _ in range(POINTS)]
        states = self.types_pb.States(row_count=POINTS, coordinates=itertools.chain(*rows))
        await self.points[0].Insert(self.points_pb.InsertRequest(index_name="arm", states=states, ids=range(POINTS)))
        states = self.types_pb.States(row_count=ROWS, coordinates=itertools.chain(*rows[:ROWS]))
        self.request = self.points_pb.KnnRequest(index_name="arm", states=states, k=K)

    async def ask(self, connection: int, deadline_s: float = DEADLINE_S) -> bool:
        """Asks once, and counts the outcome; true if it was answered in time."""
        is_short = deadline_s == DEADLINE_S
        try:
            answer = await self.points[connection].Knn(self.request, timeout=deadline_s)
        except grpc.aio.AioRpcError as error:
            self.outcomes[error.code().name] += 1
            if error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED:
                details = dict(error.trailing_metadata()).get("grpc-status-details-bin", b"")
                assert b"google.rpc.RetryInfo" in details, "a refusal does not say when to retry"
            else:
                assert is_short and error.code() is grpc.StatusCode.DEADLINE_EXCEEDED, error
            return False
        self.outcomes["OK"] += 1
        assert list(answer.neighbors.ids[::K]) == list(range(ROWS)), "a point is not the nearest of itself"
        return True

    async def answered(self, calls: list[asyncio.Task]) -> int:
        """Waits for calls with short deadlines; returns how many were answered."""
        ended, forgotten = await asyncio.wait(calls, timeout=DEADLINE_S + MAX_LATE_S)
        self.outcomes["forgotten"] += len(forgotten)
        for call in forgotten:
            call.cancel()
        return sum(call.result() for call in ended)

    async def health(self):
        """Asks for the server's health until it is cancelled, and yields the seconds that each answer took."""
        # The empty request means the whole server, and the answer is field 1: SERVING.
        check = self.bystander.unary_unary("/grpc.health.v1.Health/Check")
        while True:
            began = time.monotonic()
            assert await check(b"", timeout=MAX_WAIT_S) == b"\x08\x01", "the server does not serve"
            yield time.monotonic() - began
            await asyncio.sleep(TICK_S)

    async def connection_ends(self):
        """Ends once a connection ends."""
        ready = grpc.ChannelConnectivity.READY
        ends = [asyncio.create_task(channel.wait_for_state_change(ready)) for channel in self.channels]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)


def random_state(numbers: random.Random) -> list[float]:
    """A position, and a rotation as a unit quaternion."""
    quaternion = [numbers.gauss(0, 1) for _ in range(4)]
    return [numbers.random() for _ in range(3)] + [number / math.hypot(*quaternion) for number in quaternion]


async def overload(clients: Clients):
    """Rounds of calls that come at once. Most of those with a short deadline are cancelled by the client."""
    for number in range(ROUNDS):
        short, patient = [], []
        for _ in range(CALLS_OF_ROUND // 2):
            for connection in range(CONNECTIONS):
                short.append(asyncio.create_task(clients.ask(connection)))
                patient.append(asyncio.create_task(clients.ask(connection, MAX_WAIT_S)))
        answered = sum(await asyncio.gather(*patient)) + await clients.answered(short)
        assert answered > 0, f"nothing was answered in round {number}"
    assert clients.outcomes["RESOURCE_EXHAUSTED"] > 0, "nothing was refused"


async def is_answered(clients: Clients, number: int, until: float) -> bool:
    """Asks over the next connection; true if it was answered in time and before the end of the measurement."""
    return await clients.ask(number % CONNECTIONS) and time.monotonic() < until


async def peak(clients: Clients, seconds: float) -> float:
    """The calls a second that the server answers if as many are always under way."""
    until = time.monotonic() + seconds

    async def ask_on(number: int) -> int:
        answered = 0
        while time.monotonic() < until:
            answered += await is_answered(clients, number, until)
        return answered

    return sum(await asyncio.gather(*(ask_on(number) for number in range(CALLS_OF_PEAK)))) / seconds


async def goodput(clients: Clients, rate: float, seconds: float) -> tuple[float, float]:
    """The calls a second that were sent at this rate at most, and those that were answered in time."""
    began, calls = time.monotonic(), []
    until = began + seconds
    while (passed := time.monotonic() - began) < seconds:
        due = range(len(calls), int(rate * passed))
        calls += [asyncio.create_task(is_answered(clients, number, until)) for number in due]
        await asyncio.sleep(TICK_S)
    return len(calls) / seconds, await clients.answered(calls) / seconds


async def beside_health(clients: Clients, work):
    """Awaits `work` while others ask for the health; returns its result and the time of nine in ten of them."""
    took = []

    async def ask_on():
        async for seconds in clients.health():
            took.append(seconds)

    asking = asyncio.create_task(ask_on())
    working = asyncio.create_task(work)
    await asyncio.wait([asking, working], return_when=asyncio.FIRST_COMPLETED)
    assert asking.cancel() or asking.result(), "the health ended"
    assert took, "the health was not answered once"
    return await working, sorted(took)[len(took) * 9 // 10]


async def run(address: str, modules, seconds: float):
    clients = Clients(address, modules)
    await clients.fill()
    ended = asyncio.create_task(clients.connection_ends())
    await beside_health(clients, overload(clients))
    assert not ended.done(), "the server ended a connection"
    print(", ".join(f"{outcome} {count}" for outcome, count in clients.outcomes.items()))
    if seconds:
        most, health = await beside_health(clients, peak(clients, seconds))
        print(f"peak {most:.0f}/s, health's p90 {health * 1e3:.1f} ms")
        for factor in (2, 4):
            (sent, answered), health = await beside_health(clients, goodput(clients, factor * most, seconds))
            share = f"{answered / most:.2f} of the peak"
            print(f"sent {sent:.0f}/s, answered {answered:.0f}/s in time, {share}, health's p90 {health * 1e3:.1f} ms")
    assert not ended.done(), "the server ended a connection"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--server", required=True, help="the server's binary")
    parser.add_argument("--seconds", type=float, default=0, help="how long to measure each load after the test")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        modules = generate_stubs(directory, "index_service", "point_service")
        with Server(arguments.server) as server:
            test = run(server.address, modules, arguments.seconds)
            # (Not `asyncio.run`, which would wait for a forgotten call at the end, as the close of its channel would.)
            asyncio.new_event_loop().run_until_complete(asyncio.wait_for(test, MAX_TEST_S + 10 * arguments.seconds))
    print("The overloaded server answered in time, and refused the rest.")


if __name__ == "__main__":
    status = 0
    try:
        main()
    except (AssertionError, OSError, RuntimeError, grpc.RpcError) as error:
        print(f"error: {error or 'it took too long'}", file=sys.stderr)
        status = 1
    sys.stdout.flush()
    # The connections are open.
    os._exit(status)
