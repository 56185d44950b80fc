"""The projections, against the geometry: they are asked in the browser where they put states."""

import math

from playwright.sync_api import expect

from support import looks, open_index, running, wait_for_count

PLACES = """async ([text, width, id, states]) => {
  const { parseSpace } = await import('./space.js');
  const { projectionsOf } = await import('./projections.js');
  const found = projectionsOf(parseSpace(text, width));
  const projection = found.find(one => one.id === id);
  const low = states[0].map((_, c) => Math.min(...states.map(state => state[c])));
  const high = states[0].map((_, c) => Math.max(...states.map(state => state[c])));
  const { project } = projection.fit({ low, high });
  const places = states.map(state => { const out = [0, 0, 0]; project(state, 0, out); return out; });
  return [found.map(one => one.id), places];
}"""


def quaternion(vector):
    """The canonical quaternion of a rotation vector."""
    angle = math.hypot(*vector)
    scale = math.sin(angle / 2) / angle if angle else 0.5
    q = [*(scale * it for it in vector), math.cos(angle / 2)]
    return q if q[3] >= 0 else [-it for it in q]


def projections_are_the_geometry(page, programs, pictures):
    with running(programs) as server:
        page.goto(server.page)

        def expect_places(space, width, id, states, places, first=None):
            ids, found = page.evaluate(PLACES, [space, width, id, states])
            assert ids[0] == (first or id), (space, ids)
            for state, place, expected in zip(states, found, places):
                assert math.dist(place, expected) < 1e-9, (space, id, state, place, expected)

        # A position is where it is, and a rotation is its rotation vector: its axis times its angle.
        vectors = [[0, 0, 0], [0.5, 0, 0], [0, -1.25, 0], [1, 2, -2], [0, 0, math.pi]]
        expect_places("sum(R3, SO3)", 7, "r3-0", [[x, 2 * x, -x, 0, 0, 0, 1] for x in range(4)], [[x, 2 * x, -x] for x in range(4)])
        expect_places("SO3", 4, "so3-0", [quaternion(it) for it in vectors], vectors)
        # The opposite quaternion is the same rotation.
        opposite = [[-it for it in quaternion(vector)] for vector in vectors[:4]]
        expect_places("SO3", 4, "so3-0", opposite, vectors[:4])
        # The angle of a plane goes upwards, or around a ring whose ends meet.
        poses = [[0, 5, -math.pi], [4, 6, 0], [2, 7, math.pi / 2], [0, 5, math.pi]]
        expect_places("sum(R2, SO2:0.5)", 3, "r2-angle-0", poses, poses)
        ring = [[(2 + x) * math.cos(angle), (2 + x) * math.sin(angle), y] for x, y, angle in poses]
        expect_places("sum(R2, SO2:0.5)", 3, "r2-ring-0", poses, ring, first="r2-angle-0")
        # An angle of another period goes once around the circle.
        expect_places("SO2[4]", 1, "circle", [[-2], [0], [1]], [[-1, 0, 0], [1, 0, 0], [0, 1, 0]])
        # Joints are lines at first, and any three of them are one choice away.
        for space, width in [("sum(R1^7)", 7), ("R6", 6), ("SO2^6", 6), ("SO2[2]^4", 4)]:
            states = [[at + c for c in range(width)] for at in range(3)]
            expect_places(space, width, "first", states, [state[:3] for state in states], first="parallel")


def numbers_of_axes_tell_their_steps(page, programs, pictures):
    """Points that differ in the fourth digit: so do the numbers beside them."""
    with running(programs) as server:
        server.command("create", "near", "--space", "R2")
        server.insert("near", [[1 + number / 10_000, 10 + number / 10_000] for number in range(21)])
        open_index(page, server, "near")
        wait_for_count(page, 21)
        for view in ("flat-0", "parallel"):
            page.select_option("#axes-preset", view)
            if view == "parallel":
                expect(page.locator("#axes .upright").first).to_be_attached()
            expect(page.locator("#axes .number", has_text="1.0005")).to_have_count(1)
            numbers = page.locator("#axes .number").all_text_contents()
            assert len(set(numbers)) == len(numbers) and "10.0010" in numbers, numbers
            looks(page, pictures, f"numbers-{view}")
