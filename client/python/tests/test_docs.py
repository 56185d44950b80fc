"""The worked examples of docs/python.md run as they stand."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import Server

PAGE = Path(__file__).resolve().parents[3] / "docs" / "python.md"
PROGRAMS = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE.read_text(), re.DOTALL))
# The longest time of an example.
MAX_RUN_S = 120


def test_the_tree_reaches_its_goal(server: Server, tmp_path: Path) -> None:
    found = re.fullmatch(r"a tree of (\d+) nodes; the path has (\d+) states\n", output("rrt.py", server, tmp_path))
    assert found is not None
    nodes, states = map(int, found.groups())
    # From (1, 1) to (9, 9) in steps of at most 0.5.
    assert nodes >= states >= math.dist((1, 1), (9, 9)) / 0.5 + 1


def test_the_roadmap_has_the_vertices_of_both_workers(server: Server, tmp_path: Path) -> None:
    found = re.fullmatch(r"400 vertices, (\d+) edges\n", output("roadmap.py", server, tmp_path))
    assert found is not None and int(found[1]) > 400


def test_the_robot_gets_the_distances_of_both_points(server: Server, tmp_path: Path) -> None:
    distances = json.loads(output("robot.py", server, tmp_path))
    assert distances == [pytest.approx([0.0, math.hypot(0.3, math.sqrt(0.15) * math.pi / 2)])]


def output(name: str, server: Server, tmp_path: Path) -> str:
    """The output of an example."""
    program = tmp_path / name
    program.write_text(PROGRAMS[name])
    environment = {**os.environ, "WAYFOLD_SERVER": server.url, "WAYFOLD_ZENOH": server.locator}
    ran = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, timeout=MAX_RUN_S, env=environment, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout
