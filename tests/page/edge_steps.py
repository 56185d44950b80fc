"""Edges, against the payloads that were stored. The ids are eight letters each, so that the command line can write payloads."""

import re

from playwright.sync_api import expect

from support import open_index, running, wait_for_count


def number(name):
    return int.from_bytes(name.encode(), "little")


def put(server, *points):
    lines = "id,x,y\n" + "".join(f"{number(name)},{x},{y}\n" for name, x, y in points)
    server.command("insert", "roads", "-", "--ids", "id", "--replace", input=lines)


def link(server, name, *others):
    server.command("update", "roads", str(number(name)), "--payload", "".join(others))


def expect_edges(page, edges):
    expect(page.locator("#edges-about")).to_have_text(re.compile(f"^{edges} edges?$"))


def edges_follow_the_payloads(page, programs, pictures):
    a, b, c, d = "pointAAA", "pointBBB", "pointCCC", "pointDDD"
    with running(programs) as server:
        server.command("create", "roads", "--space", "R2", "--payloads", "edges")
        put(server, (a, 0, 0), (b, 1, 0), (c, 1, 1))
        link(server, a, b)
        link(server, b, a, c)
        open_index(page, server, "roads")
        wait_for_count(page, 3)
        # Both ends list the edge of a and b.
        expect_edges(page, 2)
        # One end does not any more.
        link(server, b, c)
        link(server, c, b, d)
        expect_edges(page, 2)
        # The other end comes, leaves, and comes again.
        put(server, (d, 0, 1))
        expect_edges(page, 3)
        expect(page.locator("#sampled")).to_have_text("3 edges")
        server.command("remove", "roads", str(number(d)))
        expect(page.locator("#sampled")).to_have_text("2 edges")
        put(server, (d, 0, 2))
        expect(page.locator("#sampled")).to_have_text("3 edges")
        # A point that moves has lost its own list; what the others list reaches its new place.
        put(server, (b, 2, 0))
        expect(page.locator("#sampled")).to_have_text("3 edges")
        link(server, a)
        expect(page.locator("#sampled")).to_have_text("2 edges")
        link(server, c)
        expect(page.locator("#sampled")).to_have_text("")
        expect_edges(page, 0)


def edges_need_a_declaration(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "roads", "--space", "R2")
        put(server, ("pointAAA", 0, 0), ("pointBBB", 1, 0))
        link(server, "pointAAA", "pointBBB")
        open_index(page, server, "roads")
        wait_for_count(page, 2)
        expect(page.locator("#edges-about")).to_have_text("the index declares no edges")
        expect(page.locator("#edges")).to_be_disabled()
