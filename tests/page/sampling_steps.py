"""Samples of indices that have more points than are shown."""

import re

from playwright.sync_api import expect

from support import MAX_WAIT_S, SPACE, row, running, wait_until_drawn

SHOWN = re.compile(r"shows ([\d,]+) of ([\d,]+) points")


def requests_of_points(page):
    """The addresses of the streams of points that the page asks for, from now on."""
    asked = []
    page.on("request", lambda request: asked.append(request.url) if "/points?" in request.url else None)
    return asked


def shown_of(page, points):
    """The number of points that the page shows once it knows that there are `points`."""
    expect(page.locator("#sampled")).to_have_text(re.compile(f"of {points:,} points"), timeout=MAX_WAIT_S * 1000)
    return int(SHOWN.search(page.locator("#sampled").inner_text())[1].replace(",", ""))


def open_sampled(page, server, index, most):
    page.goto(f"{server.page}?max={most}#/{index}")
    wait_until_drawn(page)


def a_sample_goes_on_after_a_cut(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(4000)))
        asked = requests_of_points(page)
        open_sampled(page, server, "arm", 1000)
        before = shown_of(page, 4000)
        assert 850 < before < 1150, before
        page.context.set_offline(True)
        server.insert("arm", map(row, range(4000, 4400)))
        # A connection of this machine outlives that, so the page is told to ask anew by a server that stands still.
        page.context.set_offline(False)
        after = shown_of(page, 4400)
        assert before < after < before + 160, (before, after)
        assert len(asked) >= 1


def an_index_that_grows_is_sampled_again(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(500)))
        asked = requests_of_points(page)
        open_sampled(page, server, "arm", 1000)
        expect(page.locator("#count")).to_have_text("500 points")
        expect(page.locator("#sampled")).to_have_text("")
        for number in range(500, 5000, 500):
            server.insert("arm", map(row, range(number, number + 500)))
        shown = shown_of(page, 5000)
        assert 750 < shown <= 1250, shown
        # The last stream goes on where the one before ended, with a share that a sample of the server has too.
        share = float(re.search(r"share=([\d.]+)", asked[-1])[1])
        assert 0.1 < share < 0.4 and "after=" in asked[-1], asked
        # Removals are counted in the sample: all points are removed, and none is left.
        ids = [line.split(",")[0] for line in server.command("scan", "arm").splitlines()[1:]]
        for at in range(0, len(ids), 500):
            server.command("remove", "arm", *ids[at:at + 500])
        expect(page.locator("#count")).to_have_text("0 points", timeout=MAX_WAIT_S * 1000)
