"""Streams that fall silent, figures, and what an identity of some indices sees."""

import json
import os
import signal
import urllib.request

from playwright.sync_api import expect

from support import MAX_WAIT_S, SPACE, open_index, row, running, wait_for_count


def a_silent_server_is_noticed(page, programs, pictures):
    """A server that stands still keeps its connections, so only the silence tells."""
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(100)))
        open_index(page, server, "arm")
        wait_for_count(page, 100)
        asked = []
        page.on("request", lambda request: asked.append(request.url) if "/points?" in request.url else None)
        os.kill(server.process.pid, signal.SIGSTOP)
        expect(page.locator("#status")).to_contain_text("no word from the server", timeout=MAX_WAIT_S * 1000)
        os.kill(server.process.pid, signal.SIGCONT)
        server.insert("arm", map(row, range(100, 150)))
        wait_for_count(page, 150)
        expect(page.locator("#status")).to_have_text("live", timeout=MAX_WAIT_S * 1000)
        assert asked and all("after=" in it for it in asked), asked


def a_failed_description_is_asked_for_again(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(100)))
        failures = iter(range(3))
        page.route("**/arm/info", lambda route: route.abort() if next(failures, None) is not None else route.fallback())
        open_index(page, server, "arm")
        wait_for_count(page, 100)


def streams_are_no_latencies(page, programs, pictures):
    """A watch of some seconds is a call, and its time is no latency."""
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(100)))
        page.goto(server.page)
        for _ in range(3):
            server.command("knn", "arm", "--state", "5,5,1,0,0,0,1", "-k", "3")
            with urllib.request.urlopen(urllib.request.Request(f"{server.page}api/v1/arm/points?follow=true", method="POST"), timeout=5) as stream:
                stream.read(8)
                page.wait_for_timeout(1500)
        line = page.locator("#calls tbody tr", has=page.get_by_role("rowheader", name="points", exact=True))
        expect(line.locator('[data-label="calls/s"]')).not_to_have_text("0", timeout=MAX_WAIT_S * 1000)
        expect(line.locator('[data-label="p99"]')).to_have_text("–")
        for cell in [page.locator("#indices tbody tr").locator('[data-label="p99"]'), page.locator(".tile", has_text="Calls a second")]:
            expect(cell).to_contain_text("ms")
            assert "1.5 s" not in cell.inner_text() and " s" not in cell.inner_text().split("p99")[-1], cell.inner_text()


def addresses_of(server):
    request = urllib.request.Request(f"{server.page}api/v1/addresses", method="POST")
    with urllib.request.urlopen(request, timeout=MAX_WAIT_S) as answer:
        return json.load(answer)
