"""The page's own store of points and edges, against a model. See `model.js`."""

import pathlib

from support import running

MODEL = (pathlib.Path(__file__).parent / "model.js").read_text()


def histories_are_those_of_a_model(page, programs, pictures):
    """With the page's own limits, and with limits so low that it forgets and compacts all the time."""
    lower = {"cloud.js": ("MAX_DEAD = 1_000_000", "MAX_DEAD = 20"), "edges.js": ("MIN_GONE = 4096", "MIN_GONE = 8")}

    def lowered(route):
        answer = route.fetch()
        usual, low = lower[route.request.url.rsplit("/", 1)[1]]
        assert usual in answer.text()
        route.fulfill(response=answer, body=answer.text().replace(usual, low))

    with running(programs) as server:
        for limits in ("usual", "low"):
            if limits == "low":
                for name in lower:
                    page.route(f"**/{name}", lowered)
            page.goto("about:blank")
            page.goto(server.page)
            for seed in (1, 2, 3):
                compared = page.evaluate(MODEL, {"seed": seed, "rounds": 40})
                assert compared > 2000, compared
