"""The structure that docs/architecture.md describes: the order of imports, no cycles, and short units of code.

Deferred imports and imports under TYPE_CHECKING count; a look-up through `outlap.plugins` does not.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import outlap

ROOT = Path(outlap.__file__).parent
ORDER = (
    "foundation", "track", "simulator", "planning", "drivers", "envs", "mql", "evaluation", "training", "experiments",
    "viewer", "deploy", "cli",
)  # fmt: skip
LONGEST_MODULE, LONGEST_FUNCTION = 400, 60  # lines
FRONT_DOORS = ("outlap", "outlap.__main__")  # may import any package, and nothing imports them


@cache
def modules() -> dict[str, Path]:
    """Return the file of every module of outlap by its dotted name."""
    files = {".".join(("outlap", *path.relative_to(ROOT).with_suffix("").parts)): path for path in ROOT.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in files.items()}


@cache
def syntax(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports(name: str) -> frozenset[str]:
    """Return the modules of outlap that a module imports anywhere in its code."""
    found: set[str] = set()
    for node in ast.walk(syntax(modules()[name])):
        if isinstance(node, ast.ImportFrom):
            assert node.module, f"{name}:{node.lineno}: a relative import"
            members = (f"{node.module}.{alias.name}" for alias in node.names)
            found |= {member if member in modules() else node.module for member in members}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return frozenset(found & modules().keys())


def package(name: str) -> str:
    """Return the package of a module; a module beside the packages is part of the foundation."""
    first = name.split(".")[1]
    return first if (ROOT / first).is_dir() else "foundation"


def test_a_package_imports_only_the_packages_before_it() -> None:
    upwards = {
        f"{name} -> {imported}"
        for name in modules()
        if name not in FRONT_DOORS
        for imported in imports(name)
        if imported in FRONT_DOORS or ORDER.index(package(name)) < ORDER.index(package(imported))
    }
    assert not upwards


def test_no_modules_import_each_other() -> None:
    assert not {name for name in modules() if name in reached(name)}


def reached(name: str) -> set[str]:
    """Return the modules that a module imports, directly or through others."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        new = imports(waiting.pop()) - found
        found |= new
        waiting += new
    return found


def test_no_module_is_long() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in modules().items()}
    assert not {name for name, length in lengths.items() if length > LONGEST_MODULE}


def test_no_function_is_long_outside_kernels() -> None:
    lengths = {where: length for name, path in modules().items() for where, length in functions(name, syntax(path))}
    assert not {where for where, length in lengths.items() if length > LONGEST_FUNCTION}


def functions(name: str, tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield the place and the number of lines of every function that Numba does not compile."""
    for node in ast.walk(tree):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        compiled = any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)
        if not compiled:
            assert node.end_lineno is not None
            yield f"{name}.{node.name}", node.end_lineno - node.lineno + 1
