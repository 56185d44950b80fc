"""The tables of the Python package and of the page."""

from saved import digits, of, table, tenths


def python():
    rows = []
    for row in of("python")["rows"]:
        space = row["space"] if row["space"].startswith("R") and "*" not in row["space"] else f"`{row['space']}`"
        peer = ["–", "–"]
        if "scipy_over_ours" in row:
            peer = [f"{digits(row['scipy_over_ours'])} × ours", f"{digits(row['scipy_one_us'])} µs"]
        ours = (f"{digits(row[key])} µs" for key in ("one_us", "above_rust_us"))
        rows.append([space, str(row["k"]), f"{row['over_rust']:.2f}", *ours, *peer])
    header = ["space", "k", "10,000 states in a call, over Rust", "one state in a call", "of it, above Rust"]
    return table(["python"], [*header, "scipy, 10,000 states", "scipy, one state"], rows)


def pictures():
    rows = []
    for points, got in of("page").items():
        if points.isdigit():
            times = (f"{tenths(got[key] / 1e3)} s" for key in ("first_picture_ms", "all_points_ms"))
            turning = f"{got['pictures_per_s']:.0f}, of {round(got['points_a_picture'], -3):,} points each"
            rows.append([f"{int(points):,}", *times, turning])
    return table(["page"], ["points", "first picture", "all points", "pictures a second while it turns"], rows)


def open_page():
    shown = {"page": "a page is open on the index", "reader": "a program reads the page's stream", "alone": "no page is open"}
    rows = []
    for name, what in shown.items():
        got = of("page")["server"][name]
        rows.append([what, f"{got['processor_s']:.2f} s", f"{digits(got['p50_ms'])} ms", f"{tenths(got['p99_ms'])} ms"])
    header = ["2,000 calls a second for five seconds, while", "the server's processor time", "a call, p50", "p99"]
    return table(["page"], header, rows)


CLIENTS = {"python": python, "page-pictures": pictures, "page-open": open_page}
