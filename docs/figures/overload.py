"""The tables of a server under more load than it can bear."""

from saved import FIGURES, of, read, table, tenths

RATES = ["2x", "4x"]
UNREAD = {"16 StreamKnn of 128": "16 unread `StreamKnn` of 128 answers", "250 Knn": "250 unread `Knn`",
          "250 Knn on each of 10 connections": "as many on each of 10 connections"}


def compact(raw):
    """The figures of the table, of those that the program wrote."""
    mib = lambda scenario, when: raw[scenario][when]["resident memory, MiB"]
    after = lambda scenario: mib(scenario, "10 s after") / mib(scenario, "before")
    goodput = {rows: raw[f"goodput, Knn of {rows} rows"] for rows in (200, 1)}
    phases = [f"{rate} {callers}" for rate in RATES for callers in ("patient", "500 ms")]
    health = lambda rows: [goodput[rows][phase]["health p99, ms"] for phase in phases]
    peak = {f"{callers}, {rows} rows": [goodput[rows][f"{rate} {callers}"]["of the peak"] for rate in RATES]
            for rows in goodput for callers in ("patient", "500 ms")}
    heavy = raw["heavy, others"]
    healths = [part["health p99, ms"] for table in raw.values() if isinstance(table, dict)
               for part in table.values() if "health p99, ms" in part]
    memories = [name for name in raw if name.endswith("memory")]
    refused = raw["silent, 17 connections with 256 headers each: others"]["during"]
    patient = [f"{rate} patient" for rate in RATES]
    return {
        "of_the_peak": peak,
        "later_p99_ms": [goodput[200][phase]["accepted p99 after 2 s, ms"] for phase in patient],
        "one_row_p99_ms": [goodput[1][phase]["accepted p99, ms"] for phase in patient],
        "most_health_p99_ms": max(healths),
        "memory_after": {name: after(name) for name in memories},
        "accepted_p99_ms": [goodput[200][phase]["accepted p99, ms"] for phase in ("one at a time", *patient)],
        "health_p99_ms": {f"{rows} rows": [min(health(rows)), max(health(rows))] for rows in goodput},
        "beside_p99_ms": [heavy[part]["bystander p99, ms"] for part in ("during", "before")],
        "burst_refused": raw["burst, 64 workers once a second"]["burst"]["refused"],
        "half_sent_mib": [mib("half-sent, memory", when) for when in ("before", "peak", "10 s after")],
        "unread_mib": [mib(f"unread, {name}: memory", "peak") for name in UNREAD],
        "silent_ms": raw["silent, 1,150 connections"]["a new client"]["Knn after, ms"],
        "headers_refused": [refused["bystander refused or lost"], refused["bystander calls"]],
        "left": {"processor_s": raw["left, 600 queries of 5,000 rows over Zenoh"]["left"]["processor time after the client left, s"],
                 "mib": mib("left, memory", "peak")},
    }


def compact_soak(raw):
    quarterly, got = raw["soak, by quarter"], raw["soak, load and index"]["soak"]
    quarters = ("first quarter", "second quarter", "third quarter", "last quarter")
    return {
        "of_the_peak": [quarterly[quarter]["answered in time, of the peak"] for quarter in quarters], "health_p99_ms": got["health p99, ms"],
        "mib": [quarterly[quarter]["resident memory, median, MiB"] for quarter in quarters],
        "wrong_points": got["points too few or too many"] + got["points lost or changed"],
        "wrong_searches": got["searches unlike brute force"],
    }


def numbers(values):
    return ", ".join(map(tenths, values))


def ms(values, between=", "):
    """The different times, in the unit of the greatest."""
    unit, scale = (" s", 1e3) if max(values) >= 1e3 else (" ms", 1)
    return between.join(dict.fromkeys(tenths(value / scale) for value in values)) + unit


def column(got):
    parts = lambda *names: "; ".join(", ".join(f"{value:.2f}" for value in got["of_the_peak"][name]) for name in names)
    unread = [*map(tenths, got["unread_mib"]), *["–"] * len(UNREAD)][:len(UNREAD)]
    accepted, (refused, calls) = got["accepted_p99_ms"], got["headers_refused"]
    alone = [f"{tenths(accepted[0])} ms"] if len(accepted) > len(RATES) else ["–"]
    accepted = [f"{numbers(accepted[-len(RATES):])} ms"] if accepted else []
    later = [f"{numbers(got['later_p99_ms'])} ms"] if "later_p99_ms" in got else ["–"]
    return {
        "answered in time over the peak, 200 rows: twice, four times the peak by patient callers": parts("patient, 200 rows"),
        "the same with deadlines of 500 ms": parts("500 ms, 200 rows"),
        "the same for one row, patient; with deadlines": parts("patient, 1 rows", "500 ms, 1 rows"),
        "p99 of accepted calls, 200 rows, patient: one at a time; twice, four times the peak; without the first two seconds":
            "; ".join([*alone, *accepted, *later]),
        "the same, one row: twice, four times the peak": ms(got["one_row_p99_ms"]) if "one_row_p99_ms" in got else "–",
        "p99 of health, 200 rows; one row; the most of all scenarios": "; ".join(
            [*(ms(got["health_p99_ms"][rows], " to ") for rows in ("200 rows", "1 rows")),
             ms([got["most_health_p99_ms"]]) if "most_health_p99_ms" in got else "–"]),
        "one caller's p99 beside 250 `Knn` of 10,000 neighbours × 4 on another connection; alone":
            "; ".join(ms([one]) for one in got["beside_p99_ms"]),
        "64 workers at once every second, 60 % of the capacity: refused": f"{got['burst_refused']:,.0f}",
        "unfinished inserts: memory before, at most, 10 s after, MiB": numbers(got["half_sent_mib"]),
        f"{'; '.join(UNREAD.values())}, at most, MiB": "; ".join(unread),
        "1,150 silent connections: a new client's first answer": ms([got["silent_ms"]]) if "silent_ms" in got else "–",
        "17 connections with 256 headers each: a caller is refused": f"{refused:,.0f}" + (f" of {calls:,.0f}" if calls else ""),
        "600 queries over Zenoh of a caller that left: processor time; memory at most, MiB":
            f"{got['left']['processor_s']:.1f} s; {tenths(got['left']['mib'])}",
        "memory 10 s after each of these loads, over that before, at most":
            f"{max(got['memory_after'].values()):.2f}" if "memory_after" in got else "–",
    }


def overload():
    """A column for each saved run, the newest last."""
    names = [*sorted(path.stem for path in FIGURES.glob("overload-*.json")), "overload"]
    columns = [column(of(name)) for name in names]
    header = ["what", *("{processor}, at {commit}".format(**read(name)) for name in names)]
    return table(names, header, [[what, *(one[what] for one in columns)] for what in columns[0]])


def soak():
    got = of("soak")
    shares = ", ".join(f"{share:.2f}" for share in got["of_the_peak"])
    rows = [["answered in time over the peak, in each quarter", shares], ["p99 of health", ms([got["health_p99_ms"]])]]
    rows += [["the median of the memory in each quarter, MiB", numbers(got["mib"])]]
    rows += [["points lost or changed; searches unlike brute force", f"{got['wrong_points']:.0f}; {got['wrong_searches']:.0f}"]]
    return table(["soak"], ["a soak of ten minutes", "figure"], rows)


OVERLOAD = {"overload": overload, "soak": soak}
