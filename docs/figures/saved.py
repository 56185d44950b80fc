"""The saved figures, and the form of a table."""

import json
import textwrap
from pathlib import Path

FIGURES = Path(__file__).resolve().parent


class Missing(Exception):
    """No file has these figures yet."""


def read(name):
    path = FIGURES / f"{name}.json"
    if not path.exists():
        raise Missing(name)
    return json.loads(path.read_text())


def of(name):
    return read(name)["data"]


def table(names, header, rows):
    """A table under its origin."""
    origins = {}
    for saved in map(read, names):
        origin = "Commit {commit}, {date}; {processor}".format(**saved)
        origin += "".join(f", {saved[key]} {key}" for key in ("cores", "rounds") if saved.get(key))
        origin += f"; {saved['note']}" if "note" in saved else ""
        commands = origins.setdefault(origin, [])
        if "command" in saved:
            commands.append(f"`{saved['command']}`")
    sources = (f"{origin}. Command: {', '.join(commands)}" if commands else origin for origin, commands in origins.items())
    text = textwrap.fill(f"*{'. '.join(sources)}.*", 128, break_long_words=False, break_on_hyphens=False)
    shown = [f"| {' | '.join(row)} |" for row in (header, *rows)]
    shown.insert(1, "|---" * len(header) + "|")
    return f"\n{text}\n\n" + "\n".join(shown) + "\n"


def digits(value):
    """Two digits, or the whole number."""
    return f"{value:,.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 1 else f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"


def tenths(value):
    """The whole number, or one with a tenth below ten."""
    return f"{value:,.0f}" if value >= 9.95 else f"{value:.1f}"


def ratio(value):
    if value is None:
        return "–"
    return digits(value) if value >= 1 else f"**{value:.2f}**"
