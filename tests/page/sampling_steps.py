"""Samples of indices that have more points than are shown."""

import re
import tempfile

from playwright.sync_api import expect

from support import SPACE, row, running, set_slider, streams_of, wait_until_drawn

SHOWN = re.compile(r"shows ([\d,]+) of ([\d,]+) points")


def shown_of(page, index, points, server):
    """The number of points that the page shows once it has all of them up to the newest revision, and knows that there are
    `points`. The number of all comes by the overview, and may come before the points do."""
    newest = int(server.json("info", index)["revision"]["number"])
    expect(page.locator("#revision")).to_have_text(re.compile(f"^revision {newest:,}:"))
    expect(page.locator("#sampled")).to_have_text(re.compile(rf"shows [1-9][\d,]* of {points:,} points"))
    return int(SHOWN.search(page.locator("#sampled").inner_text())[1].replace(",", ""))


def wait_until_shown(page, shown, points):
    expect(page.locator("#sampled")).to_have_text(re.compile(f"shows {shown:,} of {points:,} points"))


def open_sampled(page, server, index, most):
    page.goto(f"{server.page}?max={most}#/{index}")
    wait_until_drawn(page)


def a_sample_goes_on_after_a_cut(page, programs, pictures):
    """It stays the same sample: the page asks only for what came meanwhile, of the same share."""
    with tempfile.TemporaryDirectory() as data:
        with running(programs, data=data) as server:
            server.command("create", "arm", "--space", SPACE)
            server.insert("arm", map(row, range(4000)))
            open_sampled(page, server, "arm", 1000)
            before = shown_of(page, "arm", 4000, server)
            assert 850 < before < 1150, before
            ports = server.ports()
        urls = streams_of(page, "points")
        expect(page.locator("#status")).to_contain_text("trying again")
        with running(programs, data=data, ports=ports) as server:
            server.insert("arm", map(row, range(4000, 4400)))
            # A page that begins now with the same share has the same number.
            whole = server.points("arm", "max=1100")
            assert whole["share"] == 0.25 and before < whole["sent"] < before + 180, (whole, before)
            wait_until_shown(page, whole["sent"], 4400)
            assert urls and all("after=" in it and "share=0.25" in it for it in urls), urls


def the_slider_of_a_sample_tells_estimates(page, programs, pictures):
    """The points of the sample are counted, and those of the index are estimated from them."""
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        for number in range(4):
            server.insert("arm", map(row, range(1000 * number, 1000 * number + 1000)))
        open_sampled(page, server, "arm", 1000)
        shown = shown_of(page, "arm", 4000, server)
        expect(page.locator("#revision")).to_contain_text(f"({shown:,} of the sample)")
        set_slider(page, 2)
        expect(page.locator("#sampled")).to_contain_text("of about")
        words = page.locator("#revision").inner_text()
        about, sampled = (int(it.replace(",", "")) for it in re.search(r"about ([\d,]+) points \(([\d,]+) of the sample\)", words).groups())
        assert 1600 < about < 2400 and 400 < sampled < 600, words
        expect(page.locator("#sampled")).to_have_text(f"shows {sampled:,} of about {about:,} points, sampled evenly")


def an_index_that_grows_is_sampled_again(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(500)))
        urls = streams_of(page, "points")
        open_sampled(page, server, "arm", 1000)
        expect(page.locator("#count")).to_have_text("500 points")
        expect(page.locator("#sampled")).to_have_text("")
        for number in range(500, 5000, 500):
            server.insert("arm", map(row, range(number, number + 500)))
        # At most a quarter more than 1,000, once the page has sampled again.
        few = re.compile(r"shows (\d{3}|1,[01]\d\d|1,2[0-4]\d|1,250) of 5,000")
        expect(page.locator("#sampled")).to_have_text(few)
        shown = shown_of(page, "arm", 5000, server)
        assert 750 < shown <= 1250, shown
        # The last stream goes on where the one before ended. The server's sample of the same share has the same number.
        share = float(re.search(r"share=([\d.e-]+)", urls[-1])[1])
        assert 0.1 < share < 0.4 and "after=" in urls[-1], urls
        sampled = server.points("arm", f"max={round(5000 * share)}")
        assert abs(sampled["share"] - share) < 1e-3 and abs(sampled["sent"] - shown) <= 5, (sampled, shown, share)
        # No point outside of the sample is left: once all are removed, there is none.
        ids = [line.split(",")[0] for line in server.command("scan", "arm").splitlines()[1:]]
        for at in range(0, len(ids), 500):
            server.command("remove", "arm", *ids[at:at + 500])
        expect(page.locator("#count")).to_have_text("0 points")
