"""Scaling an OpenSim model in its XML, in both versions of the format, also beside OpenSim itself."""

import numpy as np
import pytest
from tests import performer

from marey.body.articulation.jointed_kinematics import place
from marey.body.articulation.model_scaling import centre_in_ground, neutral_posture
from marey.errors import FileProblem
from marey.io.opensim.osim import write_osim
from marey.io.opensim.osim_model import read_osim, read_osim_model
from marey.io.opensim.osim_scaling import body_masses, scale_osim
from marey.io.opensim.scale_files import write_scaled_osim

SPLINE = "<SimmSpline><x>-2 -1 0 1</x><y>-0.42 -0.41 -0.4 -0.4</y></SimmSpline>"
MULTIPLIED = f"<MultiplierFunction><function>{SPLINE}</function><scale>1.5</scale></MultiplierFunction>"


def axis(name, coordinate, direction, function):
    return (
        f"<TransformAxis name='{name}'><coordinates>{coordinate}</coordinates><axis>{direction}</axis>"
        f"<function>{function}</function></TransformAxis>"
    )


LINE = "<LinearFunction><coefficients>1 0</coefficients></LinearFunction>"
ZERO = "<Constant><value>0</value></Constant>"
KNEE = (
    axis("rotation1", "knee", "0 0 1", LINE) + axis("rotation2", "", "0 1 0", ZERO)
    + axis("rotation3", "", "1 0 0", ZERO) + axis("translation1", "", "1 0 0", ZERO.replace("0", "0.01"))
    + axis("translation2", "knee", "0 1 0", MULTIPLIED) + axis("translation3", "", "0 0 1", ZERO)
)  # fmt: skip
INERTIA = "".join(
    f"<inertia_{k}>{v}</inertia_{k}>"
    for k, v in zip(("xx", "yy", "zz", "xy", "xz", "yz"), (0.3, 0.1, 0.35, 0.01, -0.02, 0.03), strict=True)
)
POINTS = (
    "<PathPoint name='a'><location>0.1 -0.1 0.02</location><body>thigh</body></PathPoint>"
    "<ConditionalPathPoint name='b'><location>0.3 -0.3 0</location><body>thigh</body><range>-2 -1</range>"
    "<coordinate>knee</coordinate></ConditionalPathPoint>"
    f"<MovingPathPoint name='c'><body>shank</body><x_location>{SPLINE}</x_location>"
    f"<y_location>{MULTIPLIED}</y_location><z_location>{ZERO}</z_location><x_coordinate>knee</x_coordinate>"
    "<y_coordinate>knee</y_coordinate><z_coordinate>knee</z_coordinate></MovingPathPoint>"
)
OLD = f"""<OpenSimDocument Version="20303"><Model name="leg"><BodySet><objects><Body name="ground"><mass>0</mass></Body>
<Body name="thigh"><mass>7</mass><mass_center>0 -0.2 0.01</mass_center>{INERTIA}<Joint><CustomJoint name="hip">
<parent_body>ground</parent_body><location_in_parent>0 0.9 0</location_in_parent><location>0 0.02 0</location>
<SpatialTransform>{axis("rotation1", "hip", "0 0 1", LINE)}{axis("translation2", "lift", "0 1 0", LINE)}
</SpatialTransform><CoordinateSet><objects><Coordinate name="hip"/><Coordinate name="lift"><motion_type>translational
</motion_type><default_value>0.1</default_value></Coordinate></objects></CoordinateSet></CustomJoint></Joint>
<WrapObjectSet><objects><WrapCylinder name="w"><translation>0 -0.3 0</translation><radius>0.03</radius></WrapCylinder>
</objects></WrapObjectSet></Body>
<Body name="shank"><mass>3</mass><mass_center>0 -0.15 0</mass_center>{INERTIA}<Joint><CustomJoint name="knee">
<parent_body>thigh</parent_body><location_in_parent>0 0 0</location_in_parent><location>0 0 0</location>
<SpatialTransform>{KNEE}</SpatialTransform><CoordinateSet><objects><Coordinate name="knee"/></objects></CoordinateSet>
</CustomJoint></Joint></Body></objects></BodySet><ForceSet><objects><Thelen2003Muscle name="m"><GeometryPath>
<PathPointSet><objects>{POINTS}</objects></PathPointSet></GeometryPath><optimal_fiber_length>0.1</optimal_fiber_length>
<tendon_slack_length>0.2</tendon_slack_length></Thelen2003Muscle></objects></ForceSet>
<MarkerSet><objects><Marker name="k"><body>thigh</body><location>0.05 -0.4 0.01</location></Marker></objects>
</MarkerSet>
</Model></OpenSimDocument>"""


@pytest.fixture
def leg(tmp_path):
    (tmp_path / "leg.osim").write_text(OLD)
    return tmp_path / "leg.osim"


def number(root, path):
    return np.array([float(v) for v in root.find(path).text.split()])


def test_everything_on_a_body_moves_by_its_factors(leg):
    root = read_osim(leg)
    values = np.array([0.3, 0.1, -0.6])
    before = place(read_osim_model(leg), values)
    after = place(scale_osim(leg, root, {"thigh": np.full(3, 1.2), "shank": np.full(3, 0.9)}), values)
    thigh = ".//Body[@name='thigh']"
    np.testing.assert_allclose(number(root, f"{thigh}/mass_center"), [0, -0.24, 0.012], atol=1e-15)
    np.testing.assert_allclose(number(root, ".//Marker/location"), [0.06, -0.48, 0.012], rtol=1e-14)
    np.testing.assert_allclose(number(root, ".//WrapCylinder/radius"), 0.036, rtol=1e-14)
    np.testing.assert_allclose(number(root, ".//WrapCylinder/translation"), [0, -0.36, 0], rtol=1e-14)
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-15)
    # The hip and how high the leg is lifted belong to the ground, which is not scaled.
    hip = before.rotation[0] @ [0, 0.02, 0] + before.origin[0]
    np.testing.assert_allclose(after.rotation[0] @ [0, 0.024, 0] + after.origin[0], hip, atol=1e-15)
    apart = [placed.origin[1] - placed.origin[0] for placed in (before, after)]
    np.testing.assert_allclose(apart[1], 1.2 * apart[0], atol=1e-15)


def test_a_muscle_keeps_the_shares_of_fibre_and_tendon(leg):
    root = read_osim(leg)
    scale_osim(leg, root, {"thigh": np.full(3, 1.3), "shank": np.full(3, 1.3)})
    np.testing.assert_allclose(number(root, ".//optimal_fiber_length"), 0.13, rtol=1e-12)
    np.testing.assert_allclose(number(root, ".//tendon_slack_length"), 0.26, rtol=1e-12)


def test_the_inertia_is_that_of_the_scaled_points_of_mass(leg):
    rng = np.random.default_rng(3)
    points, masses, factors = rng.normal(size=(40, 3)), rng.uniform(0.5, 1, 40), np.array([1.2, 0.8, 1.1])
    points -= masses @ points / masses.sum()

    def inertia(at):
        return sum(m * ((p @ p) * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, at, strict=True))

    own = inertia(points)
    places = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
    made = "".join(f"<inertia_{k}>{float(own[at])!r}</inertia_{k}>" for k, at in places.items())
    leg.write_text(OLD.replace(INERTIA, made, 1).replace("<mass>7</mass>", f"<mass>{float(masses.sum())!r}</mass>"))
    root = read_osim(leg)
    scale_osim(leg, root, {"thigh": factors}, {"thigh": 2 * float(masses.sum())})
    wanted = 2 * inertia(points * factors)
    for name, at in places.items():
        np.testing.assert_allclose(number(root, f".//Body[@name='thigh']/inertia_{name}"), wanted[at], rtol=1e-12)


@pytest.mark.slow
def test_a_model_in_the_new_format_is_scaled_like_its_joint_centres(tmp_path):
    path = tmp_path / "body.osim"
    write_osim(path, performer.body(), mass_kg=70.0)
    before, root = read_osim_model(path), read_osim(path)
    masses = body_masses(path, root)
    assert sum(masses.values()) == pytest.approx(70.0)
    scale_osim(path, root, dict.fromkeys(masses, np.full(3, 1.25)), {name: 2 * mass for name, mass in masses.items()})
    write_scaled_osim(tmp_path / "scaled.osim", root)
    after = read_osim_model(tmp_path / "scaled.osim")

    def knee(model):
        placed = place(model, neutral_posture(model))
        return [centre_in_ground(model, placed, name) for name in ("left_thigh", "left_shank")]

    (old_hip, old_knee), (hip, own_knee) = knee(before), knee(after)
    np.testing.assert_allclose(own_knee - hip, 1.25 * (old_knee - old_hip), rtol=1e-10)
    twice = body_masses(tmp_path / "scaled.osim", read_osim(tmp_path / "scaled.osim"))
    assert sum(twice.values()) == pytest.approx(140.0)


def test_drawn_geometry_is_scaled_once_and_the_axes_of_frames_are_not(leg):
    sphere = "<Sphere><scale_factors>2 1 1</scale_factors><radius>0.1</radius></Sphere>"
    drawn = f"<attached_geometry>{sphere}</attached_geometry>"
    axes = "<FrameGeometry><scale_factors>0.2 0.2 0.2</scale_factors></FrameGeometry>"
    leg.write_text(OLD.replace("<WrapObjectSet>", f"{drawn}{axes}<WrapObjectSet>", 1))
    root = read_osim(leg)
    scale_osim(leg, root, {"thigh": np.full(3, 1.5)})
    np.testing.assert_allclose(number(root, ".//Sphere/scale_factors"), [3.0, 1.5, 1.5])
    np.testing.assert_allclose(number(root, ".//Sphere/radius"), 0.1)
    np.testing.assert_allclose(number(root, ".//FrameGeometry/scale_factors"), 0.2)


def test_a_function_that_cannot_be_scaled_is_named(leg):
    leg.write_text(leg.read_text().replace(MULTIPLIED, "<Sine><amplitude>1</amplitude></Sine>", 1))
    with pytest.raises(FileProblem, match=r"leg\.osim.*Sine"):
        scale_osim(leg, read_osim(leg), {})


def test_entities_are_refused(leg):
    leg.write_text("<!DOCTYPE a [<!ENTITY b 'c'>]>" + OLD)
    with pytest.raises(FileProblem, match="entities"):
        read_osim(leg)


@pytest.mark.slow
def test_opensim_scales_the_same_way(shared, tmp_path):
    opensim = pytest.importorskip("opensim", reason="The package opensim is not installed.")
    source = shared / "data" / "markers" / "gait" / "model_scaled.osim"
    opensim.Logger.setLevelString("off")
    rng, root = np.random.default_rng(1), read_osim(source)
    masses = body_masses(source, root)
    # One factor per body: along several, OpenSim approximates the inertia.
    factors = {name: np.full(3, rng.uniform(0.85, 1.2)) for name in masses}
    total = 60.0 / sum(masses.values())
    scale_osim(source, root, factors, {name: total * mass for name, mass in masses.items()})
    write_scaled_osim(tmp_path / "ours.osim", root)
    theirs, scales = opensim.Model(str(source)), opensim.ScaleSet()
    for name, each in factors.items():
        scale = opensim.Scale()
        scale.setSegmentName(name)
        scale.setScaleFactors(opensim.Vec3(*each))
        scale.setApply(True)
        scales.cloneAndAppend(scale)
    theirs.scale(theirs.initSystem(), scales, True, 60.0)
    theirs.finalizeConnections()
    ours = opensim.Model(str(tmp_path / "ours.osim"))
    states = theirs.initSystem(), ours.initSystem()
    assert ours.getTotalMass(states[1]) == pytest.approx(60.0, rel=1e-12)

    def vector(value):
        return np.array([value.get(i) for i in range(value.size())])

    for i in range(theirs.getBodySet().getSize()):
        one = theirs.getBodySet().get(i)
        other = ours.getBodySet().get(one.getName())
        np.testing.assert_allclose(vector(other.getMassCenter()), vector(one.getMassCenter()), atol=1e-12)
        # OpenSim keeps six digits of inertias and splines when it reads the old format.
        np.testing.assert_allclose(vector(other.get_inertia()), vector(one.get_inertia()), rtol=1e-5, atol=1e-9)
        places = [vector(body.getPositionInGround(state)) for body, state in zip((one, other), states, strict=True)]
        np.testing.assert_allclose(places[1], places[0], atol=1e-6)
    for i in range(theirs.getMuscles().getSize()):
        one = theirs.getMuscles().get(i)
        other = ours.getMuscles().get(one.getName())
        assert other.getOptimalFiberLength() == pytest.approx(one.getOptimalFiberLength(), rel=1e-9)
        assert other.getTendonSlackLength() == pytest.approx(one.getTendonSlackLength(), rel=1e-9)
