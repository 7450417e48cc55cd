"""The rules of the design, read off the source: who may import whom, and who may see a clock."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from importlib import import_module
from inspect import isclass, isfunction
from pathlib import Path

import pytest

import perchctl

ROOT = Path(perchctl.__file__).resolve().parent

# Library -> the modules (by prefix) that may import it; `*.plot`: modules of that name.
HOMES: dict[str, tuple[str, ...]] = {
    "cflib": ("perchctl.link",),
    "typer": ("perchctl.commands",),
    "click": (),
    "rich": ("perchctl.commands", "perchctl.display"),
    "filterpy": ("perchctl.vision.filter",),
    "mujoco": ("perchctl.sim",),
    "matplotlib": ("*.plot",),
    "jinja2": ("perchctl.analysis.report",),
    "motioncapture": ("perchctl.positioning",),
    "mcap": ("perchctl.record.recording_file", "perchctl.record.recorded"),
    "mcap_protobuf": ("perchctl.record.recording_file", "perchctl.record.recorded"),
    "foxglove_schemas_protobuf": ("perchctl.record.recording_file", "perchctl.record.recorded"),
    "google": ("perchctl.record.recording_file", "perchctl.record.recorded"),
    "distributed": ("perchctl.campaign",),
    "dask": ("perchctl.campaign",),
    "pyarrow": ("perchctl.record.table",),
    "av": ("perchctl.track.outputs", "perchctl.camera.network"),
}

# Time is an argument here.
CLOCKLESS = (
    "perchctl.geometry",
    "perchctl.vision",
    "perchctl.mission",
    "perchctl.perception",
)
CLOCKS = ("time", "datetime", "sched", "threading", "asyncio", "signal")

# From the innermost room outwards. A module imports from its own room and from those
# before it; rooms in one line do not know of each other.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("perchctl.errors", "perchctl.startup"),
    (
        "perchctl.geometry",
        "perchctl.files",
        "perchctl.places",
        "perchctl.plain_yaml",
        "perchctl.vehicle",
        "perchctl.values",
        "perchctl.children",
    ),
    ("perchctl.plot",),
    ("perchctl.profile",),
    ("perchctl.vision",),
    ("perchctl.mission",),
    ("perchctl.target",),
    ("perchctl.camera", "perchctl.positioning"),
    ("perchctl.perception",),
    ("perchctl.calibration",),
    ("perchctl.link",),
    ("perchctl.sim", "perchctl.record"),
    ("perchctl.flight",),
    ("perchctl.campaign",),
    (
        "perchctl.weights",
        "perchctl.faults",
        "perchctl.check",
        "perchctl.analysis",
    ),
    ("perchctl.display",),
    ("perchctl.track",),
    ("perchctl.commands",),
    ("perchctl.__main__",),
)
FACE = "perchctl"  # the package itself: version and public names, taken from all rooms

# Packages with a face: the others take its names, and nothing from behind it. The number is how
# many names it has at most.
MOST_NAMES = {
    "analysis": 15,
    "calibration": 30,
    "camera": 28,
    "campaign": 25,
    "check": 15,
    "commands": 15,
    "display": 15,
    "faults": 15,
    "flight": 22,
    "link": 15,
    "record": 19,
    "mission": 48,
    "perception": 15,
    "positioning": 15,
    "profile": 38,
    "sim": 25,
    "target": 28,
    "track": 15,
    "vision": 50,
    "weights": 15,
}


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
    return any(
        name.endswith(p[1:]) if p.startswith("*") else name == p or name.startswith(f"{p}.")
        for p in prefixes
    )


def layer_of(name: str) -> int:
    """The layer whose room the module is in."""
    for number, rooms in enumerate(LAYERS):
        if is_under(name, rooms):
            return number
    raise AssertionError(f"{name} belongs to no layer: add its room to LAYERS")


def room_of(name: str) -> str:
    return ".".join(name.split(".")[:2])


def misplaced(imports: list[Import]) -> list[str]:
    """Libraries imported outside their homes."""
    return [
        str(i)
        for i in imports
        for library in [i.imported.split(".")[0]]
        if library in HOMES and not is_under(i.importer, HOMES[library])
    ]


def uphill(imports: list[Import]) -> list[str]:
    """Imports from an inner layer of an outer one, or of another room of the same one."""
    return [
        str(i)
        for i in imports
        if i.imported.startswith("perchctl.")
        and i.importer != FACE
        and layer_of(i.imported) >= layer_of(i.importer)
        and room_of(i.imported) != room_of(i.importer)
    ]


def past_a_face(imports: list[Import]) -> list[str]:
    """Imports of a module that lies behind another package's face."""
    faces = tuple(f"perchctl.{package}" for package in MOST_NAMES)
    return [
        str(i)
        for i in imports
        if is_under(i.imported, faces)
        and i.imported not in faces
        and room_of(i.imported) != room_of(i.importer)
    ]


def clocks(imports: list[Import]) -> list[str]:
    return [
        str(i)
        for i in imports
        if is_under(i.importer, CLOCKLESS) and i.imported.split(".")[0] in CLOCKS
    ]


def cycle(imports: list[Import]) -> list[str]:
    """Some modules that need each other, or nothing. Types and late imports count too."""
    needs: dict[str, set[str]] = {}
    for i in imports:
        if i.imported in MODULES and i.imported != i.importer and i.imported != FACE:
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
    assert {
        "perchctl.geometry",
        "perchctl.mission.planner",
        "perchctl.commands.command_line",
    } <= set(MODULES)
    assert len(IMPORTS) > 100


def test_libraries_stay_in_their_rooms() -> None:
    assert misplaced(IMPORTS) == []


def test_each_library_is_used_at_home() -> None:
    used = {i.imported.split(".")[0] for i in IMPORTS}
    assert {library for library, homes in HOMES.items() if homes} <= used


def test_imports_point_one_way() -> None:
    assert uphill(IMPORTS) == []


def test_packages_are_entered_by_their_faces() -> None:
    assert not past_a_face(IMPORTS)


@pytest.mark.parametrize("package", MOST_NAMES)
def test_a_face_has_few_names_and_each_says_what_it_is(package: str) -> None:
    face = import_module(f"perchctl.{package}")
    assert 0 < len(face.__all__) <= MOST_NAMES[package]
    for name in face.__all__:
        thing = getattr(face, name)
        if isclass(thing) or isfunction(thing):
            assert thing.__doc__, name


def test_no_module_needs_itself() -> None:
    assert cycle(IMPORTS) == []


def test_no_clock_where_time_is_an_argument() -> None:
    assert clocks(IMPORTS) == []


def test_only_the_command_line_loads_typer_and_nothing_heavy() -> None:
    """`perchctl --help` stays quick: a subcommand loads libraries when it runs."""
    allowed = ("perchctl.errors", "perchctl.startup")
    heavy = ("numpy", "cv2", "cflib", "matplotlib", "mujoco", "filterpy", "pydantic", "scipy")
    for i in IMPORTS:
        if not i.at_load or not is_under(i.importer, ("perchctl.commands.command_line",)):
            continue
        assert i.imported.split(".")[0] not in heavy, str(i)
        if i.imported.startswith("perchctl."):
            assert is_under(i.imported, allowed), str(i)


BROKEN = {
    "perchctl.mission.planner": (
        "def f():\n    import time\n    from perchctl.vision import types\n", clocks, "time"
    ),
    "perchctl.vision.merge": ("from perchctl.mission import state\n", uphill, "mission.state"),
    "perchctl.geometry": ("from .profile import Profile\n", uphill, "profile"),
    "perchctl.sim.world": ("from perchctl.record import read\n", uphill, "record.read"),
    "perchctl.link.mock": ("from perchctl.sim import world\n", uphill, "sim.world"),
    "perchctl.vision.pipeline": (
        "import typing\nif typing.TYPE_CHECKING:\n    from perchctl.link.mock import X\n",
        uphill,
        "link.mock",
    ),
    "perchctl.commands.fly": ("from perchctl.check.row import Row\n", past_a_face, "check.row"),
    "perchctl.analysis.plot": ("import cflib.crazyflie\n", misplaced, "cflib"),
    "perchctl.record.read": ("import matplotlib\n", misplaced, "matplotlib"),
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
