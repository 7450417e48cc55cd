"""Whole files: several or none, what may be replaced, what is kept, one sentence each."""

from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

import pytest

from perchctl.errors import InvalidValue
from perchctl.files import (
    atomic_write,
    check_output,
    check_writable,
    file_kind,
    file_mode,
    write_files,
)
from tests.helpers.commands import run
from tests.helpers.disk import full_disk
from tests.helpers.flights import ROOT


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_stands_in_the_way_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("mine")
    check_writable(path, force=True)
    check_output(tmp_path / "a.YML", (".yaml", ".yml"), force=False)
    monkeypatch.setattr("os.access", lambda place, mode: Path(place) != tmp_path)
    for place, force, said in (
        (path, False, "already exists; add --force"),
        (tmp_path, True, "is a folder"),
        (path / "new" / "b.txt", True, r"camera\.yaml is a file, not a folder"),
        (tmp_path / "new" / "a.txt", True, rf"no permission to write in {tmp_path}$"),
    ):
        with pytest.raises(InvalidValue, match=said):
            check_writable(place, force)
    with pytest.raises(InvalidValue, match=r"must end in \.yaml or \.yml, found .*a\.png"):
        check_output(tmp_path / "a.png", (".yaml", ".yml"), force=True, content="text")


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    old, large = tmp_path / "camera.yaml", tmp_path / "made" / "deep" / "report.png"
    old.write_text("old")
    files = {old: b"new", large: bytes(400_000)}
    sentence = r"report\.png cannot be written: File too large"
    with full_disk(room=200_000), pytest.raises(InvalidValue, match=sentence):
        write_files(files)
    assert old.read_text() == "old"
    assert names(tmp_path) == ["camera.yaml"]
    write_files(files)
    assert old.read_bytes() == b"new"
    assert large.stat().st_size == 400_000
    assert names(tmp_path) == ["camera.yaml", "made"]
    assert names(large.parent) == ["report.png"]


def test_a_file_is_hidden_beside_its_place_until_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    with atomic_write(path) as part:
        part.write_bytes(b"film")
        assert part.parent == tmp_path
        assert (part.name[:6], part.suffix) == (".film.", ".mp4")
        assert not path.exists()
    assert names(tmp_path) == ["film.mp4"]
    for place in (path, tmp_path / "made" / "new" / "film.mp4"):
        with pytest.raises(FileNotFoundError), atomic_write(place) as part:
            raise FileNotFoundError(part.write_bytes(b"other"))
    assert path.read_bytes() == b"film"
    assert names(tmp_path) == ["film.mp4"]


def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path: Path) -> None:
    """And those of a new one may be asked for."""
    old, new, plain = tmp_path / "old", tmp_path / "new", tmp_path / "plain"
    for mode in (0o600, 0o440, 0o664):
        old.write_bytes(b"old")
        old.chmod(mode)
        new.unlink(missing_ok=True)
        write_files({old: b"mine", new: b"copy"}, mode=0o640)
        assert (file_mode(old), file_mode(new)) == (mode, 0o640)
        assert old.read_bytes() == b"mine"
        old.chmod(0o600)
    write_files({plain: b"new"})
    (tmp_path / "by_system").touch()
    assert file_mode(plain) == file_mode(tmp_path / "by_system")


def test_what_is_not_for_all_is_for_nobody_else_before_it_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, sync, modes = tmp_path / "mine", os.fsync, set()
    path.touch(mode=0o664)

    def seen(fd: int) -> None:
        modes.add(stat.S_IMODE(os.fstat(fd).st_mode))
        sync(fd)

    monkeypatch.setattr("os.fsync", seen)
    write_files({path: b"mine"})
    assert modes == {0o600}


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"\x89PNG\r\n", "a picture"),
        (b"\x00\x00\x00\x18ftypmp42", "a video"),
        (b"%PDF-1.7", "a PDF"),
        (b"image_width: 640\ncamera_matrix: {}\n", "a camera calibration"),
        (b"# mine\nextends: sim\n", "a profile"),
        (b"name: four\nvehicles:\n", "a fleet file"),
        (b'{"kind":"header","format":"perchctl-flight-log","version":3}\n', "a flight log"),
        (b"\x89MCAP0\r\n\x01\x12" + bytes(11) + b"\x0a\0\0\0perchctl 1", "a recording"),
        (b"\x89MCAP0\r\n\x01\x15" + bytes(7) + b"\x04\0\0\0ros2", "a ROS bag"),
        (b"\x89MCAP0\r\n", "a recording"),
        (b"#ROSBAG V2.0\n", "a ROS bag"),
        (b"rosbag2_bagfile_information:\n  version: 9\n", "a ROS bag"),
        (b"SQLite format 3\0", "an SQLite database, as in a ROS bag"),
        (b'{"part":"carry","mirrored_pictures":0}\n', "a recording from calibrate mount"),
        (b'{\n "width": 640}', "a JSON file"),
        (b"{extends: sim}", "another kind of file"),
        (b"", "another kind of file"),
    ],
)
def test_a_file_is_named_by_its_content(content: bytes, kind: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(content)
    assert file_kind(file) == kind
    assert file_kind(tmp_path) == file_kind(tmp_path / "none") == "another kind of file"


def test_a_folder_is_only_named_if_it_is_a_bag(tmp_path: Path) -> None:
    metadata = tmp_path / "metadata.yaml"
    for text, kind in (
        ("extends: sim\n", "another kind of file"),
        ("rosbag2_bagfile_information:\n  version: 9\n", "a ROS bag"),
    ):
        metadata.write_text(text)
        assert file_kind(tmp_path) == kind


def test_a_pipe_keeps_its_data(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with open(os.open(pipe, os.O_RDWR), "r+b", buffering=0) as stream:
        stream.write(b"%PDF-1.7")
        os.set_blocking(stream.fileno(), False)
        assert file_kind(pipe) == "another kind of file"
        assert stream.read(100) == b"%PDF-1.7"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("fly", "--dry-run", "-p", "cal.yaml"), "cal.yaml is a camera calibration, not a profile"),
        (
            ("track", "pic.png", "--calibration", "pic.png"),
            "is a picture, not a camera calibration",
        ),
        (("track", "pic.png", "--calibration", "mine.yaml"), "(it is a profile)"),
        (("log", "show", "cal.yaml"), "is a camera calibration"),
        (("fly", "--dry-run", "-p", "mine.yaml"), "did you mean planner?"),
    ],
)
def test_a_file_of_the_wrong_kind_is_named_as_what_it_is(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(ROOT / "calib" / "example_640x480.yaml", "cal.yaml")
    shutil.copyfile(ROOT / "docs" / "pictures" / "target.png", "pic.png")
    Path("mine.yaml").write_text("extends: sim\nplaner: {attempts: 3}\n")
    result = run(*words)
    assert result.code == 30
    assert said in result.stderr
