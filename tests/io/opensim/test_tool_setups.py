"""Markers, weights and setups for OpenSim's tools."""

from xml.etree import ElementTree

import numpy as np
import pytest

from marey.errors import FileProblem
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_tasks
from marey.io.opensim.tool_setups import add_markers, ik_task_set, write_id_setup, write_ik_setup, write_ik_tasks
from marey.markers.kinematics.model_placement import SegmentPoint

NEW = (
    "<OpenSimDocument Version='40000'><Model name='m'><BodySet><objects><Body name='thigh'/></objects></BodySet>"
    "<JointSet><objects><FreeJoint name='hip'><socket_parent_frame>/ground</socket_parent_frame><socket_child_frame>"
    "/bodyset/thigh</socket_child_frame></FreeJoint></objects></JointSet></Model></OpenSimDocument>"
)
OLD = (
    "<OpenSimDocument Version='20303'><Model name='m'><BodySet><objects><Body name='thigh'><Joint>"
    "<FreeJoint name='hip'><parent_body>ground</parent_body></FreeJoint></Joint></Body></objects>"
    "</BodySet></Model></OpenSimDocument>"
)
POINT = SegmentPoint(
    label="left_thigh_x", segment="left_thigh", offset=np.zeros(3), body="thigh", place=np.array([0.1, -0.2, 0.3])
)


@pytest.mark.parametrize("text", [NEW, OLD])
def test_added_markers_are_read_again_in_both_formats(tmp_path, text):
    root = ElementTree.fromstring(text)
    add_markers("m.osim", root, [POINT])
    (tmp_path / "m.osim").write_bytes(ElementTree.tostring(root))
    (marker,) = read_osim_model(tmp_path / "m.osim").markers
    assert (marker.label, marker.body) == ("left_thigh_x", "thigh")
    np.testing.assert_allclose(marker.place, [0.1, -0.2, 0.3], rtol=1e-12)
    with pytest.raises(FileProblem, match=r"m\.osim: already has the marker left_thigh_x"):
        add_markers("m.osim", root, [POINT])


def test_weights_are_read_again(tmp_path):
    write_ik_tasks(tmp_path / "tasks.xml", ik_task_set({"a": 1.0, "b": 0.25}, {"lumbar": 1.0}))
    tasks = read_tasks(tmp_path / "tasks.xml")
    assert [(t.label, t.weight) for t in tasks.markers] == [("a", 1.0), ("b", 0.25)]
    assert [(t.coordinate, t.value, t.from_file) for t in tasks.coordinates] == [("lumbar", None, False)]


def test_the_setups_name_their_files_and_times(tmp_path):
    tasks = ik_task_set({"a": 0.5}, {})
    write_ik_setup(
        tmp_path / "ik.xml", model="scaled.osim", markers="points.trc", tasks=tasks, span=(1.0, 2.5), out="ik.mot"
    )
    assert [t.weight for t in read_tasks(tmp_path / "ik.xml").markers] == [0.5]
    tool = ElementTree.parse(tmp_path / "ik.xml").find("InverseKinematicsTool")
    assert [tool.findtext(k) for k in ("model_file", "marker_file", "output_motion_file")] == [
        "scaled.osim", "points.trc", "ik.mot"
    ]  # fmt: skip
    assert [float(v) for v in tool.findtext("time_range").split()] == [1.0, 2.5]
    write_id_setup(
        tmp_path / "id.xml", model="scaled.osim", coordinates="ik.mot", loads="loads.xml", span=(1.0, 2.0), out="id.sto"
    )
    tool = ElementTree.parse(tmp_path / "id.xml").find("InverseDynamicsTool")
    assert [tool.findtext(k) for k in ("coordinates_file", "external_loads_file")] == ["ik.mot", "loads.xml"]
    assert tool.findtext("forces_to_exclude") == "Muscles"
