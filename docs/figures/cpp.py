"""The tables of docs/cpp.md."""

from saved import FIGURES, of, read, table

# GNAT / Wayfold, by planner and space, and by k.
PLANNER_AIMS = {
    ("RRT", "se3"): 7, ("RRTConnect", "se3"): 7, ("PRM", "se3"): 2.7, ("PRM*", "se3"): 2.0, ("LazyRRT", "se3"): 13,
    ("RRT*", "se2"): 1.8, ("RRT*", "se3"): 1.2,
}
SEARCH_AIMS = {100: 8, 1_000: 5, 10_000: 3}


# The files of the same figures on other processors.
OTHERS = sorted(path.stem for path in FIGURES.glob("cpp-*.json"))
FILES = ["cpp", *OTHERS]
ON_OTHERS = ["GNAT / Wayfold, {processor}".format(**read(name)) for name in OTHERS]


def measured(value, is_met, shown=None):
    """Bold if it misses its aim."""
    shown = shown or f"{value:.2f}"
    return shown if is_met else f"**{shown}**"


def spread(got, aim):
    return f"{measured(got['ratio'], got['ratio'] >= aim)} ({got['least']:.2f} to {got['most']:.2f})"


def planners():
    rows = []
    for at, row in enumerate(of("cpp")["planners"]):
        shipped, bare = row["shipped"], row["bare"]
        aim = PLANNER_AIMS[row["planner"], row["space"]]
        name = row["planner"].replace("*", "\\*")
        times = (f"{shipped[structure]:.3f} s" for structure in ("gnat_s", "wayfold_s", "replay_s"))
        rows.append([f"{name}, {row['space'].upper()}, {row['vertices']:,}", *times, f"≥ {aim}", spread(shipped, aim),
                     f"{shipped['ceiling']:.1f}", spread(bare, aim), f"{bare['ceiling']:.1f}",
                     *(spread(of(name)["planners"][at]["shipped"], aim) for name in OTHERS)])
    header = ["planner, space, vertices", "GNAT", "Wayfold", "no search", "aim", "GNAT / Wayfold", "ceiling"]
    return table(FILES, [*header, "bare: GNAT / Wayfold", "ceiling", *ON_OTHERS], rows)


def searches():
    rows = []
    for at, row in enumerate(of("cpp")["neighbors"]):
        aim = SEARCH_AIMS[row["k"]]
        for variant in ("shipped", "bare"):
            times = (f"{1e6 * row[variant][structure]:,.0f} µs" for structure in ("gnat_s", "wayfold_s"))
            rows.append([f"k = {row['k']:,} of {row['points']:,}, {variant}", *times, f"≥ {aim}", spread(row[variant], aim),
                         *(spread(of(name)["neighbors"][at][variant], aim) for name in OTHERS)])
    return table(FILES, ["`nearestK` in SE3", "GNAT", "Wayfold", "aim", "GNAT / Wayfold", *ON_OTHERS], rows)


def microseconds(seconds):
    us = 1e6 * seconds
    return f"{us / 1e3:.1f} ms" if us >= 1e3 else f"{us:.0f} µs" if us >= 10 else f"{us:.1f} µs"


def calls():
    rows = []
    for row in of("cpp")["inserts"]:
        thread = "on a thread of their own" if row["merging"] == "background" else "in the insert"
        for clock, what in (("own", "processor time of its thread"), ("wall", "time by the clock")):
            got = row[clock]
            is_aim = row["merging"] == "background" and clock == "own"
            worst = measured(None, not is_aim or got["worst"] <= 1e-3, microseconds(got["worst"]))
            shown = f"{worst}; a run {microseconds(got['max'])}, 99.9 % within {microseconds(got['p99.9'])}"
            rows.append([f"slowest of {row['points']:,} inserts in SE3, merges {thread}: {what}", "≤ 1 ms" if is_aim else "–", shown])
    for row in of("cpp")["rust"]:
        shown = f"{measured(row['ratio'], row['ratio'] <= 1.05)} ({row['least']:.2f} to {row['most']:.2f})"
        what = f"a search of {row['points']:,} points in SE3, k = {row['k']}: C++ over Rust"
        rows.append([what, "≤ 1.05", f"{shown}; {1e6 * row['cpp_s']:.2f} µs / {1e6 * row['rust_s']:.2f} µs"])
    return table(["cpp"], ["what", "aim", "measured"], rows)


def shared():
    got = of("shared-prm")
    rates = (f"{got[name]:.0f} vertices a second" for name in ("one", "two"))
    row = [f"`SharedPRM`, SE3, {got['seconds']:.0f} s", *rates, "≥ 1.7", spread(got, 1.7)]
    return table(["shared-prm"], ["roadmap", "one process", "two processes", "aim", "two / one"], [row])


CPP = {"cpp-shared": shared, "cpp-planners": planners, "cpp-searches": searches, "cpp-calls": calls}
