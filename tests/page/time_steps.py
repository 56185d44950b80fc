"""The slider over the revisions, against scans that were taken when those revisions were the newest."""

import os
import random
import re
import struct
import time

from playwright.sync_api import expect

from support import (MAX_WAIT_S, frame, looks, open_index, picture, running, set_hidden, set_slider, streams_of,
                     wait_for_count)

# The corners of the picture, which stay: so that pictures of different points have the same box.
CORNERS = [(0, 0.0, 0.0), (1, 9.0, 9.0)]


class Recorder:
    """Writes to an index, and keeps a scan of each revision that it makes."""

    def __init__(self, server, index):
        self.server, self.index = server, index
        self.scans = {}
        self.scan()

    def scan(self):
        """The points at the newest revision: by id, the rest of the line of a scan."""
        lines = self.server.command("scan", self.index).splitlines()[1:]
        points = dict(line.split(",", 1) for line in lines)
        self.scans[int(self.server.json("info", self.index)["revision"]["number"])] = points
        return points

    def put(self, points):
        """Stores points (id, x, y), each in the place of one with the same id."""
        lines = "id,x,y\n" + "".join(f"{id},{x},{y}\n" for id, x, y in points)
        self.server.command("insert", self.index, "-", "--ids", "id", "--replace", input=lines)
        return self.scan()

    def remove(self, *ids):
        self.server.command("remove", self.index, *map(str, ids))
        return self.scan()

    def tag(self, id, tag):
        self.server.command("update", self.index, str(id), "--tag", str(tag))
        return self.scan()


def some_points(draw, ids):
    return [(id, draw.randint(1, 8), draw.randint(1, 8)) for id in ids]


def write_a_history(recorder, draw, rounds):
    """Insertions, replacements, removals and tags, also of points that come back."""
    for _ in range(rounds):
        known = [int(id) for id in recorder.scans[max(recorder.scans)] if int(id) > 1]
        match draw.randrange(4):
            case 0:
                recorder.put(some_points(draw, draw.sample(range(2, 60), 6)))
            case 1 if known:
                recorder.put(some_points(draw, draw.sample(known, min(4, len(known)))))
            case 2 if known:
                recorder.remove(*draw.sample(known, min(5, len(known))))
            case 3 if known:
                recorder.tag(draw.choice(known), draw.randrange(8))


def expect_revision(page, revision, points):
    set_slider(page, revision)
    expect(page.locator("#revision")).to_have_text(
        re.compile(f"^revision {revision:,}: {points:,} points?$"))


def expect_past_loaded(page):
    expect(page.locator("#revision-notes")).not_to_contain_text("reading")


def pixels(page):
    """The picture alone, without the words on it."""
    page.evaluate("for (const it of document.querySelectorAll('.caption, .notes, .hint, #legend')) it.style.display = 'none'")
    before = None
    for _ in range(100):
        now = page.locator("#picture").screenshot()
        if now == before:
            return now
        before = now
        page.wait_for_timeout(700)
    raise AssertionError("the picture does not rest")


def the_slider_counts_as_scans_did(page, programs, pictures):
    """With removals and replacements before the page is opened, and after."""
    draw = random.Random(23)
    with running(programs) as server:
        server.command("create", "arm", "--space", "R2")
        recorder = Recorder(server, "arm")
        recorder.put(CORNERS)
        write_a_history(recorder, draw, 24)
        open_index(page, server, "arm")
        wait_for_count(page, len(recorder.scan()))
        # A replay is not read aloud, number by number.
        expect(page.locator("#revision")).to_have_attribute("aria-live", "off")
        write_a_history(recorder, draw, 12)
        wait_for_count(page, len(recorder.scan()))
        set_slider(page, 1)
        expect_past_loaded(page)
        for revision, points in recorder.scans.items():
            expect_revision(page, revision, len(points))
            expect(page.locator("#revision-notes")).to_have_text("")
        # They are shown where they stood: as an index that has only these points.
        removed = max(recorder.scans, key=lambda revision: len(recorder.scans[revision]))
        expect_revision(page, removed, len(recorder.scans[removed]))
        picture(page, pictures, "time")
        # The same revision has the same age in both, and the size of points does not follow their number.
        page.fill("#point-size", "6")
        shown = pixels(page)
        server.command("create", "leg", "--space", "R2")
        lines = "id,x,y\n" + "".join(",".join([id, *rest.split(",")[:2]]) + "\n" for id, rest in recorder.scans[removed].items())
        server.command("insert", "leg", "-", "--ids", "id", input=lines)
        page.goto("about:blank")
        open_index(page, server, "leg")
        wait_for_count(page, len(recorder.scans[removed]))
        page.fill("#point-size", "6")
        end = time.monotonic() + MAX_WAIT_S
        while pixels(page) != shown:
            assert time.monotonic() < end, "the picture of an earlier revision differs from one of its points"


def what_the_window_does_not_have_is_said(page, programs, pictures):
    """Points from before the log's window that were removed or replaced within it are counted, and not drawn."""
    settings = {**os.environ, "WAYFOLD_INDEX__WINDOW_BYTES": "16000"}
    draw = random.Random(5)
    with running(programs, settings=settings) as server:
        server.command("create", "arm", "--space", "R2")
        recorder = Recorder(server, "arm")
        recorder.put(CORNERS)
        recorder.put(some_points(draw, range(2, 300)))
        for at in range(2, 40):
            recorder.remove(at)
        for at in range(40, 60):
            recorder.put(some_points(draw, [at]))
        newest = max(recorder.scans)
        open_index(page, server, "arm")
        wait_for_count(page, len(recorder.scans[newest]))
        page.click("#slider")
        expect_past_loaded(page)
        notes = page.locator("#revision-notes")
        known = []
        for revision, points in recorder.scans.items():
            set_slider(page, revision)
            if "not known" in notes.inner_text():
                continue
            known.append(revision)
            expect_revision(page, revision, len(points))
            # Those whose lines were other ones before the window is over.
            later = recorder.scans[newest]
            first = min(known)
            lost = [id for id, line in points.items() if recorder.scans[first].get(id) == line and later.get(id) != line]
            not_drawn = int((re.match(r"([\d,]+) not drawn", notes.inner_text()) or [0, "0"])[1].replace(",", ""))
            assert not_drawn == len(lost), (revision, not_drawn, len(lost))
        # The window has some of the revisions, and not all.
        assert known == list(range(min(known), newest + 1)) and 1 < min(known) < newest - 20, (known, newest)
        set_slider(page, min(known))
        looks(page, pictures, "window")
        page.click("#play")
        expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
        picture(page, pictures, "replay")
        expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")
        expect(page.locator("#play")).to_have_attribute("aria-label", re.compile("^Replay"))


def a_point_of_the_past_is_probed_where_it_stood(page, programs, pictures):
    """The server knows only where it is now, and there exactly."""
    with running(programs) as server:
        server.command("create", "arm", "--space", "R2")
        recorder = Recorder(server, "arm")
        recorder.put([*CORNERS, (2, 4.5, 4.5)])
        open_index(page, server, "arm")
        wait_for_count(page, 3)
        recorder.put([(2, 1.1, 7.9)])
        expect(page.locator("#revision")).to_have_text("revision 2: 3 points")
        expect_revision(page, 1, 3)
        page.locator("#picture").press("Enter")
        expect(page.locator("#probe-state")).to_have_value("4.5, 4.5")
        # The marks are drawn with the newest points.
        expect(page.locator("#marks .neighbor")).to_have_count(3)
        page.click("#live")
        page.locator("#picture").press("Enter")
        expect(page.locator("#probe-state")).to_have_value("1.1, 7.9")


def an_index_that_is_made_again_is_shown_at_its_newest(page, programs, pictures):
    """The slider held a revision of the former index."""
    with running(programs) as server:
        server.command("create", "arm", "--space", "R2")
        for number in range(3):
            server.insert("arm", [(number, 0)])
        open_index(page, server, "arm")
        wait_for_count(page, 3)
        expect_revision(page, 1, 1)
        server.command("delete", "arm")
        server.command("create", "arm", "--space", "R2")
        for number in range(2):
            server.insert("arm", [(number, it) for it in range(10)])
        expect(page.locator("#revision")).to_have_text("revision 2: 20 points")
        expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")


def a_hidden_tab_reads_no_past(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", "R2")
        recorder = Recorder(server, "arm")
        recorder.put(CORNERS)
        recorder.remove(1)
        open_index(page, server, "arm")
        wait_for_count(page, 1)
        set_hidden(page, True)
        urls = streams_of(page, "points")
        set_slider(page, 1)
        expect(page.locator("#revision-notes")).to_contain_text("reading the log")
        expect(page.locator("#status")).to_contain_text("paused")
        assert not urls, urls
        set_hidden(page, False)
        expect_past_loaded(page)
        expect_revision(page, 1, 2)


def a_cut_within_a_message_counts_no_point_twice(page, programs, pictures):
    """The stream is made up: it ends after some mutations, and before it tells the revision that they reach."""
    def revision(number):
        return {"uid": "u", "number": number}

    def stored(id, number):
        return frame({"kind": "points", "row_count": 1}, struct.pack("<3Q2f", id, number, 0, id, number))

    def reached(number):
        return frame({"kind": "at", "revision": revision(number)})

    begin = {"kind": "begin", "revision": revision(0), "oldest_revision": revision(0), "coordinate_count": 2,
             "point_count": 0, "share": 1}
    # The point 7 is replaced by the second one.
    mutations = [stored(7, 1), stored(7, 2), stored(8, 3), stored(9, 4)]

    def answer(route):
        after = re.search(r"after=u:(\d+)", route.request.url)
        body = [*mutations[int(after[1]):], reached(4)] if after else [frame(begin), reached(0), *mutations[:3]]
        route.fulfill(body=b"".join(body), content_type="application/octet-stream")

    with running(programs) as server:
        server.command("create", "arm", "--space", "R2")
        page.route(re.compile(r"/arm/points\?"), answer)
        open_index(page, server, "arm")
        wait_for_count(page, 3)
        expect_revision(page, 1, 1)
