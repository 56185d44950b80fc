"""The parts of the programs that measure servers: their options, builds, and the processor time of processes."""

import argparse
import json
import os
import pathlib
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[2]


def build(names):
    """Builds programs of the suites in release; returns their directory."""
    programs = [f"--bin={name}" for name in names]
    command = ["cargo", "build", "--release", "--package=wayfold-tests", "--message-format=json", *programs]
    lines = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    executables = [message["executable"] for message in map(json.loads, lines) if message.get("executable")]
    return pathlib.Path(executables[0]).parent


def processor_seconds(*pids):
    """The seconds that processes have had of a processor."""
    fields = [pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in pids]
    return sum(int(it[11]) + int(it[12]) for it in fields) / os.sysconf("SC_CLK_TCK")


def main(description, names, measure, **numbers):
    """Calls `measure` with the directory of the programs `names` and with options, whose defaults are `numbers`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option, default in numbers.items():
        parser.add_argument(f"--{option}", type=int, default=default)
    parser.add_argument("--programs", type=pathlib.Path, help="the directory of the programs; without it they are built")
    parser.add_argument("--json", type=pathlib.Path, help="also write the figures to this file")
    arguments = vars(parser.parse_args())
    programs, file = arguments.pop("programs"), arguments.pop("json")
    text = json.dumps(measure(programs.resolve() if programs else build(names), **arguments), indent=1)
    print(text)
    if file:
        file.write_text(text + "\n")
