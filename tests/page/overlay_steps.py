"""Several indices in one picture."""

import re

from playwright.sync_api import expect

from support import PROBE, SPACE, looks, probe, row, running, set_hidden, streams_of, wait_for_count


def many_indices_leave_room_for_calls(page, programs, pictures):
    """A browser has six connections for a server without TLS, and each index takes one."""
    names = [f"arm-{number}" for number in range(6)]
    with running(programs) as server:
        for name in names:
            server.command("create", name, "--space", SPACE)
            server.insert(name, map(row, range(100)))
            server.command("remove", name, "7")
        page.goto(f"{server.page}#/{','.join(names)}")
        wait_for_count(page, 4 * 99)
        expect(page.locator("#notice")).to_have_text("At most 4 indices are shown in one picture.")
        page.click("#slider")
        expect(page.locator("#revision-notes")).not_to_contain_text("reading")
        page.click("#live")
        answer = server.json("knn", names[0], "--state", PROBE, "-k", "5")
        assert probe(page, PROBE, 5) == list(zip(map(str, answer["ids"]), answer["distances"]))
        # Their revisions are numbered alike, so the slider counts all.
        page.evaluate("() => { const s = document.getElementById('slider'); s.value = 1; s.dispatchEvent(new Event('input')); }")
        expect(page.locator("#revision")).to_have_text("revision 1: 400 points")
        page.goto(f"{server.page}#/{','.join(names[:2])}")
        expect(page.locator("#notice")).to_be_hidden()


def a_hidden_tab_leaves_its_connections(page, programs, pictures):
    """The tabs of a browser share six connections: four indices and the overview leave one, which a second overview takes."""
    names = [f"arm-{number}" for number in range(4)]
    with running(programs) as server:
        for name in names:
            server.command("create", name, "--space", SPACE)
            server.insert(name, map(row, range(100)))
        context = page.context.browser.new_context()
        first, second = context.new_page(), context.new_page()
        first.goto(f"{server.page}#/{','.join(names)}")
        wait_for_count(first, 400)
        expect(first.locator("#status")).to_have_text("live")
        # The tab with too few connections says that it waits, and its probe does too.
        second.goto(f"{server.page}#/arm-0")
        expect(second.locator("#status")).to_have_text("connecting")
        second.fill("#probe-state", PROBE)
        second.click("#probe-run")
        expect(second.locator("#probe-error")).to_contain_text("waits for the server")
        set_hidden(first, True)
        expect(first.locator("#status")).to_contain_text("paused")
        wait_for_count(second, 100)
        expect(second.locator("#status")).to_have_text("live")
        answer = server.json("knn", "arm-0", "--state", PROBE, "-k", "5")
        assert probe(second, PROBE, 5) == list(zip(map(str, answer["ids"]), answer["distances"]))
        # Shown again, it asks for what came meanwhile.
        server.insert("arm-0", map(row, range(100, 150)))
        second.close()
        expect(first.locator("#count")).to_have_text("400 points")
        urls = streams_of(first, "points")
        set_hidden(first, False)
        wait_for_count(first, 450)
        expect(first.locator("#status")).to_have_text("live")
        assert len(urls) == 4 and all("after=" in it and "share=1" in it for it in urls), urls
        context.close()


def long_names_are_told_apart(page, programs, pictures):
    """The names are those of the trees of `maze`, whose ends differ."""
    start, goal = (f"planning-1578819d-97ba-4a6e-a50c-b14820a990f6-{tree}" for tree in ("start", "goal"))
    with running(programs) as server:
        page.goto(server.page)
        # The server is not at the usual address.
        expect(page.locator("#create-hint")).to_have_text(f"wayfold create arm --space 'R3*SO3:0.15' --server {server.uri}")
        for name, space in [("apart", "R3"), ("beside", SPACE), (goal, SPACE), (start, SPACE)]:
            server.command("create", name, "--space", space)
        expect(page.locator("#indices tbody tr")).to_have_count(4)
        # Names wrap before the last columns are cut off.
        page.set_viewport_size({"width": 900, "height": 800})
        assert page.evaluate("() => { const it = document.querySelector('#indices').parentElement; "
                             "return it.scrollWidth <= it.clientWidth; }")
        page.set_viewport_size({"width": 1280, "height": 800})
        looks(page, pictures, "long-names-overview")
        page.goto(f"{server.page}#/{start}")
        expect(page.locator("#empty")).to_contain_text(f"wayfold insert {start} - --server {server.uri}")
        expect(page.locator("#revisions-about")).to_be_hidden()
        for name in (start, goal):
            server.insert(name, map(row, range(100)))
        expect(page.locator("#layers li")).to_have_count(4)
        assert page.locator("#layers .layer-name").all_text_contents() == [start, goal, "beside", "apart"]
        page.goto(f"{server.page}#/{start},{goal}")
        wait_for_count(page, 200)
        expect(page.locator("#revisions-about")).to_be_visible()
        options = page.locator("#probe-index option").all_text_contents()
        assert options[0].endswith("-start") and options[1].endswith("-goal") and all(len(it) <= 20 for it in options), options
        # Only the narrow legend has short names.
        expect(page.locator("#legend li")).to_have_text([start, goal])
        looks(page, pictures, "long-names")
        page.set_viewport_size({"width": 390, "height": 844})
        expect(page.locator("#legend li")).to_have_text([re.compile("….*-start$"), re.compile("….*-goal$")])
