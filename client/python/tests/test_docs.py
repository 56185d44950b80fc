"""The worked examples of docs/python.md run as they stand."""

from __future__ import annotations

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


@pytest.mark.parametrize("name", ["rrt.py", "roadmap.py", "robot.py"])
def test_an_example_runs(name: str, server: Server, tmp_path: Path) -> None:
    program = tmp_path / name
    program.write_text(PROGRAMS[name])
    environment = {**os.environ, "WAYFOLD_SERVER": server.url, "WAYFOLD_ZENOH": server.locator}
    ran = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, timeout=MAX_RUN_S, env=environment, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip()
