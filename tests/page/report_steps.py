"""The report of a load run in a browser."""

import pathlib
import tempfile

from playwright.sync_api import expect

from support import SPACE, picture, running


def the_report_of_a_load_is_one_page(page, programs, pictures):
    """It draws its charts by itself, and loads nothing from elsewhere."""
    with running(programs) as server, tempfile.TemporaryDirectory() as directory:
        report = pathlib.Path(directory) / "load.html"
        server.command("create", "arm", "--space", SPACE)
        load = ["--workers", "2", "--mix", "insert=1,knn=3", "--duration", "2s", "--report", str(report)]
        figures = server.json("load", "arm", *load)
        requests = []
        page.on("request", lambda request: requests.append(request.url))
        page.goto(report.as_uri())
        assert requests == [report.as_uri()], requests
        for chart in page.locator("svg").all():
            box = chart.bounding_box()
            assert box["width"] > 300 and box["height"] > 80, box
            assert chart.locator("path, polyline").count() > 0
        assert page.locator("svg").count() >= 2
        calls = sum(phase["calls"] for phase in figures["phases"])
        expect(page.locator("body")).to_contain_text(f"{calls:,}")
        picture(page, pictures, "load-report")
