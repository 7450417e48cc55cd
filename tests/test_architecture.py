"""The rules of the design, read off the source: who may import whom, and who may see a clock."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
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
    "matplotlib": ("*.plot", "perchctl.analysis.film", "perchctl.analysis.fleet_film"),
    "jinja2": ("perchctl.report_page",),
    "motioncapture": ("perchctl.positioning",),
    "mcap": ("perchctl.record.recorder", "perchctl.record.recorded"),
    "mcap_protobuf": ("perchctl.record.recorder",),
    "foxglove_schemas_protobuf": ("perchctl.record",),
    "google": ("perchctl.record.messages", "perchctl.record.recorder"),
    "distributed": ("perchctl.campaign",),
    "pandas": ("perchctl.analysis",),
    "av": ("perchctl.camera.network", "perchctl.analysis.film"),
}

# Time is an argument here.
CLOCKLESS = ("perchctl.geometry", "perchctl.vision", "perchctl.mission", "perchctl.perception")
CLOCKS = ("time", "datetime", "sched", "threading", "asyncio", "signal")

# From the innermost room outwards. A module imports from its own room and from those
# before it; rooms in one line do not know of each other.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("perchctl.errors", "perchctl.startup"),
    (
        "perchctl.geometry",
        "perchctl.corridor",
        "perchctl.files",
        "perchctl.places",
        "perchctl.plain_yaml",
        "perchctl.vehicle",
        "perchctl.values",
        "perchctl.children",
        "perchctl.extensions",
        "perchctl.opencv_threads",
        "perchctl.wrapping",
    ),
    ("perchctl.plot", "perchctl.report_page"),
    ("perchctl.profile",),
    ("perchctl.vision",),
    ("perchctl.mission",),
    ("perchctl.target",),
    ("perchctl.camera", "perchctl.positioning"),
    ("perchctl.perception",),
    ("perchctl.calibration",),
    ("perchctl.link", "perchctl.sighting"),
    ("perchctl.sim", "perchctl.record"),
    ("perchctl.flight",),
    ("perchctl.campaign",),
    ("perchctl.weights", "perchctl.faults", "perchctl.check", "perchctl.analysis"),
    ("perchctl.display", "perchctl.real_time"),
    ("perchctl.fleet",),
    ("perchctl.commands",),
    ("perchctl.__main__",),
)
FACE = "perchctl"  # the package itself: version and public names, taken from all rooms

# Packages with a face: the others take its names, and nothing from behind it. The number is how
# many names it has at most.
MOST_NAMES = {
    "analysis": 13,
    "calibration": 18,
    "camera": 17,
    "campaign": 22,
    "check": 10,
    "commands": 2,
    "display": 9,
    "faults": 13,
    "fleet": 29,
    "flight": 19,
    "link": 18,
    "record": 13,
    "mission": 35,
    "perception": 5,
    "positioning": 10,
    "profile": 41,
    "sim": 14,
    "target": 14,
    "vision": 31,
    "weights": 9,
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


HOLD_STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)


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
        inside_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for child in node.body:
                visit(child, False, at_load)
            for child in node.orelse:
                visit(child, at_run_time, at_load)
            return
        for child in ast.iter_child_nodes(node):
            if isinstance(child, HOLD_STATEMENTS):
                visit(child, at_run_time, at_load and not inside_function)

    visit(ast.parse(source), True, True)
    return found


def _absolute(name: str, node: ast.ImportFrom, is_package: bool) -> str:
    if not node.level:
        return node.module or ""
    parts = name.split(".")
    keep = len(parts) - node.level + (1 if is_package else 0)
    return ".".join(parts[:keep] + ([node.module] if node.module else []))


@cache
def all_imports() -> tuple[Import, ...]:
    """Of the whole project; read when asked for, as each worker loads this module."""
    known = set(MODULES)
    return tuple(
        found
        for name, path in MODULES.items()
        for found in imports_of(
            name, path.read_text(encoding="utf-8"), path.name == "__init__.py", known
        )
    )


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
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_the_walk_sees_the_project() -> None:
    assert {"perchctl.mission.planner", "perchctl.commands.command_line"} <= set(MODULES)
    assert len(all_imports()) > 100


@pytest.mark.parametrize("rule", [misplaced, uphill, past_a_face, clocks, cycle])
def test_a_rule_is_kept(rule: Callable[[list[Import]], list[str]]) -> None:
    """Libraries stay at home, imports point one way and enter by the face, no clock where time is
    an argument, no module needs itself."""
    assert rule(list(all_imports())) == []


def test_each_library_is_used_at_home() -> None:
    used = {i.imported.split(".")[0] for i in all_imports()}
    assert {library for library, homes in HOMES.items() if homes} <= used


@pytest.mark.parametrize("package", MOST_NAMES)
def test_a_face_has_few_names_and_each_says_what_it_is(package: str) -> None:
    face = import_module(f"perchctl.{package}")
    assert 0 < len(face.__all__) <= MOST_NAMES[package]
    for name in face.__all__:
        thing = getattr(face, name)
        if isclass(thing) or isfunction(thing):
            assert thing.__doc__, name


BROKEN = [
    ("mission.planner", "def f():\n    import time\n", clocks, "time"),
    ("vision.merge", "from perchctl.mission import state", uphill, "mission.state"),
    ("geometry", "from .profile import Profile", uphill, "profile"),
    ("sim.world", "from perchctl.record import read", uphill, "record.read"),
    ("link.mock", "from perchctl.sim import world", uphill, "sim.world"),
    (
        "vision.pipeline",
        "import typing\nif typing.TYPE_CHECKING:\n    from perchctl.link.mock import X",
        uphill,
        "link.mock",
    ),
    ("commands.fly", "from perchctl.check.row import Row", past_a_face, "check.row"),
    ("analysis.plot", "import cflib.crazyflie", misplaced, "cflib"),
    ("record.read", "import matplotlib", misplaced, "matplotlib"),
]


@pytest.mark.parametrize(("name", "source", "rule", "named"), BROKEN)
def test_a_broken_rule_is_seen(
    name: str, source: str, rule: Callable[[list[Import]], list[str]], named: str
) -> None:
    (fault,) = rule(imports_of(f"perchctl.{name}", source, False, set(MODULES)))
    assert named in fault


def test_a_cycle_is_seen() -> None:
    pair = ("perchctl.geometry", "perchctl.errors")
    there_and_back = [
        Import(pair[0], pair[1], 1, True, True),
        Import(pair[1], pair[0], 1, True, True),
    ]
    assert set(cycle(there_and_back)) == set(pair)
    assert cycle(there_and_back[:1]) == []


def is_arithmetic(node: ast.expr) -> bool:
    """True for a number, a computation with numbers alone, and a tuple of such."""
    match node:
        case ast.Constant():
            return isinstance(node.value, (int, float))
        case ast.UnaryOp():
            return is_arithmetic(node.operand)
        case ast.BinOp():
            return is_arithmetic(node.left) and is_arithmetic(node.right)
        case ast.Tuple():
            return all(map(is_arithmetic, node.elts))
    return False


def numbers_of(source: str) -> dict[str, str]:
    """The module's constants whose value is arithmetic, with the value as it is written."""
    found = {}
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        pairs = [(target, node.value)]
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            pairs = list(zip(target.elts, node.value.elts, strict=True))
        for name, value in pairs:
            if isinstance(name, ast.Name) and name.id.isupper() and is_arithmetic(value):
                found[name.id] = ast.unparse(value)
    return found


def test_constants_are_found_however_they_are_written() -> None:
    source = "A = -1\n_B_M: float = 3.5 * 1.4\nC, _D = 2.0**3, (1, 2)\nE = A\nf = 1\nG = 'g'\n"
    assert numbers_of(source) == {"A": "-1", "_B_M": "3.5 * 1.4", "C": "2.0 ** 3", "_D": "(1, 2)"}


def test_a_constants_name_has_one_value() -> None:
    """Whoever searches for a name finds one number, and need not ask which of them is meant."""
    values: dict[str, dict[str, str]] = {}
    for path in sorted(ROOT.rglob("*.py")):
        for name, value in numbers_of(path.read_text(encoding="utf-8")).items():
            values.setdefault(name, {})[value] = module_name(path)
    assert len(values) > 500
    assert [f"{name}: {at}" for name, at in values.items() if len(at) > 1] == []


ONE_VALUE_EACH = ("analysis", "commands", "fleet", "positioning")
"""Packages in which also a constant that is no number has a value of its own in the whole code."""


def constants_of(source: str) -> dict[str, str]:
    """The module's constants, private ones too, each with its value as it is written."""
    found = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            for each, value in pairs:
                is_type = ast.unparse(value).startswith(("TypeVar(", "ParamSpec("))
                if isinstance(each, ast.Name) and each.id.isupper() and not is_type:
                    found[each.id] = ast.unparse(value)
    return found


@pytest.mark.parametrize("package", ONE_VALUE_EACH)
def test_a_name_of_these_packages_has_one_value(package: str) -> None:
    values: dict[str, set[str]] = {}
    for path in ROOT.rglob("*.py"):
        for name, value in constants_of(path.read_text(encoding="utf-8")).items():
            values.setdefault(name, set()).add(value)
    own = [constants_of(p.read_text(encoding="utf-8")) for p in (ROOT / package).rglob("*.py")]
    names = {name for each in own for name in each}
    assert len(names) > 10
    assert sorted(name for name in names if len(values[name]) > 1) == []
