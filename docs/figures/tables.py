"""The tables of the pages, by the names of their marks. Each is a function of the saved figures in this directory."""

from statistics import median

from clients import CLIENTS
from cpp import CPP
from overload import OVERLOAD
from paper import PAPER
from saved import FIGURES, Missing, digits, of, ratio, read, table
from server import SERVER

METRICS = {
    "SE3": "SE3, `R3*SO3:0.15`", "SE3-SUM": "SE3-SUM, `sum(R3, SO3)`", "SE2": "SE2, `R2*SO2`", "SO3": "`SO3`", "R3": "`R3`",
    "R6": "`R6`", "R12": "`R12`", "R30": "`R30`", "SO2^3": "`SO2^3`", "SO2^6": "`SO2^6`", "SE3^2": "SE3^2, `(R3*SO3:0.15)^2`",
    "SE3^4": "SE3^4, `(R3*SO3:0.15)^4`", "SE3^8": "SE3^8, `(R3*SO3:0.15)^8`",
}
GNAT, SCAN, STATIC = "OMPL's GNAT", "a SIMD scan of all points", "kiddo or nanoflann, static"
KIDDO, GROWING, NIGH = "kiddo, static", "kiddo, growing", "nigh"
PEERS = {
    GNAT: ["ompl-gnat"], SCAN: ["simd-scan"], STATIC: ["kiddo", "nanoflann"], KIDDO: ["kiddo"], GROWING: ["kiddo-mutable"],
    NIGH: ["nigh"],
}
SEARCHES = ["knn1", "knn10", "radius"]


def against(data, case, op, ours, peers):
    """The time of the best of these peers divided by ours."""
    space, n = case
    values = data.get(space, {}).get(n, {}).get("uniform", {}).get(op, {})
    theirs = [values[peer] for peer in PEERS[peers] if peer in values]
    return min(theirs) / values[ours] if theirs and ours in values else None


def index(n):
    pairs = [("SE3", [GNAT, SCAN]), ("SE3-SUM", [GNAT, SCAN]), ("SE2", [STATIC]), ("SO3", [KIDDO, GROWING])]
    pairs += [("R6", [KIDDO, GROWING]), ("SO2^3", [KIDDO, GROWING]), ("R12", [STATIC]), ("SO2^6", [STATIC]), ("SE3^2", [SCAN])]
    pairs += [("SE3^4", [SCAN, GNAT]), ("SE3^8", [SCAN, GNAT]), ("R30", [SCAN, GNAT]), ("R3", [KIDDO, GROWING])]
    rows = []
    for space, peers in ((space, one) for space, all_peers in pairs for one in all_peers):
        cells = [[against(of("index"), (space, n), op, ours, peers) for op in SEARCHES] for ours in ("wayfold", "wayfold-rest")]
        if cells[0][0] is not None:
            rows.append([METRICS[space], peers, *(" / ".join(map(ratio, cell)) for cell in cells)])
    return table(["index"], ["space and metric", "against", "growing", "at rest"], rows)


def building():
    what = {"rrt": "a random tree (ask for the nearest, insert)", "insert": "one insert after the other, merges included"}
    what |= {"build": "building at once", "memory": "memory, states included"}
    units = {"rrt": "ms", "insert": "ns a point", "build": "ns a point", "memory": "bytes a point"}
    wanted = [("rrt", space, GNAT) for space in ("SE3", "SE3-SUM")]
    wanted += [("rrt", space, GROWING) for space in ("SE2", "SO3", "R3", "R6", "SO2^6")]
    wanted += [("rrt", space, SCAN) for space in ("SE3^2", "SE3^4")]
    wanted += [("insert", space, GNAT) for space in ("SE3", "SE3-SUM")]
    wanted += [("insert", space, GROWING) for space in ("SE2", "SO3", "R6", "R3")] + [("memory", "R3", GROWING)]
    wanted += [(op, space, peer) for op in ("build", "memory") for space, peer in (("SE3", GNAT), ("R6", KIDDO), ("R3", KIDDO))]
    rows = []
    for op, space, peer in wanted:
        ours = "wayfold" if peer == GROWING or op in ("rrt", "insert") else "wayfold-rest"
        value = of("index").get(space, {}).get("50000", {}).get("uniform", {}).get(op, {}).get(ours)
        faster = against(of("index"), (space, "50000"), op, ours, peer)
        if value is not None and faster is not None:
            state = "growing" if ours == "wayfold" else "at rest"
            rows.append([what[op], state, METRICS[space], peer, f"{digits(value)} {units[op]}", ratio(faster)])
    return table(["index"], ["what, 50,000 points", "ours", "space and metric", "against", "ours takes", "ratio"], rows)


def uneven():
    """Our times with data that is not uniform, as multiples of those with uniform data: the least and the most."""
    rows = []
    for data, what in (("sorted", "sorted by the first coordinate"), ("clusters", "fifty narrow clusters"),
                       ("rrt-trees", "along random trees"), ("manifold", "a thin surface")):
        cells = []
        for ops, ours in ((SEARCHES, "wayfold"), (SEARCHES, "wayfold-rest"), (["insert"], "wayfold"), (["build"], "wayfold-rest")):
            cases = [case for sizes in of("index").values() for case in sizes.values() if data in case]
            found = [case[data][op][ours] / case["uniform"][op][ours] for case in cases for op in ops if ours in case[data].get(op, {})]
            cells.append(f"{min(found):.2f} to {max(found):.2f}" if found else "–")
        if cells[0] != "–":
            rows.append([what, *cells])
    return table(["index"], ["data", "a search, growing", "a search, at rest", "an insert", "building at once"], rows)


def processor_names():
    """The saved files of the index, the first processor's first."""
    return ["index", *sorted(path.stem for path in FIGURES.glob("index-*.json"))]


def processors():
    """The ratios on each processor: those of each saved file of the index, side by side."""
    names = processor_names()
    cases = [("SE3", GNAT), ("SE3-SUM", GNAT), ("SE2", STATIC), ("SO3", KIDDO), ("R3", KIDDO), ("R6", KIDDO), ("R12", STATIC)]
    cases += [("SE3^2", SCAN), ("SE3^4", SCAN), ("SE3^8", SCAN), ("R30", SCAN)]
    growing = {STATIC: GROWING, KIDDO: GROWING}
    ops = [("knn1", {}), ("knn10", {}), ("rrt", growing), ("insert", growing)]
    cell = lambda *case: " / ".join(ratio(against(of(case[0]), (case[1], "50000"), op, "wayfold", to.get(case[2], case[2]))) for op, to in ops)
    rows = [[METRICS[space], peers, *(cell(name, space, peers) for name in names)] for space, peers in cases]
    head = ["growing: one / ten neighbours / random tree / one insert", "against"]
    return table(names, head + [read(name)["processor"] for name in names], rows)


def readme_speed():
    """The worst ratio of all processors."""
    names = processor_names()
    wanted = [("SE(3), `R3*SO3:0.15`", "SE3", GNAT, GNAT), ("SE(3), `sum(R3, SO3)`", "SE3-SUM", GNAT, GNAT)]
    wanted += [("SE(2), `R2*SO2`", "SE2", STATIC, GROWING)]
    wanted += [(f"`{space}`", space, KIDDO, GROWING) for space in ("SO3", "R6", "R3")]
    wanted += [("SE(3)², `(R3*SO3:0.15)^2`", "SE3^2", SCAN, SCAN), ("SE(3)⁴, `(R3*SO3:0.15)^4`", "SE3^4", SCAN, SCAN)]
    short = {GNAT: "OMPL's GNAT", STATIC: "kiddo or nanoflann, the faster", KIDDO: "kiddo", SCAN: "SIMD scan"}
    rows = []
    for shown, space, still, growing in wanted:
        cells = []
        for op, peer in (("knn1", still), ("knn10", still), ("rrt", growing), ("insert", growing)):
            found = [against(of(name), (space, "50000"), op, "wayfold", peer) for name in names]
            cells.append(ratio(min((one for one in found if one is not None), default=None)))
        rows.append([shown, short[still], *cells])
    return table(names, ["space", "peer", "one neighbour", "ten neighbours", "random tree", "one insert"], rows)


def nigh():
    spaces = of("nigh")
    what = {"knn1": "one neighbour", "knn10": "ten neighbours", "radius": "all within a radius", "rrt": "a random tree", "insert": "one insert"}
    rows = [[shown, *(ratio(against(spaces, (space, "50000"), op, "wayfold", NIGH)) for space in spaces)] for op, shown in what.items()]
    return table(["nigh"], ["against nigh, both growing", *(METRICS[space] for space in spaces)], rows)


def threads():
    got = of("threads")
    rows = [["two readers of one snapshot, against two processes", ratio(got["read"]["ratio"])]]
    rows += [["two bulk inserts, against two processes", ratio(got["bulk"]["ratio"])]]
    writer = "a reader's rate while a writer inserts and merges as fast as it can, against its rate while the writer rests"
    rows += [[writer, ratio(got["beside_a_writer"]["ratio"])]]
    rows += [["the writer's rate meanwhile, points a second", digits(got["beside_a_writer"]["inserts_per_second"])]]
    return table(["threads"], ["what", "figure"], rows)


def slowest():
    got = of("threads")["slowest"]
    shown = lambda us: f"{digits(us)} µs" if us < 1000 else f"{digits(us / 1000)} ms"
    rows = [[what, *(shown(got[what][at]) for at in ("p50_us", "p999_us", "max_us")), f"{got[what]['over_1_ms']:,}"]
            for what in ("inserts", "queries")]
    return table(["threads"], [f"{got['points']:,} points", "median", "99.9 % within", "slowest", "over 1 ms"], rows)


def over_forest():
    works = {"nearest": "the nearest of 50,000 points", "mix": "a random tree: ask for the nearest, insert"}
    rows = []
    for row in of("over-forest"):
        aim = 0.9 if row["space"] == "R3" else 0.97
        speed = f"{row['ratio']:.2f}"
        times = (f"{row[key] / 1000:.2f} µs" for key in ("bare_ns", "index_ns"))
        rows.append([METRICS[row["space"]], works[row["work"]], *times, f"≥ {aim}", speed if row["ratio"] >= aim else f"**{speed}**"])
    return table(["over-forest"], ["space", "work", "the bare forest", "`Index`", "aim", "speed over the bare forest"], rows)


def middle(rows, of_row):
    return median(map(of_row, rows))


SOURCES = {
    "memory": "an index in memory", "shared": "a shared index", "remote": "a remote index", "scan": "a SIMD scan",
    "brute": "brute force",
}
PLANNERS = ["maze", "bodies", "rigid"]


def sources():
    rows = {source: [shown] for source, shown in SOURCES.items()}
    for planner in PLANNERS:
        runs = {source: [row for row in of(planner) if row["source"] == source] for source in SOURCES}
        runs = {source: own for source, own in runs.items() if own}
        near = {source: middle(own, lambda row: row["search_s"] + row["insert_s"]) for source, own in runs.items()}
        total = {source: middle(own, lambda row: row["total_s"]) for source, own in runs.items()}
        for source, own in runs.items():
            share = f"{100 * middle(own, lambda row: row['check_s']) / total[source]:.0f} %"
            faster = " / ".join(ratio(of_all["brute"] / of_all[source]) for of_all in (near, total))
            rows[source] += [f"1 ({digits(total[source])} s)" if source == "brute" else faster, share]
    header = ["source", *(cell for planner in PLANNERS for cell in (f"`{planner}`", "checks"))]
    return table(PLANNERS, header, [row for row in rows.values() if len(row) == len(header)])


def nodes(planner):
    return f"{middle(of(planner), lambda row: row['nodes']):,.0f}"


def runs_of(name, source, count):
    """The runs with this number of workers, in the order of their seeds."""
    runs = [row for row in of(name) if (row["source"], row["workers"]) == (source, count)]
    if not runs:
        raise Missing(name)
    return sorted(runs, key=lambda row: row["seed"])


def workers(name, cell):
    rows = []
    for count in sorted({row["workers"] for row in of(name)}):
        cells = (cell(runs_of(name, source, count), runs_of(name, source, 1)) for source in ("shared", "remote"))
        rows.append([str(count), *cells])
    return table([name], ["workers", "shared", "remote"], rows)


def rate(row):
    return row["nodes"] / row["total_s"]


def roadmap_cell(runs, alone):
    faster = median(rate(one) / rate(other) for one, other in zip(runs, alone))
    return f"{digits(middle(runs, rate))} a second, {ratio(faster)}×"


def roadmap_two():
    return digits(median(over_one("rigid-workers", "shared", 2)))


def roadmap_wait():
    runs = runs_of("rigid-workers", "shared", 2)
    return digits(100 * middle(runs, lambda row: row["insert_s"] / row["total_s"] / row["workers"])) + " %"


def trees_cell(runs, alone):
    times = [row["total_s"] for row in runs]
    faster = median(other["total_s"] / one["total_s"] for one, other in zip(runs, alone))
    shown = f"{digits(median(times))} s ({digits(min(times))} to {digits(max(times))})"
    return f"{shown}, {digits(middle(runs, rate))} a second, {ratio(faster)}×"


def span(values):
    """The least and the greatest percentage."""
    low, high = (f"{100 * value:.0f}" for value in (min(values), max(values)))
    return f"{low} %" if low == high else f"{low} to {high} %"


def tree_checks():
    return span([row["check_s"] / row["total_s"] / row["workers"] for row in of("maze-workers") if row["source"] != "memory"])


def python_share():
    """The share of calls of Python in the time of each of OMPL's planners, by medians."""
    planners = (runs for planner, runs in of("ompl").items() if planner.startswith("OMPL"))
    return span([middle(runs, lambda run: run["python"]) for runs in planners])


def ompl():
    rows, fastest = [], min(middle(runs, lambda run: run["seconds"]) for runs in of("ompl").values())
    for planner, runs in of("ompl").items():
        ms = [1e3 * run["seconds"] for run in runs]
        shown = f"**{digits(median(ms))}**" if median(ms) == 1e3 * fastest else digits(median(ms))
        cells = [f"{shown} ({digits(min(ms))} to {digits(max(ms))})", digits(middle(runs, lambda run: run["checks"]))]
        rows.append([planner.replace("*", "\\*"), *cells])
    return table(["ompl"], ["until all three questions are answered", "time, ms (least to most)", "collision checks"], rows)


def over_memory(planner, flushed=False):
    """The speed of a planner with a shared index over that with one in memory, seed by seed."""
    total = lambda row: row["total_s"] + (row["flush_s"] if flushed else 0)
    pairs = zip(runs_of(planner, "memory", 1), runs_of(planner, "shared", 1))
    return sorted(total(memory) / total(shared) for memory, shared in pairs)


def over_one(planner, source, count):
    """The rate of workers that share an index over that of one, seed by seed."""
    pairs = zip(runs_of(planner, source, 1), runs_of(planner, "shared", count))
    return sorted(rate(many) / rate(one) for one, many in pairs)


def spread(ratios):
    return f"{median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})"


def sharing():
    rows = []

    def add(what, aim, figure, is_met):
        rows.append([what, aim, figure if is_met else f"**{figure}**"])

    for planner, least in (("maze", 0.8), ("bodies", 0.85), ("rigid", 0.95)):
        ratios = over_memory(planner)
        add(f"`{planner}`, speed over an index in memory", f"≥ {least}", spread(ratios), median(ratios) >= least)
    add("`maze`, the same until all writes are durable", "–", spread(over_memory("maze", flushed=True)), True)
    for count, least in ((2, 0.9), (4, 0.75), (8, 0.55)):
        ratios = over_one("maze-workers", "memory", count)
        what = f"`maze`, vertices a second of {count} workers over one with an index in memory"
        add(what, f"≥ {least}", spread(ratios), median(ratios) >= least)
        # Only Linux tells it.
        busy = sorted(row["busy_share"] or 0 for row in runs_of("maze-workers", "shared", count))
        shown = spread(busy) if busy[0] else "not measured"
        add("the same runs: the part of the machine's processor time that was spent", "≥ 0.85", shown, not busy[0] or median(busy) >= 0.85)
    ratios = over_one("rigid-workers", "shared", 2)
    add("`rigid`, milestones a second of two workers over one", "≥ 1.75", spread(ratios), median(ratios) >= 1.75)
    got = of("shared")
    for title, short in (("insert, R3", "R3"), ("insert, R3*SO3:0.15", "SE3")):
        call, due = got[title]["insert, the call alone"], got[title]["insert, from the time it was due"]
        idle = got[title]["nothing, from the time it was due"]
        add(f"an insert at 50,000 a second, {short}: p50", "≤ 3 µs", f"{digits(due['p50_us'])} µs", due["p50_us"] <= 3)
        shown = f"{digits(due['p99_us'])} µs; the call alone {digits(call['p99_us'])} µs"
        add(f"the same, p99 from the time it was due", "≤ 50 µs", shown, due["p99_us"] <= 50)
        add("the same, p99.9; that of a thread that inserts nothing", "–",
            f"{digits(due['p99.9_us'] / 1e3)} ms; {digits(idle['p99.9_us'] / 1e3)} ms", True)
    for count, word in ((1, "one writer"), (4, "four writers")):
        one = got[f"visible, R3*SO3:0.15, writers: {count}"]
        seen, sync = (one[what]["p99_us"] / 1e3 for what in ("until the copy of another process has it", "append of 4 KiB and fdatasync"))
        add(f"until another process finds a point, 50,000 a second by {word}, p99", f"≤ {sync + 5:.1f} ms", f"{digits(seen)} ms", seen <= sync + 5)
    for title, short in (("insert, R3", "R3"), ("insert, R3*SO3:0.15", "SE3")):
        cost = got[title]["the server's processor time an insert"]["figure"]
        add(f"the server's processor time an insert, {short}, only the writer's copy follows", "–", f"{digits(cost)} µs", True)
    one = got["visible, R3*SO3:0.15, writers: 1"]["the server's processor time an insert"]["figure"]
    add("the same, SE3, one other process follows too", "≤ 6 µs", f"{digits(one)} µs", one <= 6)
    costs = {row["subscribers"]: row["us_an_insert"] for row in of("subscribers")["rows"]}
    at_rate, further = f"{of('subscribers')['rate']:,} inserts a second", (costs[8] - costs[1]) / 7
    add(f"the same, one other process follows, {at_rate}", "≤ 6 µs", f"{digits(costs[1])} µs", costs[1] <= 6)
    add(f"the same for a further subscriber: each of seven, {at_rate}", "≤ 1.5 µs", f"{digits(further)} µs", further <= 1.5)
    return table([*PLANNERS, "maze-workers", "rigid-workers", "shared", "subscribers"], ["what", "aim", "measured"], rows)


def seconds(source):
    return lambda: digits(middle(runs_of("maze", source, 1), lambda row: row["total_s"])) + " s"


TABLES = {
    "index-50000": lambda: index("50000"), "index-million": lambda: index("1000000"), "index-building": building,
    "index-uneven": uneven, "index-processors": processors, "threads": threads, "slowest": slowest,
    "sources": sources, "roadmap-workers": lambda: workers("rigid-workers", roadmap_cell),
    "sharing": sharing, "over-forest": over_forest,
    "alone": lambda: digits(middle(runs_of("maze-workers", "memory", 1), lambda row: row["total_s"])) + " s", "tree-workers": lambda: workers("maze-workers", trees_cell), "ompl": ompl, "speed": readme_speed,
    "maze-memory": seconds("memory"), "maze-shared": seconds("shared"), "maze-remote": seconds("remote"),
    "maze-brute": seconds("brute"), "index-nigh": nigh,
    "maze-nodes": lambda: nodes("maze"), "bodies-nodes": lambda: nodes("bodies"), "rigid-nodes": lambda: nodes("rigid"),
    "tree-checks": tree_checks, "ompl-python": python_share,
    "memory": lambda: digits(of("index")["SE3"]["50000"]["uniform"]["memory"]["wayfold-rest"]) + " bytes",
    "roadmap-two": roadmap_two, "roadmap-wait": roadmap_wait,
    **CLIENTS, **CPP, **OVERLOAD, **PAPER, **SERVER,
}
