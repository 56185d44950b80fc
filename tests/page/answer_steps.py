"""The answer to a probe: it is taken away once it is none to the form, to the index or to the picture."""

import re

from playwright.sync_api import expect

from support import (PROBE, SPACE, open_index, picture, probe, row, running, set_slider, showing, wait_for_count,
                     wait_until_drawn)


def expect_no_answer(page):
    expect(page.locator("#answer")).to_be_hidden()
    expect(page.locator("#marks .neighbor")).to_have_count(0)


def an_answer_is_not_shown_beside_an_error(page, programs, pictures):
    with showing(page, programs, map(row, range(100))):
        probe(page, PROBE, 5)
        page.fill("#probe-state", "1,2")
        page.click("#probe-run")
        expect(page.locator("#probe-error")).to_contain_text("2 numbers")
        expect_no_answer(page)


def an_answer_is_about_one_index(page, programs, pictures):
    with running(programs) as server:
        for name in ("arm", "leg"):
            server.command("create", name, "--space", SPACE)
            server.insert(name, map(row, range(100)))
        page.goto(f"{server.page}#/arm,leg")
        wait_for_count(page, 200)
        # The index that arrives first is chosen at first.
        page.select_option("#probe-index", "arm")
        probe(page, PROBE, 5)
        page.select_option("#probe-index", "leg")
        expect_no_answer(page)
        # The state stays for an index of the same space.
        expect(page.locator("#probe-state")).to_have_value(PROBE)
        open_index(page, server, "arm")
        probe(page, PROBE, 5)
        server.command("delete", "arm")
        expect(page.locator("#status")).to_have_text("refused by the server")
        # The picture of an index that is gone is pale.
        expect(page.locator("#picture")).to_have_css("opacity", "0.6")
        picture(page, pictures, "deleted")
        page.click("#probe-run")
        expect(page.locator("#probe-error")).to_contain_text("arm")
        expect_no_answer(page)
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(150)))
        wait_for_count(page, 150)
        # The description of the new index has come.
        expect(page.locator("#status")).to_have_text("live")
        probe(page, PROBE, 5)
        # An index of the same name and of another space is another index.
        server.command("delete", "arm")
        server.command("create", "arm", "--space", "R2")
        server.insert("arm", [(1, 2), (3, 4)])
        wait_for_count(page, 2)
        expect(page.locator("#probe-names")).to_have_text("x, y")
        expect_no_answer(page)
        expect(page.locator("#probe-state")).to_have_value("")


def an_answer_beside_the_past_says_so(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        for number in range(3):
            server.insert("arm", map(row, range(100 * number, 100 * number + 100)))
        newest = int(server.json("info", "arm")["revision"]["number"])
        open_index(page, server, "arm")
        wait_for_count(page, 300)
        probe(page, PROBE, 5)
        past = page.locator("#answer-past")
        expect(past).to_be_hidden()
        set_slider(page, newest - 1)
        expect(past).to_have_text(re.compile(f"newest revision; the picture shows revision {newest - 1}"))
        probe(page, PROBE, 6)
        expect(past).to_be_visible()
        page.click("#live")
        expect(past).to_be_hidden()


def a_late_point_gives_way_to_what_came_after_it(page, programs, pictures):
    """The page asks the server for a point that it probes. Another search, or `Clear`, does not wait for that."""
    with showing(page, programs, [(0, 0), (10, 10), (4, 4), (9, 3)], space="R2"):
        held = []
        page.route("**/arm/get", lambda route: held.append(route))
        for later in (lambda: probe(page, "9, 9", 2), lambda: page.click("#probe-clear")):
            with page.expect_request("**/arm/get"):
                page.locator("#picture").press("Enter")
            later()
            with page.expect_response("**/arm/get") as answer:
                held.pop().continue_()
            answer.value.finished()
            # The page has the late answer before it has this one.
            page.evaluate("() => fetch('healthz').then((answer) => answer.text())")
            expect(page.locator("#probe-state")).to_have_value("9, 9")
        expect_no_answer(page)


def an_answer_says_how_many_are_drawn(page, programs, pictures):
    with showing(page, programs, map(row, range(500))):
        probe(page, PROBE, 301)
        expect(page.locator("#answer-about")).to_contain_text("The nearest 300 are drawn.")
        expect(page.locator("#marks .neighbor")).to_have_count(300)
        probe(page, PROBE, 300)
        expect(page.locator("#answer-about")).not_to_contain_text("drawn")


def enter_probes_the_point_in_the_middle(page, programs, pictures):
    """Where no point is within a click's reach of the middle, too. In parallel coordinates, it is the line."""
    # The middle is (5, 5), and halfway between the axes about 5.5. The nearest differ, so that no old answer passes.
    with showing(page, programs, [(0, 0), (10, 10), (4, 4), (9, 3)], space="R2"):
        for preset, nearest in (("spatial", "4, 4"), ("parallel", "9, 3")):
            if preset == "parallel":
                page.select_option("#axes-preset", "parallel")
                # A line is picked as it was drawn last.
                expect(page.locator("#axes .upright").first).to_be_attached()
            wait_until_drawn(page)
            page.locator("#picture").press("Enter")
            expect(page.locator("#probe-state")).to_have_value(nearest)
            expect(page.locator("#neighbors tr")).to_have_count(4)
