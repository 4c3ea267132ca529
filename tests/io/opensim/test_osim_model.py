"""Reading OpenSim models in both versions of the format, and tasks; errors for unsupported content."""

import numpy as np
import pytest

from marey.body.articulation.coordinate_functions import simm_spline
from marey.body.articulation.jointed_kinematics import place
from marey.errors import FileProblem
from marey.geometry.rotations import about
from marey.io.opensim.mot_sto import TimeSeriesTable, write_table
from marey.io.opensim.osim_model import read_osim_model
from marey.io.opensim.osim_tasks import read_task_values, read_tasks
from marey.markers.kinematics.tasks import CoordinateTask, MarkerTask

X, Y, Z = np.eye(3)
ROLL = "<SimmSpline name='function'><x>-2 -1 0 0.5</x><y>0.1 0.05 0 -0.02</y></SimmSpline>"
LINE = "<LinearFunction name='function'><coefficients>1 0</coefficients></LinearFunction>"
STILL = "<Constant name='function'><value>0</value></Constant>"


def axis(name, coordinate, direction, function):
    return (
        f"<TransformAxis name='{name}'><coordinates>{coordinate}</coordinates><axis>{direction}</axis>"
        f"{function}</TransformAxis>"
    )


def spatial(*functions):
    """Return six axes, each from coordinate, direction and function."""
    names = [f"{kind}{i}" for kind in ("rotation", "translation") for i in (1, 2, 3)]
    return "<SpatialTransform>" + "".join(map(axis, names, *zip(*functions, strict=True))) + "</SpatialTransform>"


KNEE = spatial(
    ("knee", "0 0 2", LINE), ("", "0 1 0", STILL), ("", "1 0 0", STILL),
    ("knee", "1 0 0", f"<MultiplierFunction name='function'><function>{ROLL}</function><scale>0.5</scale>"
     "</MultiplierFunction>"),
    ("", "0 1 0", "<Constant name='function'><value>-0.4</value></Constant>"), ("", "0 0 1", STILL),
)  # fmt: skip


def frame(name, socket, place="0 0 0", turn="0 0 0"):
    return (
        f"<PhysicalOffsetFrame name='{name}'><socket_parent>{socket}</socket_parent><translation>{place}</translation>"
        f"<orientation>{turn}</orientation></PhysicalOffsetFrame>"
    )


def joint(kind, name, parent, child, coordinates="", inside="", more=""):
    listed = "".join(f"<Coordinate name='{c}'>{more}</Coordinate>" for c in coordinates.split())
    return (
        f"<{kind} name='{name}'><socket_parent_frame>{name}_in</socket_parent_frame>"
        f"<socket_child_frame>{name}_out</socket_child_frame><coordinates>{listed}</coordinates><frames>"
        f"{frame(f'{name}_in', parent, '0.1 0 0', '0 0 0.3')}{frame(f'{name}_out', child, '0 0.2 0')}</frames>"
        f"{inside}</{kind}>"
    )


def write(path, *, joints, bodies="thigh shank", constraints="", markers="", version="40600"):
    held = "".join(f"<Body name='{name}'/>" for name in bodies.split())
    path.write_text(
        f"<OpenSimDocument Version='{version}'><Model name='leg'><Ground name='ground'/>"
        f"<BodySet><objects>{held}</objects></BodySet><JointSet><objects>{joints}</objects></JointSet>"
        f"<ConstraintSet><objects>{constraints}</objects></ConstraintSet>"
        f"<MarkerSet><objects>{markers}</objects></MarkerSet></Model></OpenSimDocument>"
    )
    return path


HIP = joint("BallJoint", "hip", "/ground", "/bodyset/thigh", "a b c")
BENDS = joint("CustomJoint", "knee_r", "/bodyset/thigh", "../../bodyset/shank", "knee", KNEE)


def test_a_custom_joint_translates_along_the_axes_of_the_parent_then_rotates(tmp_path):
    model = read_osim_model(write(tmp_path / "m.osim", joints=HIP + BENDS))
    values = np.array([0.2, -0.4, 0.7, -0.8])
    placed = place(model, values)
    thigh = about(Z, 0.3) @ about(X, 0.2) @ about(Y, -0.4) @ about(Z, 0.7)
    origin = 0.1 * X - thigh @ (0.2 * Y)
    assert np.allclose(placed.rotation[0], thigh)
    assert np.allclose(placed.origin[0], origin)
    joint_frame = thigh @ about(Z, 0.3)
    rolled = 0.5 * simm_spline([-2, -1, 0, 0.5], [0.1, 0.05, 0, -0.02]).at(-0.8)[0]
    shank = joint_frame @ about(Z, -0.8)
    at = origin + thigh @ (0.1 * X) + joint_frame @ np.array([rolled, -0.4, 0]) - shank @ (0.2 * Y)
    assert np.allclose(placed.rotation[1], shank)
    assert np.allclose(placed.origin[1], at)


def test_missing_axes_do_not_move(tmp_path):
    one = f"<SpatialTransform>{axis('rotation2', 'knee', '0 1 0', '<LinearFunction/>')}</SpatialTransform>"
    held = HIP + joint("CustomJoint", "knee_r", "/bodyset/thigh", "/bodyset/shank", "knee", one)
    model = read_osim_model(write(tmp_path / "m.osim", joints=held))
    placed = place(model, np.array([0, 0, 0, 0.4]))
    assert np.allclose(placed.rotation[0].T @ placed.rotation[1], about(Z, 0.3) @ about(Y, 0.4))
    wrong = held.replace("rotation2", "bend")
    with pytest.raises(FileProblem, match="has 1 axes in the SpatialTransform of the joint 'knee_r'"):
        read_osim_model(write(tmp_path / "m.osim", joints=wrong))


def test_a_file_before_4_0_gives_the_same_model(tmp_path):
    knee = KNEE.replace(" name='function'", "").replace("<axis>0 0 2</axis>", "<axis>0 0 1</axis>")
    for tag in ("LinearFunction", "Constant", "SimmSpline", "MultiplierFunction"):
        knee = knee.replace(f"<{tag}>", f"<function><{tag}>").replace(f"</{tag}>", f"</{tag}></function>")
    knee = knee.replace("<function><function>", "<function>").replace("</function></function>", "</function>")
    where = "<location_in_parent>0.1 0 0</location_in_parent><orientation_in_parent>0 0 0.3</orientation_in_parent>"
    child = "<location>0 0.2 0</location><orientation>0 0 0</orientation><reverse>false</reverse>"

    def body(name, kind, joint_name, parent, coordinates, inside=""):
        listed = "".join(f"<Coordinate name='{c}'/>" for c in coordinates.split())
        return (
            f"<Body name='{name}'><Joint><{kind} name='{joint_name}'><parent_body>{parent}</parent_body>{where}{child}"
            f"<CoordinateSet><objects>{listed}</objects></CoordinateSet>{inside}</{kind}></Joint></Body>"
        )

    path = tmp_path / "old.osim"
    path.write_text(
        "<OpenSimDocument Version='20303'><Model name='leg'><BodySet><objects><Body name='ground'><Joint/></Body>"
        + body("thigh", "BallJoint", "hip", "ground", "a b c")
        + body("shank", "CustomJoint", "knee_r", "thigh", "knee", knee)
        + "</objects></BodySet><MarkerSet><objects><Marker name='m'><body>shank</body><location>1 2 3</location>"
        "</Marker></objects></MarkerSet></Model></OpenSimDocument>"
    )
    old, new = read_osim_model(path), read_osim_model(write(tmp_path / "m.osim", joints=HIP + BENDS))
    values = np.array([0.2, -0.4, 0.7, -0.8])
    assert old.coordinate_names == new.coordinate_names
    assert np.allclose(place(old, values).rotation, place(new, values).rotation)
    assert np.allclose(place(old, values).origin, place(new, values).origin)
    assert (old.markers[0].label, old.markers[0].body, old.markers[0].place.tolist()) == ("m", "shank", [1, 2, 3])


@pytest.mark.parametrize(
    ("kind", "coordinates", "turn", "shift"),
    [
        ("PinJoint", "a", lambda q: about(Z, q[0]), lambda q: 0 * X),
        ("SliderJoint", "a", lambda q: np.eye(3), lambda q: q[0] * X),
        ("UniversalJoint", "a b", lambda q: about(X, q[0]) @ about(Y, q[1]), lambda q: 0 * X),
        ("GimbalJoint", "a b c", lambda q: about(X, q[0]) @ about(Y, q[1]) @ about(Z, q[2]), lambda q: 0 * X),
        ("PlanarJoint", "a b c", lambda q: about(Z, q[0]), lambda q: q[1] * X + q[2] * Y),
        ("FreeJoint", "a b c d e f", lambda q: about(X, q[0]) @ about(Y, q[1]) @ about(Z, q[2]), lambda q: q[3:]),
        ("WeldJoint", "", lambda q: np.eye(3), lambda q: 0 * X),
    ],
)
def test_every_kind_of_joint_moves_as_in_opensim(tmp_path, kind, coordinates, turn, shift):
    held = joint(kind, "j", "/ground", "/bodyset/thigh", coordinates)
    model = read_osim_model(write(tmp_path / "m.osim", joints=held, bodies="thigh"))
    q = np.array([0.3, -0.5, 0.4, 0.7, 0.1, -0.2])[: len(model.coordinates)]
    placed = place(model, q)
    before = about(Z, 0.3)
    assert np.allclose(placed.rotation[0], before @ turn(q))
    assert np.allclose(placed.origin[0], 0.1 * X + before @ shift(q) - before @ turn(q) @ (0.2 * Y))
    angles = {"SliderJoint": 0, "PlanarJoint": 1, "FreeJoint": 3}.get(kind, len(model.coordinates))
    assert model.rotational.sum() == angles


def test_a_joint_whose_child_is_the_ground_is_reversed(tmp_path):
    held = joint("GimbalJoint", "j", "/bodyset/thigh", "/ground", "a b c")
    model = read_osim_model(write(tmp_path / "m.osim", joints=held, bodies="thigh"))
    q = np.array([0.3, -0.5, 0.4])
    placed = place(model, q)
    thigh_from_ground_turn = about(Z, 0.3) @ about(X, 0.3) @ about(Y, -0.5) @ about(Z, 0.4)
    assert np.allclose(placed.rotation[0], thigh_from_ground_turn.T)
    assert np.allclose(placed.rotation[0] @ (0.1 * X) + placed.origin[0], 0.2 * Y)


def test_markers_on_bodies_offset_frames_and_the_ground_are_read(tmp_path):
    markers = "".join(
        f"<Marker name='{n}'><socket_parent_frame>{f}</socket_parent_frame><location>0 0 1</location></Marker>"
        for n, f in (("a", "/bodyset/shank"), ("b", "/jointset/hip/hip_out"), ("c", "/ground"))
    )
    model = read_osim_model(write(tmp_path / "m.osim", joints=HIP + BENDS, markers=markers))
    assert [(m.label, m.body) for m in model.markers] == [("a", "shank"), ("b", "thigh"), ("c", None)]
    assert np.allclose(model.markers[1].place, [0, 0.2, 1])


def test_limits_apply_if_clamped_and_couplings_if_enforced(tmp_path):
    more = "<default_value>-0.25</default_value><range>-2 0.1</range><clamped>true</clamped><locked>false</locked>"
    knee = joint("CustomJoint", "knee_r", "/bodyset/thigh", "/bodyset/shank", "knee", KNEE, more)
    toe = joint("PinJoint", "toe", "/bodyset/shank", "/bodyset/foot", "toe", more="<locked>true</locked>")
    coupled = (
        "<CoordinateCouplerConstraint name='c'><isEnforced>{}</isEnforced><coupled_coordinates_function>"
        "<LinearFunction><coefficients>0.5 0.1</coefficients></LinearFunction></coupled_coordinates_function>"
        "<independent_coordinate_names>knee</independent_coordinate_names>"
        "<dependent_coordinate_name>toe</dependent_coordinate_name><scale_factor>2</scale_factor>"
        "</CoordinateCouplerConstraint>"
    )
    path = write(
        tmp_path / "m.osim", joints=HIP + knee + toe, bodies="thigh shank foot", constraints=coupled.format("true")
    )
    model = read_osim_model(path)
    bends = model.coordinates[model.coordinate("knee")]
    assert (bends.lower, bends.upper, bends.default) == (-2.0, 0.1, -0.25)
    assert model.coordinates[0].upper == np.inf
    assert np.isclose(model.defaults[-1], 2 * (0.5 * -0.25 + 0.1))
    path = write(
        tmp_path / "m.osim", joints=HIP + knee + toe, bodies="thigh shank foot", constraints=coupled.format("false")
    )
    assert read_osim_model(path).couplings == ()


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (dict(joints=HIP.replace("BallJoint", "EllipsoidJoint") + BENDS), "a EllipsoidJoint, which is not supported"),
        (dict(joints=HIP + BENDS.replace("SimmSpline", "Sine")), "has a Sine in translation1 of the joint 'knee_r'"),
        (dict(joints=HIP), "bodies that are not connected to the ground: shank"),
        (dict(joints=HIP + BENDS + joint("PinJoint", "p", "/ground", "/bodyset/shank", "d")), "has a loop of bodies"),
        (dict(joints=HIP + BENDS, constraints="<WeldConstraint name='w'/>"), "'w', a WeldConstraint"),
        (dict(joints=HIP.replace("/bodyset/thigh", "/bodyset/arm") + BENDS), "on '/bodyset/arm', which does not exist"),
        (dict(joints=HIP + BENDS.replace("0.1 0.05", "0.1 x")), "no numbers in <y>"),
        (dict(joints=HIP + BENDS.replace("-2 -1 0", "-2 -2 0")), "has an invalid SimmSpline in translation1"),
        (
            dict(joints=HIP + BENDS, markers="<Marker name='a'><body>/bodyset/arm</body></Marker>"),
            "no frame '/bodyset/arm' for /markerset/a",
        ),
        (
            dict(joints=HIP.replace("'a'>", "'a'><prescribed>true</prescribed>") + BENDS),
            "'a' prescribed, which is not supported",
        ),
    ],
)  # fmt: skip
def test_unsupported_content_is_an_error_that_names_it(tmp_path, change, wrong):
    with pytest.raises(FileProblem) as caught:
        read_osim_model(write(tmp_path / "m.osim", **change))
    assert wrong in str(caught.value)
    assert str(tmp_path / "m.osim") in str(caught.value)


def test_a_file_that_is_not_a_model_is_rejected(tmp_path):
    path = tmp_path / "m.osim"
    with pytest.raises(FileProblem, match="does not exist"):
        read_osim_model(path)
    path.write_text("<OpenSimDocument><Model></OpenSimDocument>")
    with pytest.raises(FileProblem, match="is not XML"):
        read_osim_model(path)
    path.write_text("<OpenSimDocument Version='40000'><IKTaskSet/></OpenSimDocument>")
    with pytest.raises(FileProblem, match="is not an OpenSim model"):
        read_osim_model(path)


TASKS = """<OpenSimDocument><IKTaskSet><objects>
<IKMarkerTask name="a"><apply>true</apply><weight>2.5</weight></IKMarkerTask>
<IKMarkerTask name="b"><apply>false</apply><weight>1</weight></IKMarkerTask>
<IKCoordinateTask name="q"><apply> true </apply><weight>10</weight>
<value_type>manual_value</value_type><value>0.5</value></IKCoordinateTask>
<IKCoordinateTask name="r"><weight>3</weight><value_type>default_value</value_type><value>0.5</value></IKCoordinateTask>
<IKCoordinateTask name="s"><weight>3</weight><value_type>from_file</value_type></IKCoordinateTask>
</objects></IKTaskSet></OpenSimDocument>"""


def test_tasks_are_read_with_weights_and_sources_of_values(tmp_path):
    path = tmp_path / "w.xml"
    path.write_text(TASKS)
    tasks = read_tasks(path)
    assert [vars(t) for t in tasks.markers] == [vars(MarkerTask(label="a", weight=2.5))]
    assert [vars(t) for t in tasks.coordinates] == [
        vars(CoordinateTask(coordinate="q", weight=10.0, value=0.5)),
        vars(CoordinateTask(coordinate="r", weight=3.0)),
        vars(CoordinateTask(coordinate="s", weight=3.0, from_file=True)),
    ]


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ("IKTaskSet", "Tasks", "has no IKTaskSet"),
        ("2.5", "much", "no numbers in <weight>"),
        ("2.5", "-1", "should be 0 or more"),
        ("manual_value", "guessed", "value_type 'guessed'"),
        ("<apply>true", "<apply>false", "has no applied marker task"),
    ],
)
def test_invalid_tasks_are_rejected(tmp_path, old, new, wrong):
    path = tmp_path / "w.xml"
    path.write_text(TASKS.replace(old, new))
    with pytest.raises(FileProblem, match=wrong):
        read_tasks(path)


def test_values_from_a_file_are_read_at_the_times_of_the_trial(tmp_path):
    weights = tmp_path / "w.xml"
    end = "</OpenSimDocument>"
    tasks = TASKS.replace('name="s"', 'name="c"').replace(end, "<coordinate_file>{}</coordinate_file>" + end)
    model = read_osim_model(write(tmp_path / "m.osim", joints=HIP + BENDS))
    time = np.array([0.0, 0.05, 0.1])
    weights.write_text(tasks.format("goal.mot"))
    known = read_tasks(weights)
    table = TimeSeriesTable(
        name="goal", columns=("b", "c"), time=np.array([0.0, 0.1]), values=np.array([[0, 90.0], [0, 180.0]])
    )
    write_table(tmp_path / "goal.mot", table)
    found = read_task_values(weights, known, model, time)
    assert list(found) == ["c"]
    assert np.allclose(found["c"], np.radians([90, 135, 180]))
    with pytest.raises(FileProblem, match="but the trial 0 to"):
        read_task_values(weights, known, model, np.linspace(0, 0.4, 5))
    write_table(tmp_path / "goal.mot", TimeSeriesTable(name="goal", columns=("b",), time=time, values=np.zeros((3, 1))))
    with pytest.raises(FileProblem, match="has no column c"):
        read_task_values(weights, known, model, time)
    weights.write_text(tasks.format(""))
    with pytest.raises(FileProblem, match="from a file but does not name the file"):
        read_task_values(weights, known, model, time)
