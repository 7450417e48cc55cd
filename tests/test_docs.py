"""The pages hold: their command lines and examples run, their links lead somewhere, their tables
are the code's."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl import fly
from perchctl.calibration import MountingRecording, load_calibration
from perchctl.commands import app
from perchctl.commands.command_line import COMMANDS
from perchctl.flight import KEY_HELP, STOP_HELP, fly_lockstep
from perchctl.geometry import GRAVITY_MPS2
from perchctl.profile import Profile
from perchctl.profile.keys import keys
from tests.helpers import log as made_up_log
from tests.helpers.boards import CHARUCO, render_folder
from tests.helpers.decided import decided_here
from tests.helpers.flights import ROOT, SEED, SHORT, short_profile
from tests.helpers.gear import write_turned_about
from tests.helpers.mounting import hand, seen
from tests.helpers.recording import make_recording
from tests.helpers.weights_data import known
from tests.helpers.weights_data import write as write_session

DOCS = ROOT / "docs"
GITHUB = ROOT / ".github"
PAGES = (ROOT / "README.md", *sorted(ROOT.glob("[CS]*.md")), *sorted(DOCS.glob("*.md")))
TEXT = {path: path.read_text(encoding="utf-8") for path in PAGES}
EACH_PAGE = pytest.mark.parametrize("path", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
README = TEXT[ROOT / "README.md"]

MOST_LINES = 90

ATRIUM = """name: atrium
vehicles:
  - {name: north, home_m: [0, 0], target_m: [0.2, 0.1]}
  - {name: east, home_m: [2.4, 0], target_m: [2.2, 0]}
"""
CRAZYFLIES = """robots:
  cf1: {enabled: true, uri: radio://0/80/2M/E7E7E7E701, initial_position: [0.0, 0.0, 0.0]}
"""
CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  intrinsics: [400.5, 401.5, 320.25, 240.75]
  resolution: [640, 480]
"""
QUICK = f"""extends: {SHORT}
planner: {{perching_time_s: 0.3}}
"""
"""A flight that lands again before it has left the floor; whole ones are flown in tests/flight."""
TOOLS = ("pytest", "env $(python ", "ruff ", "mypy", "sphinx-build ")
"""`.ci/run` runs these; a test does not run the tests."""
AIDECK = "aideck://192.168.4.1"
WITHOUT_A_CAMERA = {
    "camera:0": "video:flight.mp4",
    AIDECK: "video:flight.mp4",
    "calib/aideck_324x244.yaml": "camera.yaml",
}
DASK = {"scheduler": "dask_scheduler", "worker": "dask_worker", "ssh": "dask_ssh"}
SET_UP = ("python3 -m venv ", ". .venv/", "pip install ", "git clone ", "cd ")


# --- command lines --------------------------------------------------------------------


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def command_lines() -> list[str]:
    """Every command of every page, once: indented ones, and those of the fenced blocks."""
    found: set[str] = set()
    for page in TEXT.values():
        found |= {s.strip() for s in re.findall(r"^ {4,}perchctl .*$", page, re.MULTILINE)}
        for block in blocks(page, "sh"):
            for chain in block.splitlines():
                found |= {part.strip() for part in chain.split("&&")}
    return sorted(line for line in found if line and not line.startswith(SET_UP))


def cheap(line: str) -> list[str]:
    """The same command, kept from arming anything and from working for minutes."""
    words = shlex.split(line)
    match words[:2]:
        case ["perchctl", "fly" | "hover"] if "--dry-run" not in words:
            words.append("--dry-run")
        case ["perchctl", "fleet"] if "fly" in words and "--dry-run" not in words:
            words.append("--dry-run")
        case ["perchctl", "log"] if "--set" in words:  # that something differs is the answer
            words.append("--help")
        case ["perchctl", "log"] if "fleet_" in line:  # test_log_command.py has such a folder
            words.append("--help")
        case ["perchctl", "check"]:  # its verdict is this computer's; tests/check has it
            words.append("--help")
        case ["perchctl", "profile"] if words[2] == "new":  # without a dialogue, over what is there
            words += ["--defaults", "--force"]
        case ["perchctl", "simulate"] if sum("=" in word for word in words) > 1:
            words.append("--help")  # many flights
        case ["perchctl", "simulate"]:
            if "--cluster" in words:
                at = words.index("--cluster")
                words[at : at + 2] = []
            if words[2] == "compare":
                words[3:5] = ["quick.yaml", "quick.yaml"]
            else:
                words += ["-p", "quick.yaml"]
            if "-n" in words:
                words[words.index("-n") + 1] = "1"
        case ["perchctl", "fleet"] if words[2:3] == ["simulate"]:
            words.append("--help")  # many flights; tests/fleet has a few
        case ["perchctl", "fit-weights"] if "collect" in words:
            words += ["--positions", "3", "--frames", "10"]
        case ["perchctl", "calibrate"] if words[2] == "mount":  # without a vehicle in a hand
            words = [*words[:3], "-p", "my_vehicle.yaml", "--from", "hand.jsonl"]
        case ["perchctl", "log"] if "replay" not in words:
            words = ["short.jsonl" if word.endswith(".jsonl") else word for word in words]
        case ["perchctl", "track"]:  # without a camera
            words = [WITHOUT_A_CAMERA.get(word, word) for word in words]
            words = ["video:flight.mp4" if w.startswith("camera:") else w for w in words]
        case ["perchctl", "calibrate"] if words[2].startswith("camera:"):
            words.append("--help")
        case ["perchctl", "calibrate"]:
            words = ["images:board" if w in (AIDECK, "images:new") else w for w in words]
        case ["python", "docs/tables.py"]:
            words.append("--check")
        case ["python", "docs/pictures/make.py"]:
            words += ["--into", ".", "--log", "short.jsonl"]
            words += ["--only", "flight.png", "panel.svg"]
        case ["python", script] if script.startswith("benchmarks/"):
            words.append("--help")
    return words


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands name: pictures, a video and its calibration, profiles, and
    the made-up log of a flight."""
    folder = tmp_path_factory.mktemp("place")
    make_recording(folder)
    render_folder(folder / "board", load_calibration(folder / "camera.yaml"), CHARUCO, 8, seed=1)
    write_turned_about(folder / "turned")
    MountingRecording.write(folder / "hand.jsonl", [seen(hand("pivot"))])
    write_session(known(positions=4, per=20), folder / "session.csv")
    (folder / "camchain.yaml").write_text(CAMCHAIN, encoding="utf-8")
    (folder / "atrium.yaml").write_text(ATRIUM, encoding="utf-8")
    (folder / "crazyflies.yaml").write_text(CRAZYFLIES, encoding="utf-8")
    made_up_log.write(folder / "short.jsonl", summary=made_up_log.SUMMARY)
    (folder / "last.jsonl").write_bytes(b"".join(decided_here("searched-out")))
    (folder / "quick.yaml").write_text(QUICK, encoding="utf-8")
    for name in ("my_vehicle", "north", "east", "large"):
        shutil.copyfile(ROOT / "profiles" / "crazyflie.yaml", folder / f"{name}.yaml")
    return folder


@pytest.fixture(scope="module")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a whole flight."""
    path = tmp_path_factory.mktemp("flown") / "short.jsonl"
    fly_lockstep(short_profile(), SEED, path)
    return path


def run_python(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """`python SCRIPT ...` or `python -m MODULE ...`, in this process."""
    script = ROOT / words[1]
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])
    monkeypatch.setattr(sys, "argv", words[1:])
    code: Any = 0
    try:
        if words[1] == "-m":
            for name in (words[2], f"{words[2]}.__main__"):
                monkeypatch.delitem(sys.modules, name, raising=False)
            runpy.run_module(words[2], run_name="__main__")
        else:
            runpy.run_path(str(script), run_name="__main__")
    except SystemExit as end:
        code = end.code
    finally:
        sys.modules.pop("common", None)  # of benchmarks/
    assert not code


ONCE = {tuple(cheap(line)): line for line in command_lines() if not line.startswith(TOOLS)}
"""Lines that come to the same command are run once."""
LONG = (
    "dask ",
    "perchctl log plot",
    "perchctl log compare",
    "perchctl log export",
    "perchctl log film",
    "perchctl log report",
    "perchctl simulate",
    "perchctl calibrate aideck:",
    "perchctl calibrate check",
    "perchctl calibrate images:",
    "perchctl fit-weights collect",
    "perchctl make-target design",
    "python docs/pictures/make.py",
)


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[pytest.mark.long] * line.startswith(LONG))
        for line in ONCE.values()
    ],
)
def test_every_command_line_runs(
    line: str,
    tmp_path: Path,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> None:
    words = cheap(line)
    if "mocap" in words:
        pytest.importorskip("motioncapture", reason="motion capture needs the extra [mocap]")
    shutil.copytree(place, tmp_path, dirs_exist_ok=True)
    if "collect" in words:
        (tmp_path / "session.csv").unlink()
    if line.startswith(LONG) and "short.jsonl" in words:
        shutil.copyfile(request.getfixturevalue("short_log"), tmp_path / "short.jsonl")
    if words[:2] == ["perchctl", "log"]:
        log = tmp_path / "perchctl-logs" / "flight_short.jsonl"
        log.parent.mkdir()
        shutil.copyfile(tmp_path / "short.jsonl", log)
    before = set(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    if "--cluster" in words:
        pytest.importorskip("distributed", reason="clusters need the extra [cluster]")
    if words[0] == "dask":  # of another program the options are looked at
        module = f"distributed.cli.{DASK[words[1]]}"
        command = pytest.importorskip(module, reason="clusters need the extra [cluster]").main
        said = str(command.make_context(words[1], words[2:]).params)
    elif words[0] == "python":
        run_python(words, monkeypatch)
        said = capsys.readouterr().out
    else:
        result = CliRunner().invoke(app, words[1:])
        assert result.exit_code == 0, result.output
        said = result.stdout + "".join(re.findall(r"http://127\.0\.0\.1:\d+", result.stderr))
    assert said.strip() or set(tmp_path.rglob("*")) > before or "--check" in words


# --- examples -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def notebook(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all examples: the last reads what the one before it has flown."""
    return Path(shutil.copytree(place, tmp_path_factory.mktemp("notebook") / "place"))


EXAMPLES = blocks(TEXT[DOCS / "python.md"], "python")


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(number, marks=[pytest.mark.long] * ("fly_lockstep" in text))
        for number, text in enumerate(EXAMPLES)
    ],
)
def test_every_example_runs(
    number: int, notebook: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = EXAMPLES[number]
    assert len(source.strip().splitlines()) <= 10
    assert "pandas" not in source, "the README's installation has none"
    monkeypatch.chdir(notebook)
    quick = source.replace('load_profile("sim"), seed', 'load_profile("quick.yaml"), seed')
    exec(compile(quick, f"docs/python.md, example {number + 1}", "exec"), {})
    assert capsys.readouterr().out.strip()


def test_every_public_name_is_explained() -> None:
    import perchctl

    page = TEXT[DOCS / "python.md"]
    for name in getattr(perchctl, "__all__", ()):
        assert name.startswith("__") or f"- `{name}" in page, name


# --- tables ---------------------------------------------------------------------------


@cache
def tables() -> dict[str, Any]:
    return runpy.run_path(str(DOCS / "tables.py"))


@EACH_PAGE
def test_tables_are_the_code_s(path: Path) -> None:
    """`python docs/tables.py` writes them."""
    assert tables()["filled"](TEXT[path]) == TEXT[path]


def test_every_table_is_on_a_page_and_every_key_has_its_meaning() -> None:
    everything = "".join(TEXT.values())
    assert [n for n in tables()["PARTS"] if f"<!-- begin {n} -->" not in everything] == []
    assert [key.path for key in keys(Profile()) if not key.meaning] == []


@pytest.mark.parametrize(
    "script", re.findall(r"^- \*\*`(\w+\.py)`\*\*", TEXT[DOCS / "benchmarks.md"], re.MULTILINE)
)
def test_every_benchmark_on_its_page_runs(script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run_python(["python", f"benchmarks/{script}", "--help"], monkeypatch)


def test_every_shipped_profile_is_described() -> None:
    for path in (ROOT / "profiles").glob("*.yaml"):
        assert f"| `{path.stem}` |" in TEXT[DOCS / "profiles.md"]


def test_every_command_is_on_its_page() -> None:
    for name in COMMANDS:
        assert f"| `perchctl {name}` |" in TEXT[DOCS / "commands.md"]


def test_every_room_is_described() -> None:
    page = TEXT[DOCS / "architecture.md"]
    for path in sorted((ROOT / "perchctl").iterdir()):
        holds = [f for f in path.rglob("*.py") if f.name != "__init__.py"]
        if (holds or path.suffix == ".py") and path.name != "__main__.py":
            names = (path.name, path.stem)
            assert any(f"- `perchctl/{name}`: " in page for name in names), path.name


# --- what the pages name --------------------------------------------------------------

LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")


def slug(heading: str) -> str:
    """A heading's anchor, as GitHub makes it."""
    plain = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return plain.replace(" ", "-")


def headings(page: str) -> list[str]:
    return re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", page, flags=re.M | re.S), re.M)


def source_of(path: Path) -> str:
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return "\n".join(file.read_text(encoding="utf-8") for file in files)


def broken_links(path: Path, page: str) -> list[str]:
    """Links that lead nowhere; and those to code that no longer holds what they name."""
    broken = []
    for text, goal in LINK.findall(page):
        if re.match(r"https?://", goal):
            continue
        file, _, anchor = goal.partition("#")
        there = (path.parent / file).resolve() if file else path
        if not there.exists():
            broken.append(f"{goal} does not exist")
        elif anchor and anchor not in map(slug, headings(there.read_text(encoding="utf-8"))):
            broken.append(f"{goal}: no such heading")
        elif there.suffix == ".py" or (there.is_dir() and ROOT / "perchctl" in there.parents):
            names = [n for n in re.findall(r"`([^`]+)`", text) if re.fullmatch(r"[\w-]+", n)]
            broken += [f"{goal} has no {n}" for n in names if n not in source_of(there)]
    return broken


@EACH_PAGE
def test_links_lead_somewhere(path: Path) -> None:
    assert broken_links(path, TEXT[path]) == []


def test_every_page_is_in_the_index() -> None:
    """What comes from the repository's root, the site alone has as a page."""
    for path in DOCS.glob("*.md"):
        from_the_root = path.name in ("README.md", "index.md", "contributing.md")
        assert from_the_root or f"]({path.name})" in TEXT[DOCS / "README.md"]


@EACH_PAGE
def test_named_keys_are_the_schema_s(path: Path) -> None:
    if path.name == "CHANGELOG.md":
        return  # it names what is no more
    paths = {key.path for key in keys(Profile())}
    sections = {".".join(p.split(".")[:n]) for p in paths for n in range(1, p.count(".") + 1)}
    others = {"planner.py", "log.column", "pose.py"}
    for name in re.findall(r"`([a-z]+(?:\.[a-z_0-9]+)+)(?:: [\w-]+)?`", TEXT[path]):
        if name.split(".")[0] in Profile.model_fields and name not in others:
            assert name in paths | sections, name


@pytest.mark.parametrize(
    "where", ["README.md", "docs/safety.md", "docs/first-perch.md", "perchctl/display/common.js"]
)
def test_the_operator_s_stop_is_described_in_the_same_words(where: str) -> None:
    """Nobody is to work out, beside a vehicle that flies, whether two sentences mean the same."""
    assert STOP_HELP in words_of((ROOT / where).read_text(encoding="utf-8"))


def test_help_describes_the_operator_s_stop_in_the_same_words() -> None:
    told = CliRunner().invoke(app, ["fly", "--help"], env={"COLUMNS": "80"}).stdout
    assert f"{STOP_HELP} {KEY_HELP}" in words_of(told)
    assert STOP_HELP in words_of(fly.__doc__ or "")


def words_of(text: str) -> str:
    """The text with one space between two words, wherever its lines end."""
    return " ".join(text.split())


def test_faults_have_their_numbers() -> None:
    rows = re.findall(r"^(\d+)\. .*: ", TEXT[DOCS / "faults.md"], re.MULTILINE)
    assert [int(number) for number in rows] == list(range(1, 47))


def test_what_code_cites_is_there() -> None:
    """``docs/firmware.md, "Silence"`` names a heading, ``fault 33`` a fault."""
    for folder in ("perchctl", "tests", "benchmarks"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            if file == Path(__file__):
                continue
            source = re.sub(r"\s+(?:# )?", " ", file.read_text(encoding="utf-8"))
            for page, name in re.findall(r'docs/(\w+\.md), "([^"]+)"', source):
                assert name in headings(TEXT[DOCS / page]), f"{file}: {page}, {name}"
            for number in re.findall(r"\bfault (\d+)", source):
                assert 1 <= int(number) <= 46, file


# --- form -----------------------------------------------------------------------------


def test_the_readme_is_short_and_set_up_is_two_commands() -> None:
    """`.ci/run` takes them from here."""
    assert len(README.splitlines()) <= MOST_LINES
    found = blocks(README, "sh")
    assert [len(block.strip().splitlines()) for block in found] == [1, 1]
    assert found[0].strip().endswith("perchctl fly")
    assert found[1].strip().endswith("pytest")


MOST_G = 42.0
"""The heaviest vehicle that docs/hardware.md allows."""
PLA_G_PER_MM3 = 1.24e-3


def vehicles_to_buy() -> list[tuple[list[float], float]]:
    """Of each vehicle of the page, the masses of its parts and their sum, as the page has it."""
    found = []
    for table in re.findall(r"((?:^\|.*\n)+)", TEXT[DOCS / "parts.md"], re.MULTILINE):
        lines = [line.strip("| \n").split(" | ") for line in table.splitlines()]
        if lines[0][-1] == "mass [g]":
            masses = [float(re.findall(r"[\d.]+", line[-1])[0]) for line in lines[2:]]
            found.append((masses[:-1], masses[-1]))
    return found


def test_the_vehicles_to_buy_add_up_and_can_be_flown() -> None:
    assert f"at most {MOST_G:g} g" in TEXT[DOCS / "hardware.md"]
    assert len(vehicles_to_buy()) == 2
    page = TEXT[DOCS / "parts.md"]
    for masses, total in vehicles_to_buy():
        assert sum(masses) == pytest.approx(total)
        assert total <= MOST_G
        assert f"These parts leave {MOST_G - total:.1f} g" in page
        share = total / 1e3 * GRAVITY_MPS2 / 0.48
        assert f"{100 * share:.0f} % of the full thrust" in page


def test_the_printed_gear_weighs_what_its_page_says(tmp_path: Path) -> None:
    openscad = shutil.which("openscad")
    if openscad is None:
        pytest.skip("needs OpenSCAD")
    made = tmp_path / "gear.stl"
    subprocess.run([openscad, "-o", made, DOCS / "gear.scad"], check=True, capture_output=True)
    numbers = re.findall(r"vertex (\S+) (\S+) (\S+)", made.read_text(encoding="utf-8"))
    corners = np.array(numbers, float).reshape(-1, 3, 3)
    volume_mm3 = np.linalg.det(corners).sum() / 6.0
    assert {masses[3] for masses, _ in vehicles_to_buy()} == {round(volume_mm3 * PLA_G_PER_MM3, 1)}
    height_mm = float(re.findall(r"^height = (\d+);", (DOCS / "gear.scad").read_text(), re.M)[0])
    assert corners[..., 2].max() < height_mm, "the magnet is the highest point"


def test_the_workflow_has_every_python_version_of_its_page() -> None:
    jobs = yaml.safe_load((GITHUB / "workflows" / "ci.yml").read_text(encoding="utf-8"))["jobs"]
    setups = [s for job in jobs.values() for s in job["steps"] if "setup-python" in str(s)]
    tested = {s["with"]["python-version"] for s in setups}
    tested |= set(jobs["test"]["strategy"]["matrix"]["python"])
    page = TEXT[DOCS / "platforms.md"].partition("## Python versions")[2]
    assert set(re.findall(r"3\.\d+", page)) == {v for v in tested if v[0].isdigit()}
    least = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert least["requires-python"] == f">={min(re.findall(r'3[.][0-9]+', page))}"
    assert "--resolution lowest-direct" in str(jobs["lowest"])
    assert "--cov=perchctl" in str(jobs["coverage"])


def test_the_issue_form_asks_for_the_log_and_the_check() -> None:
    text = (GITHUB / "ISSUE_TEMPLATE" / "problem.yml").read_text(encoding="utf-8")
    asked = {field["id"]: str(field["attributes"]) for field in yaml.safe_load(text)["body"]}
    assert "perchctl check --json" in asked["check"]
    assert ".jsonl" in asked["log"]
    assert "perchctl --version" in asked["version"]


def test_pictures_are_made_by_the_command_and_shown() -> None:
    files = [p for p in (DOCS / "pictures").iterdir() if p.suffix in (".png", ".svg", ".gif")]
    made = runpy.run_path(str(DOCS / "pictures" / "make.py"))["PICTURES"]
    assert {p.name for p in files} == set(made)
    everything = "".join(TEXT.values())
    assert [p.name for p in files if f"pictures/{p.name})" not in everything] == []
