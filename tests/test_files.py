"""Whole files: several or none, what may be replaced, what is kept, one sentence each."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.errors import InvalidValue, NotFound
from perchctl.files import PartFile, check_place, same_file, write_files
from tests.helpers.disk import full_disk


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("mine")
    with pytest.raises(InvalidValue, match="exists already; add --force"):
        check_place(path, replace=False)
    check_place(path)
    with pytest.raises(InvalidValue, match="is a folder"):
        check_place(tmp_path)


def test_a_missing_folder_is_named_or_made(tmp_path: Path) -> None:
    path = tmp_path / "made" / "new" / "a.txt"
    with pytest.raises(NotFound, match=r"new for a\.txt does not exist"):
        write_files({path: b"a"})
    assert names(tmp_path) == []
    check_place(path, make_folders=True)
    assert names(tmp_path) == []
    assert write_files({path: b"a"}, make_folders=True) == {}
    assert path.read_bytes() == b"a"


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    old, large = tmp_path / "camera.yaml", tmp_path / "made" / "deep" / "report.png"
    old.write_text("old")
    files = {old: b"new", large: bytes(400_000)}
    sentence = r"report\.png cannot be written: .*nothing was changed"
    with full_disk(room=200_000), pytest.raises(InvalidValue, match=sentence):
        write_files(files, make_folders=True, keep_old=True)
    assert old.read_text() == "old"
    assert names(tmp_path) == ["camera.yaml"]
    write_files(files, make_folders=True)
    assert old.read_bytes() == b"new"
    assert large.stat().st_size == 400_000
    assert names(tmp_path) == ["camera.yaml", "made"]
    assert names(large.parent) == ["report.png"]


def test_a_folder_in_a_file_s_place_leaves_the_others_alone(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(InvalidValue, match="b is a folder"):
        write_files({tmp_path / "a": b"a", tmp_path / "b": b"b"}, keep_old=True)
    assert names(tmp_path) == ["b"]


def test_the_old_file_is_kept_aside(tmp_path: Path) -> None:
    path = tmp_path / "w.yaml"
    assert write_files({path: b"1"}, keep_old=True) == {}
    assert write_files({path: b"2"}, keep_old=True) == {path: tmp_path / "w.yaml.bak1"}
    assert write_files({path: b"3"}, keep_old=True) == {path: tmp_path / "w.yaml.bak2"}
    read = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    assert read == {"w.yaml": b"3", "w.yaml.bak1": b"1", "w.yaml.bak2": b"2"}


def test_a_part_is_hidden_beside_its_place_until_it_is_kept(tmp_path: Path) -> None:
    file = PartFile(tmp_path / "film.mp4")
    file.drop()  # nothing there yet
    file.write(b"film")
    assert file.part.parent == tmp_path
    assert file.part.name.startswith(".film.")
    assert file.part.suffix == ".mp4"
    assert not file.path.exists()
    file.keep()
    assert names(tmp_path) == ["film.mp4"]
    dropped = PartFile(file.path)
    dropped.write(b"other")
    dropped.drop()
    assert file.path.read_bytes() == b"film"
    assert names(tmp_path) == ["film.mp4"]


def test_one_file_by_two_names(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "b"
    path.write_text("a")
    assert not same_file(path, link)
    link.symlink_to(path)
    assert same_file(path, link)
