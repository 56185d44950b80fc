"""The stub has exactly the names of the extension."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from wayfold import _wayfold

STUB = Path(__file__).resolve().parents[1] / "python" / "wayfold" / "_wayfold.pyi"
CLASSES = {
    one.name: one
    for one in ast.parse(STUB.read_text()).body
    # Protocols of the stub alone are marked.
    if isinstance(one, ast.ClassDef) and not one.decorator_list
}


def names(body: list[ast.stmt]) -> set[str]:
    """The functions and the constants of a module or a class."""
    functions = {one.name for one in body if isinstance(one, ast.FunctionDef)}
    values = [one for one in body if isinstance(one, ast.AnnAssign) and "TypeAlias" not in ast.dump(one.annotation)]
    return functions | {value.target.id for value in values if isinstance(value.target, ast.Name)}


def test_the_stub_has_the_names_of_the_module() -> None:
    found = {name for name in vars(_wayfold) if not name.startswith("__")}
    assert names(ast.parse(STUB.read_text()).body) | set(CLASSES) == found


@pytest.mark.parametrize("name", CLASSES)
def test_the_stub_has_the_names_of_a_class(name: str) -> None:
    found, stated = getattr(_wayfold, name), names(CLASSES[name].body)
    assert {name for name in vars(found) if not name.startswith("_")} == {name for name in stated if not name.startswith("_")}
    # Python gives each class more of these.
    assert stated <= set(dir(found))
