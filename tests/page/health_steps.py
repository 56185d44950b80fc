"""Connections that fall silent or fail, figures, and what an identity of some indices sees."""

import contextlib
import os
import re
import signal
import tempfile
import urllib.request

from playwright.sync_api import expect

from support import (MAX_WAIT_S, PROBE, SPACE, frame, identities, looks, open_index, picture, probe, row, running,
                     showing, sign_in, streams_of, wait_for_count)

# A latency at the end that is no stream's: those are open for more than a second.
SHORT = re.compile(r"[\d.]+\s(ms|µs)$")


def a_server_that_comes_back_is_seen_again(page, programs, pictures):
    with tempfile.TemporaryDirectory() as data:
        with showing(page, programs, map(row, range(300)), data=data) as server:
            ports = server.ports()
        expect(page.locator("#status")).to_contain_text("trying again")
        with running(programs, data=data, ports=ports) as server:
            server.insert("arm", map(row, range(300, 400)))
            expect(page.locator("#status")).to_have_text("live")
            wait_for_count(page, 400)


def the_addresses_of_a_new_start_are_shown(page, programs, pictures):
    """The page stays where it was, and gRPC listens on another port."""
    with tempfile.TemporaryDirectory() as data:
        with showing(page, programs, map(row, range(100)), data=data) as server:
            probe(page, PROBE, 5)
            expect(page.locator("#snippets")).to_contain_text(server.uri)
            first, at = server.ports()
        expect(page.locator("#status")).to_contain_text("trying again")
        with running(programs, data=data, ports=("0", at)) as server:
            assert server.ports()[0] != first
            expect(page.locator("#status")).to_have_text("live")
            probe(page, PROBE, 6)
            expect(page.locator("#snippets")).to_contain_text(server.uri)


def too_many_streams_say_what_helps(page, programs, pictures):
    with running(programs) as server, contextlib.ExitStack() as streams:
        for _ in range(16):
            request = urllib.request.Request(f"{server.page}api/v1/overview", method="POST")
            streams.enter_context(urllib.request.urlopen(request, timeout=MAX_WAIT_S)).read(8)
        page.goto(server.page)
        expect(page.locator("#notice")).to_contain_text("close other tabs of the page")
        streams.close()
        expect(page.locator("#status")).to_have_text("live")


def damaged_and_lagging_indices_come_first(page, programs, pictures):
    """The stream is made up: a healthy server has neither."""
    index = {"space_text": SPACE, "coordinate_count": 7, "dimension": 6, "point_count": "3", "memory_bytes": "4096",
             "revision": {"uid": "u", "number": "2"}}
    made = {"indexes": [{**index, "name": name} for name in ("arm", "leg")],
            "damaged": [{"name": "tail", "uid": "t", "error": {"message": "a record has a wrong checksum"}}]}
    metrics = 'wayfold_index_subscribers{index="leg"} 1\nwayfold_index_subscriber_lag{index="leg"} 500\n'
    # A lag shows once it was there ten times.
    body = frame({"kind": "overview", "list": made, "metrics": metrics}) * 10
    page.route("**/api/v1/overview", lambda route: route.fulfill(body=body, content_type="application/octet-stream"))
    with running(programs) as server:
        page.goto(server.page)
        rows = page.locator("#indices tbody tr")
        expect(rows).to_have_count(5)
        expect(rows).to_contain_text(["tail", "a record has a wrong checksum", "leg", "500 revisions behind", "arm"])
        expect(rows.nth(1)).to_contain_text("Copy the data directory before anything else")
        expect(rows.nth(3)).to_contain_text("write less, or give it more cores")
        # A telephone shows all of it, and nothing beside its edge.
        page.set_viewport_size({"width": 390, "height": 844})
        for label, text in {"memory": "4 KiB", "subscribers": "1", "lag": "500"}.items():
            expect(page.locator(f'[data-index="leg"] [data-label="{label}"]')).to_be_visible()
            expect(page.locator(f'[data-index="leg"] [data-label="{label}"]')).to_have_text(text)
        assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
        looks(page, pictures, "damaged")


def a_silent_server_is_noticed(page, programs, pictures):
    """A server that stands still keeps its connections, so only the silence tells."""
    with showing(page, programs, map(row, range(100))) as server:
        urls = streams_of(page, "points")
        os.kill(server.process.pid, signal.SIGSTOP)
        expect(page.locator("#status")).to_contain_text("no word from the server")
        os.kill(server.process.pid, signal.SIGCONT)
        server.insert("arm", map(row, range(100, 150)))
        wait_for_count(page, 150)
        expect(page.locator("#status")).to_have_text("live")
        assert urls and all("after=" in it for it in urls), urls


def a_quiet_index_is_no_silence(page, programs, pictures):
    """Where nothing happens, the server says so often enough."""
    with showing(page, programs, map(row, range(100))):
        urls = streams_of(page, "points")
        page.wait_for_timeout(30_000)
        expect(page.locator("#status")).to_have_text("live")
        assert not urls, urls


def a_failed_description_is_asked_for_again(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(100)))
        failures = iter(range(3))
        page.route("**/arm/info", lambda route: route.abort() if next(failures, None) is not None else route.fallback())
        open_index(page, server, "arm")
        wait_for_count(page, 100)
        assert next(failures, None) is None


def streams_are_no_latencies(page, programs, pictures):
    """A stream that was open for more than a second counts as a call, and not in the percentiles."""
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(100)))
        urls = streams_of(page, "overview")
        page.goto(server.page)
        for _ in range(3):
            server.command("knn", "arm", "--state", PROBE, "-k", "3")
            request = urllib.request.Request(f"{server.page}api/v1/arm/points?follow=true", method="POST")
            with urllib.request.urlopen(request, timeout=MAX_WAIT_S) as stream:
                stream.read(8)
                page.wait_for_timeout(1500)
        line = page.locator("#calls tbody tr", has=page.get_by_role("rowheader", name="points", exact=True))
        expect(line.locator('[data-label="calls/s"]')).not_to_have_text("0")
        expect(line.locator('[data-label="p99"]')).to_have_text("–")
        p99 = page.locator('#indices tbody tr [data-label="p99"]')
        expect(p99).to_have_text(SHORT)
        tile = page.locator(".tile", has_text="Calls a second").locator(".more")
        expect(tile).to_have_text(SHORT)
        # All of it came by one stream.
        assert len(urls) == 1, urls
        picture(page, pictures, "overview")


def a_wrong_role_sees_nothing(page, programs, pictures):
    with identities(("admin", "admin", "*"), ("leg", "read", "leg")) as (settings, token):
        with running(programs, settings=settings) as server:
            own = ["--token-file", token("admin")]
            server.command(*own, "create", "arm", "--space", SPACE)
            server.command(*own, "insert", "arm", "-", input="0,0,0,0,0,0,1\n")
            page.goto(f"{server.page}#/arm")
            sign_in(page, "wrong")
            expect(page.locator("#sign-in-error")).not_to_be_empty()
            sign_in(page, "leg")
            expect(page.locator("#notice")).to_contain_text("arm")
            expect(page.locator("#count")).to_have_text("0 points")
            page.reload()
            sign_in(page, "admin")
            wait_for_count(page, 1)


def an_identity_of_some_indices_has_no_figures(page, programs, pictures):
    with identities(("admin", "admin", "*"), ("leg", "read", "leg")) as (settings, token):
        with running(programs, settings=settings) as server:
            own = ["--token-file", token("admin")]
            for index in ("arm", "leg"):
                server.command(*own, "create", index, "--space", SPACE)
                server.command(*own, "insert", index, "-", input="0,0,0,0,0,0,1\n")
            page.goto(server.page)
            sign_in(page, "leg")
            expect(page.locator("#indices tbody tr")).to_have_count(1)
            expect(page.locator('[data-index="leg"] [data-label="points"]')).to_have_text("1")
            expect(page.locator('[data-index="leg"] [data-label="calls/s"]')).to_contain_text("–")
            expect(page.locator(".tile", has_text="Calls a second")).to_contain_text("figures need an identity that may read /metrics")
            expect(page.locator("#calls-empty")).to_contain_text("figures need an identity that may read /metrics")
            picture(page, pictures, "no-figures")
