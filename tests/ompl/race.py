"""Runs OMPL's planners and the program `rigid` in turns; `tests/ompl/rigid` starts it."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from operator import mul
from pathlib import Path
from statistics import median

import problems
from planners import PLANNERS, Run, Scene, answer, calls_us, grow

HEAD = f"{'':<34}{'time, s (least .. most)':>30}{'nodes':>9}{'checks':>11}{'ns a check':>12}{'calls of Python':>17}"
NOTE = """\
Medians of {runs} runs, each with states of its own. OMPL runs in one thread; its collision checks are the library's,
called from Python. The last column is the share of these calls in the time: {state:.1f} µs for a state and {motion:.1f} µs
for a motion without anything to check. A check is one state and takes a worker of rigid {check:.0f} ns.
rigid: a process for each worker and a server for all; the time includes the network. The checks of a worker for the
milestone at which it is ended are not counted."""


def ours(programs: Path, arguments: list, directory: str) -> list[tuple[dict, Run]]:
    """The rows of the program for one run with each number of workers."""
    figures = Path(directory, "figures.json")
    command = [programs / "rigid", *map(str, arguments), "--scaling", "--runs", "1", "--json", figures]
    subprocess.run(command, check=True, stdout=subprocess.PIPE, cwd=directory)
    rows = json.loads(figures.read_text())
    return [(row, Run(row["total_s"], row["nodes"], row["checks"], (0, 0), row["path_lengths"])) for row in rows]


def line(name: str, runs: list[Run], calls: tuple) -> str:
    seconds, checks = [run.seconds for run in runs], median(run.checks for run in runs)
    time = f"{median(seconds):.3f} ({min(seconds):.3f} .. {max(seconds):.3f})"
    each = median(run.seconds / run.checks for run in runs) * 1e9
    share = median(sum(map(mul, run.calls, calls)) * 1e-6 / run.seconds for run in runs)
    python = f"{100 * share:.0f} %" if share > 0 else "-"
    nodes = median(run.nodes for run in runs)
    return f"{name:<34}{time:>30}{nodes:>9.0f}{checks:>11.0f}{each:>12.0f}{python:>17}"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--programs", type=Path, required=True, help="the directory of `rigid`")
    parser.add_argument("--runs", type=int, default=21, help="the runs of each planner; the table shows medians")
    growing = "the milestones of the roadmaps whose growth is compared too, by --runs / 4 runs; 0 for none"
    parser.add_argument("--milestones", type=int, default=1500, help=growing)
    parser.add_argument("--json", type=Path, help="writes all figures to a file")
    arguments = parser.parse_args()
    programs, runs = arguments.programs.resolve(), max(arguments.runs, 1)
    problems.seed()
    scene = Scene(programs)
    calls = calls_us(scene)

    solved: dict[str, list[Run]] = {}
    grown: dict[str, list[Run]] = {}
    checking: list[float] = []
    few = max(runs // 4, 1) if arguments.milestones > 0 else 0
    with tempfile.TemporaryDirectory() as directory:
        # The first run is not counted, like the program's own first run.
        for name in PLANNERS:
            answer(scene, name)
        # The planners take turns, so that other load on the machine affects all of them.
        for seed in range(1, runs + 1):
            for name in PLANNERS:
                solved.setdefault(f"OMPL {name}", []).append(answer(scene, name))
            for row, run in ours(programs, ["--until-solved", "--seed", seed], directory):
                solved.setdefault(f"rigid, {workers(row['workers'])}", []).append(run)
                if row["workers"] == 1:
                    checking.append(row["check_s"] / row["checks"])
        for seed in range(1, few + 1):
            grown.setdefault("OMPL PRM*", []).append(grow(scene, arguments.milestones))
            for row, run in ours(programs, ["--milestones", arguments.milestones, "--seed", seed], directory):
                name = f"rigid, {workers(row['workers'])}, {row['source']}"
                grown.setdefault(name, []).append(run)
    check = median(checking) * 1e9

    print(f"Until all {len(scene.tasks)} questions are answered:\n{HEAD}")
    for name, of in solved.items():
        print(line(name, of, calls))
    print(NOTE.format(runs=runs, state=calls[0], motion=calls[1], check=check))
    if grown:
        print(f"\nA roadmap of {arguments.milestones} milestones ({few} runs):\n{HEAD}")
        for name, of in grown.items():
            print(line(name, of, calls))
        print("k(n) is e(1 + 1/d) ln n for OMPL's PRM*, with d = 6, and 2e ln n for ours: 1.7 times as many.")
    if arguments.json:
        tables = {"solved": solved, "grown": grown}
        figures = {"calls_us": calls, "check_ns": check}
        for title, table in tables.items():
            figures[title] = {name: [asdict(run) for run in of] for name, of in table.items()}
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


def workers(count: int) -> str:
    return f"{count} worker" + ("s" if count > 1 else "")


if __name__ == "__main__":
    try:
        main()
    except (AssertionError, RuntimeError, OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"error: {error}")
    sys.stdout.flush()
    # At exit, OMPL's bindings report objects that the interpreter has not freed.
    os._exit(0)
