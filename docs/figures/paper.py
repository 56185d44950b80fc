"""The table of the paper's tree: ratios to scalar brute force, and the paper's own beside them."""

from saved import FIGURES, of, table, tenths

STRUCTURES = ["mpnn", "wayfold-rest", "simd-scan"]
POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def compact(raw):
    """The ratios, of the times that the program wrote."""
    times = {}
    for row in raw:
        times.setdefault(row["space"], {})[row["structure"], row["op"]] = row["value"]
    spaces = {}
    for space, got in times.items():
        searches = {one: got["brute", "knn1"] / got[one, "knn1"] for one in STRUCTURES}
        spaces[space] = searches | {"rest/mpnn": got["mpnn", "knn1"] / got["wayfold-rest", "knn1"]}
    builds = [got["mpnn", "build"] / got["wayfold-rest", "build"] for got in times.values()]
    return {"spaces": spaces, "mpnn/rest, build": [min(builds), max(builds)]}


def shown(space):
    base, power = space.rsplit("^", 1)
    base = {"(S1)": "(S¹)", "(R3xRP3)": "(R³×RP³)"}.get(base, base)
    return base + ("" if power == "1" else power.translate(POWERS))


def paper_ratios():
    """How many times as fast as brute force the paper's tree was, in the paper."""
    lines = (FIGURES.parents[1] / "tests/peers/paper-tables.csv").read_text().splitlines()
    fields = (line.split(",") for line in lines if not line.startswith("#"))
    return {row[1]: float(row[5]) / float(row[4]) for row in fields if len(row) > 5}


def paper():
    theirs, rows = paper_ratios(), []
    for space, got in of("paper")["spaces"].items():
        mark = lambda one: f"**{tenths(got[one])}**" if got[one] < theirs[space] else tenths(got[one])
        cells = [tenths(theirs[space]), mark("mpnn"), mark("wayfold-rest"), tenths(got["simd-scan"]), tenths(got["rest/mpnn"])]
        rows.append([shown(space), *cells])
    return table(["paper"], ["space", "paper: MPNN", *(f"`{one}`" for one in STRUCTURES), "rest/mpnn"], rows)


def builds():
    return " to ".join(map(tenths, of("paper")["mpnn/rest, build"]))


PAPER = {"paper": paper, "paper-builds": builds}
