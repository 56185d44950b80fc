"""Runs the programs of client/cpp/race in turns, compares their answers, and prints the tables."""

import argparse
import json
import math
import random
import struct
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

# The name, the space, and the number of vertices that ends it.
PLANNERS = [
    ("RRT", "se3", 25_000), ("RRTConnect", "se3", 25_000), ("PRM", "se3", 15_000), ("PRM*", "se3", 10_000),
    ("LazyRRT", "se3", 25_000), ("RRT*", "se2", 10_000), ("RRT*", "se3", 5_000),
]
VARIANTS = ["shipped", "bare"]
STRUCTURES = ["gnat", "wayfold", "replay"]
POINTS = 10_000
# k and the queries of a round.
MANY = [(100, 2_000), (1_000, 400), (POINTS, 50)]
INSERTS = 100_000
# The points and the queries of the comparison with Rust.
STORED, ASKED = 50_000, 50_000


def run(*command):
    done = subprocess.run([str(part) for part in command], check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def compared(one, other):
    """The median of the ratios of pairs, and their range."""
    ratios = [a / b for a, b in zip(one, other)]
    return {"ratio": median(ratios), "least": min(ratios), "most": max(ratios)}


def grow(programs, planner, space, vertices, seeds, directory):
    """One planner with all structures, in both variants, seed by seed."""
    answers = directory / "answers"
    times = {variant: {structure: [] for structure in STRUCTURES} for variant in VARIANTS}
    merging = {variant: [] for variant in VARIANTS}
    structures = {}
    for seed in seeds:
        plan = lambda variant, structure: run(
            programs / f"race-{variant}", "plan", planner, space, structure, seed, vertices, answers)
        tree = lambda got: [got["vertices"], got["edges"], got["length"]]
        expected = tree(plan("bare", "record"))
        for variant in VARIANTS:
            for structure in STRUCTURES:
                got = plan(variant, structure)
                if tree(got) != expected:
                    sys.exit(f"error: {planner} in {space}, seed {seed}, grows {expected}, and with {structure} "
                             f"({variant}) {tree(got)}: vertices, edges, their length")
                times[variant][structure].append(got["own"] + got["others"])
                if structure == "wayfold":
                    merging[variant].append(got["others"])
                if structure == "gnat":
                    structures[variant] = got["structure"]
                    # The program's own GNAT would replace the library's without a word.
                    if (got["structure"] == "race-bare") != (variant == "bare"):
                        sys.exit(f"error: {planner}, {variant}: GNAT is that of {got['structure']}")
    row = {"planner": planner, "space": space, "vertices": vertices}
    for variant in VARIANTS:
        of = times[variant]
        row[variant] = {f"{structure}_s": median(of[structure]) for structure in STRUCTURES}
        row[variant] |= {"merging_s": median(merging[variant]), "gnat_of": structures[variant]}
        row[variant] |= compared(of["gnat"], of["wayfold"])
        row[variant]["ceiling"] = compared(of["gnat"], of["replay"])["ratio"]
    return row


def many_neighbors(programs, k, queries, runs):
    row = {"points": POINTS, "k": k}
    for variant in VARIANTS:
        got = run(programs / f"race-{variant}", "neighbors", POINTS, k, queries, runs)
        row[variant] = {f"{structure}_s": median(times) for structure, times in got.items()}
        row[variant] |= compared(got["gnat"], got["wayfold"])
    return row


def inserts(programs, merging, runs):
    """The medians over the runs, and the worst insert of all of them."""
    got = [run(programs / "race-shipped", "inserts", INSERTS, merging) for _ in range(runs)]
    row = {"points": INSERTS, "merging": merging}
    for clock in ("own", "wall"):
        of = [one[clock] for one in got]
        row[clock] = {at: median(one[at] for one in of) for at in ("p50", "p99.9", "max")}
        row[clock]["worst"] = max(one["max"] for one in of)
    return row


def write_rows(path):
    """Random states of R3*SO3."""
    generator = random.Random(1)
    with open(path, "wb") as file:
        for _ in range(STORED + ASKED):
            position = [generator.uniform(0, 10) for _ in range(3)]
            rotation = [generator.gauss(0, 1) for _ in range(4)]
            norm = math.sqrt(sum(value * value for value in rotation))
            file.write(struct.pack("7d", *position, *(value / norm for value in rotation)))


def over_rust(programs, rows, k, runs, directory):
    path = directory / "rows"
    if not path.exists():
        write_rows(path)
    times = {"cpp": [], "rust": []}
    for _ in range(runs):
        got = {"cpp": run(programs / "race-bare", "rows", path, STORED, k), "rust": run(rows, path, STORED, k)}
        if got["cpp"]["sum"] != got["rust"]["sum"]:
            sys.exit(f"error: C++ and Rust find other neighbours at k = {k}")
        for language, one in got.items():
            times[language].append(one["seconds"])
    return {"k": k, "points": STORED} | {f"{language}_s": median(of) for language, of in times.items()} \
        | compared(times["cpp"], times["rust"])


def print_table(header, rows):
    print("\n| " + " | ".join(header) + " |\n" + "|---" * len(header) + "|")
    for row in rows:
        print("| " + " | ".join(row) + " |")
    sys.stdout.flush()


def spread(got):
    return f"{got['ratio']:.2f} ({got['least']:.2f} to {got['most']:.2f})"


def print_all(data):
    for variant in VARIANTS if "planners" in data else []:
        rows = [[f"{row['planner']}, {row['space'].upper()}, {row['vertices']:,} vertices"]
                + [f"{row[variant][f'{structure}_s']:.3f} s" for structure in STRUCTURES]
                + [f"{row[variant]['merging_s']:.3f} s", spread(row[variant]), f"{row[variant]['ceiling']:.2f}"]
                for row in data["planners"]]
        gnat = f"GNAT of {data['planners'][0][variant]['gnat_of']}"
        print_table([variant, gnat, "Wayfold", "no search", "merging", "GNAT / Wayfold", "GNAT / no search"], rows)
    if "neighbors" in data:
        rows = [[f"k = {row['k']:,} of {row['points']:,}, SE3, {variant}"]
                + [f"{1e6 * row[variant][f'{structure}_s']:.1f} µs" for structure in STRUCTURES[:2]]
                + [spread(row[variant])] for row in data["neighbors"] for variant in VARIANTS]
        print_table(["nearestK", "GNAT", "Wayfold", "GNAT / Wayfold"], rows)
    if "inserts" in data:
        rows = [[f"{row['points']:,} inserts, merges {row['merging']}, {clock} time"]
                + [f"{1e6 * row[clock][at]:,.1f} µs" for at in ("p50", "p99.9", "max", "worst")]
                for row in data["inserts"] for clock in ("own", "wall")]
        print_table(["single inserts, SE3", "p50", "p99.9", "slowest", "slowest of all runs"], rows)
    if "rust" in data:
        rows = [[f"k = {row['k']}", f"{1e6 * row['cpp_s']:.3f} µs", f"{1e6 * row['rust_s']:.3f} µs", spread(row)]
                for row in data["rust"]]
        print_table([f"a search of {STORED:,} points, SE3", "C++", "Rust", "C++ / Rust"], rows)


def main():
    parser = argparse.ArgumentParser(prog="client/cpp/race", description=__doc__)
    parser.add_argument("--programs", type=Path, required=True, help=argparse.SUPPRESS)
    parser.add_argument("--rows", type=Path, required=True, help=argparse.SUPPRESS)
    parser.add_argument("--runs", type=int, default=5, help="the seeds of a planner, and the runs of the rest")
    parser.add_argument("--only", choices=["planners", "neighbors", "inserts", "rust"])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    programs, runs = arguments.programs, arguments.runs
    subprocess.run([programs / "race-bare", "plan", "check"], check=True)
    data = {}
    with tempfile.TemporaryDirectory() as directory:
        parts = {
            "planners": lambda: [grow(programs, *one, range(1, runs + 1), Path(directory)) for one in PLANNERS],
            "neighbors": lambda: [many_neighbors(programs, *one, runs) for one in MANY],
            "inserts": lambda: [inserts(programs, merging, runs) for merging in ("background", "inline")],
            "rust": lambda: [over_rust(programs, arguments.rows, k, runs, Path(directory)) for k in (1, 10)],
        }
        for name, part in parts.items():
            if arguments.only in (None, name):
                data[name] = part()
                print_all({name: data[name]})
    if arguments.json:
        arguments.json.write_text(json.dumps({"rounds": runs, **data}, indent=1) + "\n")


if __name__ == "__main__":
    main()
