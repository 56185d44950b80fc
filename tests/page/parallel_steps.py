"""Parallel coordinates, against the command line."""

import random
import re

from playwright.sync_api import expect

from support import looks, open_index, probe, running, set_slider, wait_for_count


def joints(count, axes=7):
    """Postures along some movements, so that the lines have a form."""
    draw = random.Random(7)
    ends = [[draw.uniform(-2.6, 2.6) for _ in range(axes)] for _ in range(5)]
    for _ in range(count):
        along, [a, b] = draw.random(), draw.sample(ends[:3] if draw.random() < 0.8 else ends, 2)
        yield [round(x + along * (y - x) + draw.gauss(0, 0.12), 6) for x, y in zip(a, b)]


def joints_are_lines(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "joints", "--space", "moveit-joints-7")
        states = list(joints(3000))
        server.insert("joints", states)
        open_index(page, server, "joints")
        wait_for_count(page, 3000)
        # Joints are shown so at first, with an axis for each.
        expect(page.locator("#axes-preset")).to_have_value("parallel")
        expect(page.locator("#axes .name")).to_have_count(7)
        expect(page.locator("#sampled")).to_have_text("")
        # A click on a line probes a point that is stored.
        box = page.locator("#picture").bounding_box()
        page.locator("#picture").click(position={"x": box["width"] / 2, "y": box["height"] / 2})
        nearest = page.locator("#neighbors tr").first
        expect(nearest).to_have_attribute("data-distance", re.compile(r"^0(\.0)?$"))
        stored = server.json("get", "joints", nearest.get_attribute("data-id"))
        typed = [float(it) for it in page.input_value("#probe-state").split(",")]
        assert typed == stored["state"], (typed, stored)
        # The probe and its neighbours are lines above the others, as many as the command line tells.
        state = ",".join(map(str, states[5]))
        shown = probe(page, state, 8)
        answer = server.json("knn", "joints", "--state", state, "-k", "8")
        assert shown == list(zip(map(str, answer["ids"]), answer["distances"]))
        expect(page.locator("#marks polyline.link:not(.own)")).to_have_count(8)
        expect(page.locator("#marks polyline.own")).to_have_count(1)
        page.locator("#neighbors tr").nth(3).hover()
        expect(page.locator("#marks polyline.strong")).to_have_count(1)
        page.select_option("#color-by", "distance")
        looks(page, pictures, "parallel")


def lines_are_sampled_and_follow_the_slider(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "joints", "--space", "SO2^6")
        states = [[(number * step) % 628 / 100 for step in (1, 3, 7, 11, 13, 17)] for number in range(45_000)]
        for at in range(0, len(states), 15_000):
            server.insert("joints", states[at:at + 15_000])
        open_index(page, server, "joints")
        wait_for_count(page, 45_000)
        page.select_option("#axes-preset", "parallel")
        drawn = re.compile(r"^draws ([\d,]+) of 45,000 points, sampled evenly$")
        expect(page.locator("#sampled")).to_have_text(drawn)
        lines = int(drawn.match(page.locator("#sampled").inner_text())[1].replace(",", ""))
        assert 8_000 < lines <= 20_000, lines
        # An angle has the range of its canonical form.
        assert {"-2", "0", "2"} <= set(page.locator("#axes .number").all_text_contents())
        expect(page.locator("#axes .name").first).to_have_text("theta0 (rad)")
        set_slider(page, 1)
        first = int(server.command("scan", "joints", "--since", "1", "--output", "json").count("\n"))
        points = 45_000 - first
        expect(page.locator("#sampled")).to_have_text(re.compile(f" of {points:,} points"))
        part = int(re.search(r"draws ([\d,]+)", page.locator("#sampled").inner_text())[1].replace(",", ""))
        assert abs(part / lines - points / 45_000) < 0.05, (part, lines)
        page.click("#live")
        page.select_option("#color-by", "age")
        looks(page, pictures, "parallel-sample")
