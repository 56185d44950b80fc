"""Python's cost over Rust, and scipy's `cKDTree` beside it: client/python/measure runs it.

Needs the package built in release (`pip install ./client/python`) and scipy. Prints medians of interleaved runs.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import statistics
import time

import numpy as np
import wayfold
from scipy.spatial import cKDTree
from wayfold._wayfold import _seconds_in_rust

POINTS, STATES = 50_000, 10_000


def states_of(space: str, n: int, rng: np.random.Generator) -> np.ndarray:
    if space.startswith("R3*SO3"):
        quaternions = rng.normal(size=(n, 4))
        return np.column_stack([rng.uniform(size=(n, 3)), quaternions / np.linalg.norm(quaternions, axis=1)[:, None]])
    return rng.uniform(size=(n, wayfold.Space(space).coordinates))


def seconds(action) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=15, help="the runs of which the median counts")
    parser.add_argument("--json", type=pathlib.Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    print(f"{POINTS} points, {STATES} states, medians of {arguments.runs} runs")
    print("| space | k | 10,000 states, over Rust | one state, above Rust | one state | scipy, 10,000 | scipy, one state |")
    print("|---|---|---|---|---|---|---|")
    rng = np.random.default_rng(1)
    rows: list[dict[str, object]] = []
    for space in ("R3", "R6", "R3*SO3:0.15"):
        points, states = states_of(space, POINTS, rng), states_of(space, STATES, rng)
        index = wayfold.Index(space)
        index.insert_many(points)
        tree = cKDTree(points) if "SO3" not in space else None
        time.sleep(2)  # The levels are packed when nothing changes.
        for k in (1, 10):
            columns: list[list[float]] = [[] for _ in range(6)]
            for run in range(arguments.runs):
                measures = [
                    lambda: columns[0].append(_seconds_in_rust(index, states, k, True)),
                    lambda: columns[1].append(seconds(lambda: index.query(states, k))),
                    lambda: columns[2].append(_seconds_in_rust(index, states, k, False)),
                    lambda: columns[3].append(seconds(lambda: [index.query(state, k) for state in states])),
                ]
                # The first finds cold caches, so each is first in half of the runs.
                for measure in measures if run % 2 else reversed(measures):
                    measure()
                if tree is not None:
                    columns[4].append(seconds(lambda: tree.query(states, k)))
                    columns[5].append(seconds(lambda: [tree.query(state, k) for state in states[:1000]]) * STATES / 1000)
            rust_many, many, rust_one, one = (statistics.median(column) for column in columns[:4])
            ratio = statistics.median(p / r for p, r in zip(columns[1], columns[0], strict=True))
            each = 1e6 / STATES
            row = {"space": space, "k": k, "over_rust": ratio, "above_rust_us": (one - rust_one) * each, "one_us": one * each}
            peers = ["–", "–"]
            if tree is not None:
                scipy_many, scipy_one = statistics.median(columns[4]), statistics.median(columns[5])
                row |= {"scipy_over_ours": scipy_many / many, "scipy_one_us": scipy_one * each}
                peers = [f"{row['scipy_over_ours']:.2f} × ours", f"{row['scipy_one_us']:.1f} µs"]
            rows.append(row)
            above = f"{row['above_rust_us']:.2f} µs"
            print(f"| {space} | {k} | {ratio:.3f} | {above} | {row['one_us']:.2f} µs | {' | '.join(peers)} |", flush=True)
    if arguments.json:
        figures = {"points": POINTS, "states": STATES, "rounds": arguments.runs, "rows": rows}
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
