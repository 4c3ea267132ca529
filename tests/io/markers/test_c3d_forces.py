"""Events, force plates and analog channels of a C3D."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.markers.c3d import write_c3d
from marey.io.markers.c3d_forces import plate_frames, read_events, read_force_plates
from marey.io.opensim.trc import PointPaths
from marey.motion.events.cycles import OFF, STRIKE, GaitEvent

CORNERS_MM = np.array([[400.0, 600, 0], [400, 0, 0], [0, 0, 0], [0, 600, 0]])  # x' = y, y' = x, z' = -z


def c3d_with_a_plate(path: Path, kind: int = 2) -> Path:
    """700 N up, 100 mm along the laboratory's x from the centre of the plate, sensors 40 mm below its surface."""
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    c3d["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    c3d["data"]["points"] = np.ones((4, 1, 10))
    on_plate = np.array([0.0, 20.0, 700.0])  # force of the person on the plate, in the plate's axes (Z down)
    at = np.array([0.0, 100.0, -40.0])  # from the sensors [mm]
    channels = np.concatenate([on_plate, np.cross(at, on_plate)])
    c3d["parameters"]["ANALOG"]["RATE"]["value"] = [1000.0]
    c3d["parameters"]["ANALOG"]["LABELS"]["value"] = ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]
    c3d["parameters"]["ANALOG"]["UNITS"]["value"] = ["N", "N", "N", "Nmm", "Nmm", "Nmm"]
    c3d["data"]["analogs"] = np.broadcast_to(channels[None, :, None], (1, 6, 100)).copy()
    c3d.add_parameter("FORCE_PLATFORM", "USED", [1])
    c3d.add_parameter("FORCE_PLATFORM", "TYPE", [kind])
    c3d.add_parameter("FORCE_PLATFORM", "ZERO", [0, 0])
    c3d.add_parameter("FORCE_PLATFORM", "CORNERS", CORNERS_MM.T[:, :, None])
    c3d.add_parameter("FORCE_PLATFORM", "ORIGIN", np.array([[0.0], [0], [-40]]))
    c3d.add_parameter("FORCE_PLATFORM", "CHANNEL", np.arange(1.0, 7.0)[:, None])
    c3d.add_parameter("EVENT", "USED", [3])
    c3d.add_parameter("EVENT", "LABELS", ["Foot Off", "Foot Strike", "Clap"])
    c3d.add_parameter("EVENT", "CONTEXTS", ["Right", "Left", "General"])
    c3d.add_parameter("EVENT", "TIMES", np.array([[0.0, 0.0, 0.0], [0.05, 0.02, 0.01]]))
    c3d.write(str(path))
    return path


def test_channels_of_a_plate_give_the_ground_reaction_at_its_centre_of_pressure(tmp_path):
    (plate,) = read_force_plates(c3d_with_a_plate(tmp_path / "a.c3d"))
    assert (plate.name, plate.rate, len(plate.force)) == ("force_plate_1", 1000, 100)
    np.testing.assert_allclose(plate.force[0], [-20, 0, 700], atol=1e-3)
    np.testing.assert_allclose(plate.centre_of_pressure[0], [0.3, 0.3, 0], atol=1e-6)
    (frame,) = plate_frames(tmp_path / "a.c3d")
    assert (frame.to, frame.from_) == ("capture global", "force_plate_1")
    np.testing.assert_allclose(frame.translation, [0.2, 0.3, 0], atol=1e-6)
    np.testing.assert_allclose(frame.rotation @ [0, 0, 1.0], [0, 0, -1], atol=1e-6)


def test_events_are_ordered_by_time_and_other_events_are_skipped(tmp_path):
    events = read_events(c3d_with_a_plate(tmp_path / "a.c3d"))
    assert [(e.kind, e.side, round(e.time, 6)) for e in events] == [(STRIKE, "left", 0.02), (OFF, "right", 0.05)]


def test_written_events_are_read_again(tmp_path):
    paths = PointPaths(names=("a",), time=np.arange(200) / 2, rate=2.0, points=np.zeros((200, 1, 3)))
    events = [
        GaitEvent(kind=STRIKE, side="left", time=1.25, source="body"),
        GaitEvent(kind=OFF, side=None, time=61.5, source="body"),
    ]
    write_c3d(tmp_path / "a.c3d", paths, events=events)
    found = read_events(tmp_path / "a.c3d")
    assert [(e.kind, e.side, e.source) for e in found] == [(STRIKE, "left", "given"), (OFF, None, "given")]
    np.testing.assert_allclose([e.time for e in found], [1.25, 61.5], atol=1e-5)  # single precision
    write_c3d(tmp_path / "b.c3d", paths)
    assert read_events(tmp_path / "b.c3d") == ()


def test_a_plate_of_an_unknown_type_is_an_error(tmp_path):
    with pytest.raises(FileProblem, match="type 9"):
        read_force_plates(c3d_with_a_plate(tmp_path / "a.c3d", kind=9))


def test_real_plates_carry_the_person_and_give_the_events_of_the_file(shared):
    from marey.io.markers.readers import read_markers
    from marey.markers.preprocessing.gait_events import events_from_force

    path = shared / "data" / "markers" / "functional" / "walk.c3d"
    plates, walk, given = read_force_plates(path), read_markers(path), read_events(path)
    heels = {side: walk.select([f"{side[0].upper()}HEE"]).points[:, 0] for side in ("left", "right")}
    assert [round(float(plate.vertical.max())) for plate in plates] == [695, 695, 692]
    found = events_from_force(plates, heels, rate=walk.rate, start_s=walk.start_s)
    assert len(found) == 6
    for event in found:
        same = [e.time for e in given if (e.kind, e.side) == (event.kind, event.side)]
        assert min(abs(time - event.time) for time in same) < 0.025
    assert len(given) == 11


def test_writing_a_c3d_again_leaves_its_analog_channels_untouched(tmp_path, shared):
    from marey.io.markers.c3d import open_c3d

    source = shared / "data" / "markers" / "functional" / "walk.c3d"
    c3d = open_c3d(source)
    c3d.write(str(tmp_path / "again.c3d"))
    again = open_c3d(tmp_path / "again.c3d")
    np.testing.assert_array_equal(again["data"]["analogs"], c3d["data"]["analogs"])
    for key in ("CORNERS", "ORIGIN", "CHANNEL"):
        np.testing.assert_array_equal(
            again["parameters"]["FORCE_PLATFORM"][key]["value"], c3d["parameters"]["FORCE_PLATFORM"][key]["value"]
        )
