"""The tables of what a server costs: its calls, its writers, its disk and its cluster."""

from saved import digits, of, ratio, table


def columns():
    names = {"states": "`States` of SE(3)", "neighbors": "`Neighbors`, ten of each state"}
    rows = [[f"{names[row['message']]}, {row['rows']} states", f"{digits(row['doubles'])} µs", f"{digits(row['bytes'])} µs",
             digits(row["doubles"] / row["bytes"])] for row in of("columns")]
    return table(["columns"], ["encoded and decoded, from and to a column of doubles", "packed doubles", "`bytes`", "ratio"], rows)


def both(server, bare, unit=""):
    """A cell of the server's figure and of the bare protocol's, and their ratio."""
    return f"{digits(server)} / {digits(bare)}{unit}: {digits(server / bare)}"


def grpc():
    got, rows = of("network"), []
    for key, what in (("one", "one caller, one state a call"), ("many", "64 callers, one state a call"),
                      ("stream", "one caller, 10,000 states over one stream"), ("batches", "one caller, 1,000 states a call")):
        server, echo = got["searches"][key]["server"], got["searches"][key]["echo"]
        calls = [both(server[at] * 1e3, echo[at] * 1e3, " µs") if key != "stream" else "–" for at in ("p50_ms", "p99_ms")]
        rates = both(server["rows_per_s"], echo["rows_per_s"])
        rows.append([what, rates, *calls, both(server["processor_us"], echo["processor_us"], " µs")])
    header = [f"{got['points']:,} points, server / bare gRPC: ratio", "states a second", "a call, p50", "p99"]
    return table(["network"], [*header, "the server's processor time a state"], rows)


def loading():
    server, echo = (of("network")["growth"][name] for name in ("server", "echo"))
    rows = [["states inserted a second", both(server["insert"]["rows_per_s"], echo["insert"]["rows_per_s"])]]
    for what, key in (("an insert of 1,000 states", "insert"), ("a query of one state", "query")):
        for at, name in (("p50", "p50"), ("p99", "p99"), ("max", "slowest")):
            rows.append([f"{what}, {name}", both(server[key][f"{at}_ms"], echo[key][f"{at}_ms"], " ms")])
    return table(["network"], [f"while {of('network')['points']:,} points are loaded", "server / bare gRPC: ratio"], rows)


def cluster():
    cases, rows = of("cluster")["cases"], []
    shown = {
        "insert-1": "one client inserts", "insert-64": "64 clients insert into one index", "knn-8": "8 clients ask for ten neighbours",
    }
    places = {"owner": "at the owner", "other": "at another server", "spread": "at all three"}
    for case, what in shown.items():
        for place, at in places.items():
            if place in cases[case]:
                got = cases[case][place]
                others = [cases[case].get(name) for name in ("lone", "bare")]
                ratios = [ratio(got["rows_per_s"] / it["rows_per_s"]) if it else "" for it in others]
                shown_as = lambda it: f"{digits(it['rows_per_s'])}/s, {digits(it['p50_ms'])} / {digits(it['p99_ms'])} ms" if it else ""
                rows.append([f"{what}, {at}", *map(shown_as, (got, *others)), *ratios])
    header = ["calls; their rate, p50 / p99", "cluster", "lone server", "JetStream alone", "ratio to lone", "to JetStream"]
    return table(["cluster"], header, rows)


def cluster_time():
    got = of("cluster")["cases"]["insert-64"]
    columns = {"owner": "at the owner", "other": "at another server", "spread": "at all three", "lone": "lone server", "bare": "JetStream alone"}
    processes = {
        "clients": "the clients", "server": "the server", "owner": "the owner", "others": "the two other servers",
        "nats": "the three servers of NATS",
    }
    absent = {"lone": ("owner", "others", "nats"), "bare": ("owner", "others", "server")}
    times = {name: {key: got[name].get(f"{key}_us") for key in processes if key not in absent.get(name, ())} for name in columns}
    shown = lambda us: f"{digits(us)} µs" if us else ""
    rows = [[what, *(shown(times[name].get(key)) for name in columns)] for key, what in processes.items()]
    rows.append(["all", *(shown(sum(filter(None, times[name].values()))) for name in columns)])
    return table(["cluster"], ["processor time an insert, 64 clients", *columns.values()], rows)


def outages():
    cases = of("outages")["cases"]
    median = lambda case: cases[case]["median_s"]
    shown = lambda case: f"{digits(median(case))} s ({digits(cases[case]['least_s'])} to {digits(cases[case]['most_s'])})"
    within = lambda case, aim: shown(case) if median(case) <= aim else f"**{shown(case)}**"
    million = f"{of('outages')['points']:,} points"
    rows = [
        ["no insert is acknowledged after the owner was killed; a client at another server", within("owner", 4), "≤ 4 s"],
        ["no insert is acknowledged after the leader of the index's stream was killed; a client at the owner",
         within("leader", median("bare") + 1), f"≤ {digits(median('bare') + 1)} s: 1 s more than JetStream"],
        ["the same for JetStream alone", shown("bare"), ""],
        [f"a killed server of the cluster serves again, {million}",
         within("member", 2 * median("lone")), f"≤ {digits(2 * median('lone'))} s: twice a lone server"],
        [f"a killed lone server, {million}", shown("lone"), ""],
    ]
    return table(["outages"], ["how long", "median (least to most); **bold** misses its aim", "aim"], rows)


def writers():
    got = of("writers")["64 writers, an index in memory, k = 10"]
    rows = [[str(batch), digits(got[f"states, {batch} a call"]["figure"]), digits(got[f"processors busy, {batch} a call"]["figure"])]
            for batch in (1, 100)]
    header = ["64 writers in the process: states a call", "states a second", "processors busy"]
    return table(["writers"], header, rows)


def call_cost():
    what = {"admission": "admission, once more", "authentication": "an identity", "metrics": "metrics", "both": "an identity and metrics", "nothing": "nothing: two equal ones"}
    places = [("in_process", "the code of a call alone"), ("end_to_end", "a call over gRPC, at the server")]
    rows = []
    for place, shown in places:
        for key, got in of("call-cost")[place].items():
            low, high = got["quartiles_us"]
            added = f"{got['added_us']:.2f} µs ({low:.2f} to {high:.2f})"
            rows.append([shown, what[key], added, f"{digits(got['bare_us'])} µs"])
    return table(["call-cost"], ["processor time of", "added", "by the median of the differences (middle half)", "to"], rows)


def zenoh():
    rows = []
    for form, what in (("protobuf", "Protobuf"), ("json", "JSON")):
        got = of("robots")[form]
        keys = [("one in flight, p50", " µs"), ("one in flight, p99", " µs"), ("64 in flight, answers", ""), ("processor an answer", " µs")]
        rows.append([what, *(both(got[key]["figure"], got[key]["against"], unit) for key, unit in keys)])
    header = [f"{of('robots')['points']:,} points, server / bare Zenoh: ratio", "one query in flight, p50", "p99"]
    return table(["robots"], [*header, "64 in flight: answers a second", "processor time an answer"], rows)


def acknowledged():
    got = of("durable")["acknowledged durable inserts/s, 64 clients, one state each"]
    rows = []
    for with_k, neighbors in (("", "no neighbours"), (", k = 10", "the ten neighbours of each")):
        for key, what, bare in (
            ("service layer{}", "without the network", "bare fjall"),
            ("to bare fjall synced beside{}", "without the network", "bare fjall, synced beside its writers"),
            ("gRPC, 4 connections{}", "over gRPC, 4 connections", "bare fjall"),
            ("to a bare echo of the same messages, 4 connections{}", "over gRPC, 4 connections", "bare gRPC"),
        ):
            one = got[key.format(with_k)]
            rows.append([f"{what}, {neighbors}", digits(one["figure"]), bare, digits(one["against"]), digits(one["ratio"])])
    return table(["durable"], ["inserts a second", "server", "against", "its rate", "server / bare"], rows)


def durable(part):
    """The section of the durable figures whose title begins so."""
    return next(section for title, section in of("durable").items() if title.startswith(part))


def kept():
    latency, restart, disk, idle = map(durable, ("one client", "restart", "disk", "idle"))
    append = durable("the disk")["append of 4 KiB and fdatasync, median"]["figure"]
    rows = [["an append of 4 KiB with fdatasync, p50", "–", f"{digits(append)} ms"]]
    rows += [["an insert of one state, one in flight, p50", digits(latency["Insert"]["figure"]) + " ms",
             f"two appends with fdatasync and a bare call: {digits(latency['Insert']['against'])} ms"]]
    one = restart["from opening to ready"]
    rows += [["restart with a million points", f"{digits(one['figure'])} s", f"reading them and building: {digits(one['against'])} s"]]
    one = disk["the points alone, compacted"]
    rows += [["disk, a point, compacted", f"{digits(one['figure'])} bytes", f"its numbers: {digits(one['against'])} bytes"]]
    rows += [["disk, a point, as the server leaves it", f"{digits(disk['the whole directory as it was left']['figure'])} bytes", "–"]]
    for what, unit, scale in (("on disk", "KB", 1e3), ("resident after a start", "KB", 1e3), ("start until ready", "ms", 1)):
        each = max(idle[f"each of 1000: {what}"]["figure"], 0) / scale
        rows += [[f"an idle index of one point, of 1,000: {what}", f"{digits(each)} {unit}", "–"]]
    return table(["durable"], ["what restarts, disk and idle indices cost", "server", "bare"], rows)


def pauses():
    rows = []
    for title, got in of("durable").items():
        if not title.startswith("while "):
            continue
        count = f"{int(title.split()[1]):,} points: "
        for what in ("points loaded a second", "single inserts, p50", "single inserts, p99.9", "single inserts, max",
                     "k = 10 queries, p50", "k = 10 queries, p99.9", "k = 10 queries, max",
                     "resident bytes a point, right after the load", "resident bytes a point, the least within 30 s"):
            if f"on disk: {what}" not in got:  # Only some systems report the resident bytes.
                continue
            cells = [got[f"{where}: {what}"] for where in ("on disk", "in memory")]
            shown = (f"{digits(one['figure'])} {one['unit'].removesuffix('/s')}".strip() for one in cells)
            rows.append([count + what.replace("max", "slowest"), *shown])
    return table(["durable"], ["while the index is loaded", "on disk", "in memory"], rows)


SERVER = {
    "columns": columns, "grpc": grpc, "loading": loading, "cluster": cluster, "cluster-time": cluster_time, "outages": outages,
    "writers": writers, "call-cost": call_cost, "zenoh": zenoh,
    "acknowledged": acknowledged, "kept": kept, "pauses": pauses,
    "restart": lambda: digits(durable("restart")["from opening to ready"]["figure"]) + " seconds",
    "loaded-bytes": lambda: digits(durable("while ")["on disk: resident bytes a point, right after the load"]["figure"]) + " bytes",
    "grpc-call": lambda: digits(of("network")["searches"]["one"]["server"]["p50_ms"]) + " ms",
    "zenoh-call": lambda: digits(of("robots")["json"]["one in flight, p50"]["figure"] / 1e3) + " ms",
}
