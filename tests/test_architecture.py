"""The rules of the design, read off the source: who may import whom, and who may see a clock."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

import pytest

import perchctl

ROOT = Path(perchctl.__file__).resolve().parent

# Library -> the modules (by prefix) that may import it.
HOMES: dict[str, tuple[str, ...]] = {
    "cflib": ("perchctl.link",),
    "typer": ("perchctl.cli",),
    "click": (),
    "rich": ("perchctl.cli", "perchctl.record"),
    "filterpy": ("perchctl.vision.filter",),
    "mujoco": ("perchctl.sim",),
    "matplotlib": ("perchctl.record",),
    "motioncapture": ("perchctl.weights.truth",),
}

# Time is an argument here.
CLOCKLESS = (
    "perchctl.geometry",
    "perchctl.vision",
    "perchctl.pipeline",
    "perchctl.mission",
)
CLOCKS = ("time", "datetime", "sched", "threading", "asyncio", "signal")

# From the innermost room outwards; the first prefix that fits names the layer.
# A module imports from its own layer and from those before it.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("perchctl.errors", "perchctl.geometry", "perchctl.locations", "perchctl.target.dictionaries"),
    ("perchctl.profile",),
    ("perchctl.vision", "perchctl.weights"),
    ("perchctl.mission",),
    ("perchctl.pipeline",),
    (
        "perchctl.camera",
        "perchctl.link",
        "perchctl.sim",
        "perchctl.record",
        "perchctl.calibration",
        "perchctl.target",
        "perchctl.view",
        # where data come from; the rest of the package is arithmetic
        "perchctl.weights.collect",
        "perchctl.weights.dialogue",
        "perchctl.weights.flight_logs",
        "perchctl.weights.simulated",
        "perchctl.weights.truth",
        "perchctl.mission.flight",  # the conductor: it drives camera, link and pipeline
    ),
    # A command's work, opened by the command line; so is any other single module
    # directly under `perchctl`.
    ("perchctl.sim.campaign",),
    ("perchctl.cli", "perchctl.__main__"),
)
ANYWHERE = ("perchctl",)  # the package itself holds the version only


@dataclass(frozen=True)
class Import:
    """One import statement, wherever in the module it stands."""

    importer: str
    imported: str
    line: int
    at_run_time: bool  # not under `if TYPE_CHECKING`
    at_load: bool  # at the module's top level

    def __str__(self) -> str:
        return f"{self.importer} line {self.line} imports {self.imported}"


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}


def imports_of(name: str, source: str, is_package: bool, known: set[str]) -> list[Import]:
    """All imports of a module; `from package import module` counts as the module."""
    found: list[Import] = []

    def visit(node: ast.AST, at_run_time: bool, at_load: bool) -> None:
        if isinstance(node, ast.Import):
            for alias in node.names:
                found.append(Import(name, alias.name, node.lineno, at_run_time, at_load))
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(name, node, is_package)
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                target = inner if inner in known else base
                found.append(Import(name, target, node.lineno, at_run_time, at_load))
        inside_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for child in node.body:
                visit(child, False, at_load)
            for child in node.orelse:
                visit(child, at_run_time, at_load)
            return
        for child in ast.iter_child_nodes(node):
            visit(child, at_run_time, at_load and not inside_function)

    visit(ast.parse(source), True, True)
    return found


def _absolute(name: str, node: ast.ImportFrom, is_package: bool) -> str:
    if not node.level:
        return node.module or ""
    parts = name.split(".")
    keep = len(parts) - node.level + (1 if is_package else 0)
    return ".".join(parts[:keep] + ([node.module] if node.module else []))


IMPORTS = [
    found
    for name, path in MODULES.items()
    for found in imports_of(
        name, path.read_text(encoding="utf-8"), path.name == "__init__.py", set(MODULES)
    )
]


def is_under(name: str, prefixes: tuple[str, ...]) -> bool:
    return any(name == p or name.startswith(f"{p}.") for p in prefixes)


def layer_of(name: str) -> int:
    """The layer with the longest prefix that fits."""
    fitting = [
        (len(prefix), i)
        for i, prefixes in enumerate(LAYERS)
        for prefix in prefixes
        if is_under(name, (prefix,))
    ]
    if fitting:
        return max(fitting)[1]
    assert name.count(".") == 1, f"{name} belongs to no layer: add its folder to LAYERS"
    return len(LAYERS) - 2


def misplaced(imports: list[Import]) -> list[str]:
    """Libraries imported outside their homes."""
    return [
        str(i)
        for i in imports
        for library in [i.imported.split(".")[0]]
        if library in HOMES and not is_under(i.importer, HOMES[library])
    ]


def uphill(imports: list[Import]) -> list[str]:
    """Imports from an outer layer into an inner one."""
    return [
        str(i)
        for i in imports
        if is_under(i.imported, ("perchctl",))
        and i.imported not in ANYWHERE
        and i.importer not in ANYWHERE
        and layer_of(i.imported) > layer_of(i.importer)
    ]


def clocks(imports: list[Import]) -> list[str]:
    return [
        str(i)
        for i in imports
        if is_under(i.importer, CLOCKLESS) and i.imported.split(".")[0] in CLOCKS
    ]


def cycle(imports: list[Import]) -> list[str]:
    """Some modules that need each other while they load, or nothing."""
    needs: dict[str, set[str]] = {}
    for i in imports:
        if i.at_load and i.at_run_time and i.imported in MODULES and i.imported != i.importer:
            needs.setdefault(i.importer, set()).add(i.imported)
    done: set[str] = set()

    def walk(name: str, path: list[str]) -> list[str]:
        if name in path:
            return path[path.index(name) :]
        if name in done:
            return []
        for other in sorted(needs.get(name, ())):
            if found := walk(other, [*path, name]):
                return found
        done.add(name)
        return []

    return next((found for name in sorted(needs) if (found := walk(name, []))), [])


def test_the_walk_sees_the_project() -> None:
    assert {"perchctl.geometry", "perchctl.mission.planner", "perchctl.cli"} <= set(MODULES)
    assert len(IMPORTS) > 100


def test_libraries_stay_in_their_rooms() -> None:
    assert misplaced(IMPORTS) == []


def test_each_library_is_used_at_home() -> None:
    used = {i.imported.split(".")[0] for i in IMPORTS}
    assert {library for library, homes in HOMES.items() if homes} <= used


def test_imports_point_one_way() -> None:
    assert uphill(IMPORTS) == []


def test_no_module_needs_itself_to_load() -> None:
    assert cycle(IMPORTS) == []


def test_no_clock_where_time_is_an_argument() -> None:
    assert clocks(IMPORTS) == []


def test_only_the_command_line_loads_typer_and_nothing_heavy() -> None:
    """`perchctl --help` stays quick: the command line loads libraries inside its commands."""
    allowed = {"perchctl.errors", "perchctl", "typer", "perchctl.locations"}
    heavy = ("numpy", "cv2", "cflib", "matplotlib", "mujoco", "filterpy", "pydantic", "scipy")
    for i in IMPORTS:
        if i.importer == "perchctl.cli" and i.at_load and i.at_run_time:
            assert i.imported.split(".")[0] not in heavy, str(i)
            if i.imported.startswith("perchctl"):
                assert i.imported in allowed, str(i)


BROKEN = {
    "perchctl.mission.planner": (
        "def f():\n    import time\n    from perchctl.record import panel\n", clocks, "time"
    ),
    "perchctl.vision.merge": ("from perchctl.mission import types\n", uphill, "mission.types"),
    "perchctl.geometry": ("from .profile import Profile\n", uphill, "profile"),
    "perchctl.pipeline": (
        "import typing\nif typing.TYPE_CHECKING:\n    from perchctl.link.mock import X\n",
        uphill,
        "link.mock",
    ),
    "perchctl.record.plot": ("import cflib.crazyflie\n", misplaced, "cflib"),
    "perchctl.vision.pose": ("from filterpy.kalman import KalmanFilter\n", misplaced, "filterpy"),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(BROKEN))
def test_a_broken_rule_is_seen(name: str) -> None:
    source, rule, named = BROKEN[name]
    faults = rule(imports_of(name, source, False, set(MODULES)))
    assert len(faults) == 1
    assert named in faults[0]


def test_a_cycle_is_seen() -> None:
    pair = ("perchctl.geometry", "perchctl.errors")
    there_and_back = [
        Import(pair[0], pair[1], 1, True, True),
        Import(pair[1], pair[0], 1, True, True),
    ]
    assert set(cycle(there_and_back)) == set(pair)
    assert cycle(there_and_back[:1]) == []
