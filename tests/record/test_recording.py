"""What a recording holds: pictures to the bit, Foxglove's own messages, where everything is."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from perchctl.errors import InvalidValue, NotFound
from perchctl.geometry import make_T, rot_z, rotation_from_rpy
from perchctl.record import recorded_pictures
from tests.helpers import recorded
from tests.helpers.flights import ROOT

FLIGHT = recorded.flown(120)
STARTED = datetime(2024, 5, 17, 12, 30, 15, tzinfo=UTC)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "flight.mcap"
    recorder = recorded.recorder(path, started=STARTED, t0_s=1.0)
    recorded.fly(recorder, FLIGHT)
    end = recorder.close()
    assert end[1:] == (len(FLIGHT.frames), 0, None)
    return path


@pytest.fixture(scope="module")
def found(recording: Path) -> dict[str, list[Any]]:
    return recorded.messages(recording)


def test_each_picture_is_the_pipeline_s_to_the_bit(recording: Path) -> None:
    found = list(recorded_pictures(recording))
    assert [(p.number, p.t_s) for p in found] == [(f.index, f.t_s) for f in FLIGHT.frames]
    for got, frame in zip(found, FLIGHT.frames, strict=True):
        assert got.image.dtype == np.uint8
        np.testing.assert_array_equal(got.image, frame.image)
    some = recorded_pictures(recording.with_suffix(".jsonl"), numbers={3, 40})
    assert [picture.number for picture in some] == [3, 40]  # by the log's name, and no others
    stored = recorded.messages(recording)["/camera/image"]
    assert [image.format for image in stored[:4]] == ["jpeg", "png", "jpeg", "png"]
    assert stored[0].data == FLIGHT.frames[0].source_jpeg  # a JPEG lies there as it came


def test_no_recording_and_none_of_ours(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="does not exist"):
        next(recorded_pictures(tmp_path / "flight.jsonl"))
    (tmp_path / "flight.mcap").write_bytes(b"GIF89a and more")
    with pytest.raises(InvalidValue, match="not a recording"):
        next(recorded_pictures(tmp_path / "flight.jsonl"))


FOXGLOVE_S = {
    "/camera/image": "CompressedImage",
    "/camera/corners": "ImageAnnotations",
    "/tf": "FrameTransforms",
}


def test_readers_find_it_whole_by_its_index_and_foxgloves_own_schemas(
    recording: Path, found: dict[str, list[Any]]
) -> None:
    with recording.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counted = summary.statistics.channel_message_counts
    schemas = {}
    for number, channel in summary.channels.items():
        schema = summary.schemas[channel.schema_id]
        schemas[channel.topic] = (schema.encoding, schema.name)
        assert counted[number] == len(found[channel.topic])
    own = {
        "/tick": ("jsonschema", "perchctl.Tick"),
        "/camera/frame": ("jsonschema", "perchctl.Frame"),
    }
    theirs = {topic: ("protobuf", f"foxglove.{name}") for topic, name in FOXGLOVE_S.items()}
    assert schemas == own | theirs
    page = (ROOT / "docs" / "after-a-flight.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(/[\w/]+)` \| (\w+), `([\w.]+)` \|", page, re.MULTILINE)
    encodings = {"JSON": "jsonschema", "protobuf": "protobuf"}
    assert {topic: (encodings[form], name) for topic, form, name in rows} == schemas
    assert len(found["/camera/image"]) == len(found["/camera/frame"]) == len(FLIGHT.frames)
    assert len(found["/tick"]) == len(found["/tf"]) == len(FLIGHT.ticks)


def test_foxglove_s_layout_shows_what_a_recording_holds(found: dict[str, list[Any]]) -> None:
    panels = json.loads((ROOT / "docs" / "foxglove.json").read_text())["configById"]
    image = panels["Image!picture"]["imageMode"]
    assert {image["imageTopic"], *image["annotations"]} <= found.keys()
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert len(paths) > 5
    for topic, _, field in (path.partition(".") for path in paths):
        assert any(json.loads(message).get(field) is not None for message in found[topic]), field
    grid = panels["3D!space"]
    frames = {t.parent_frame_id for message in found["/tf"] for t in message.transforms}
    assert {grid["followTf"], grid["layers"]["grid"]["frameId"]} <= frames


def test_people_s_times_count_from_the_first_flown_turn_and_messages_by_the_wall(
    found: dict[str, list[Any]],
) -> None:
    """The body is where it was when that was measured."""
    assert json.loads(found["/tick"][0])["t_s"] == 0.0
    tick, moved = FLIGHT.ticks[50], {t.child_frame_id: t for t in found["/tf"][50].transforms}
    for name, age_s in (("gear", 0.0), ("body", tick["tel_age_s"])):
        at = moved[name].timestamp
        since_s = at.seconds - STARTED.timestamp() + 1e-9 * at.nanos
        assert since_s == pytest.approx(tick["t_s"] - 1.0 - age_s, abs=1e-8)


def test_the_transforms_lead_from_the_world_to_camera_gear_and_target(
    found: dict[str, list[Any]],
) -> None:
    said = found["/tf"]
    mount = recorded.PROFILE.camera.mount.T_body_cam
    for n in (0, 60, len(FLIGHT.ticks) - 1):
        tick, T = FLIGHT.ticks[n], recorded.transforms(said[n])
        R = rotation_from_rpy(tick["roll_rad"], tick["pitch_rad"], tick["yaw_rad"])
        T_world_body = make_T(R, (tick["x_m"], tick["y_m"], tick["z_m"]))
        np.testing.assert_allclose(T["world body"], T_world_body, atol=1e-12)
        np.testing.assert_allclose(T["body camera"], mount, atol=1e-12)
        gear = T["body gear"]
        np.testing.assert_allclose(gear[:3, 3], recorded.PROFILE.vehicle.gear_body_m)
    tick = FLIGHT.ticks[-1]
    T_world_target = make_T(rot_z(tick["tyaw_rad"]), (tick["tx_m"], tick["ty_m"], tick["tz_m"]))
    np.testing.assert_allclose(T["world target"], T_world_target, atol=1e-12)
    place = (tick["cmd_x_m"], tick["cmd_y_m"], tick["cmd_z_m"])
    np.testing.assert_allclose(T["world setpoint"], make_T(rot_z(tick["cmd_yaw_rad"]), place))


def test_values_that_are_no_numbers_make_no_transform(tmp_path: Path) -> None:
    recorder = recorded.recorder(tmp_path / "f.mcap")
    recorder.write_tick({**FLIGHT.ticks[0], "x_m": float("nan"), "cmd_z_m": float("inf")})
    recorder.close()
    (said,) = recorded.messages(tmp_path / "f.mcap")["/tf"]
    assert set(recorded.transforms(said)) == {"body camera", "body gear"}


def test_corners_are_shown(found: dict[str, list[Any]]) -> None:
    tick = next(tick for tick in FLIGHT.ticks if tick["large_px"] is not None)
    outline = next(message for message in found["/camera/corners"] if message.points).points[0]
    assert [v for p in outline.points for v in (p.x, p.y)] == tick["large_px"]
