from dataclasses import replace

import numpy as np
import pytest
from tests.skin_clusters import leg_and_bones

from marey.errors import MareyError
from marey.geometry import rotations
from marey.markers.data.rigid_fit import rigid
from marey.markers.kinematics.transform_chain import (
    CAPTURE_ANATOMIC,
    CAPTURE_BONE,
    CAPTURE_GLOBAL,
    CHAIN,
    MR_ANATOMIC,
    MR_GLOBAL,
    NamedTransform,
    TransformChain,
    bone_steps,
    compose,
    identity,
)


def any_transform(rng, to: str, from_: str, frames: int | None = None, *, uncertain: bool = True) -> NamedTransform:
    batch = () if frames is None else (frames,)
    root = 1e-4 * rng.normal(size=(*batch, 6, 6))
    return NamedTransform(
        to=to,
        from_=from_,
        rotation=rotations.exp(rng.normal(size=(*batch, 3))),
        translation=rng.normal(size=(*batch, 3)),
        covariance=root @ np.swapaxes(root, -1, -2) if uncertain else None,
    )


def whole_chain(rng, frames: int = 4) -> TransformChain:
    moving = [None, None, frames, frames, frames]
    steps = [any_transform(rng, CHAIN[i + 1], CHAIN[i], moving[i], uncertain=i in (1, 3)) for i in range(5)]
    names = list(TransformChain.__dataclass_fields__)
    return TransformChain(**dict(zip(names, steps, strict=True)))


def test_a_product_carries_points_as_its_factors_one_after_the_other(rng):
    points = rng.normal(size=(7, 3))
    for first, second in ((None, None), (5, None), (None, 5), (5, 5)):
        c_from_b, b_from_a = any_transform(rng, "c", "b", first), any_transform(rng, "b", "a", second)
        np.testing.assert_allclose((c_from_b @ b_from_a).apply(points), c_from_b.apply(b_from_a.apply(points)))


def test_a_transform_and_its_inverse_undo_each_other(rng):
    for frames in (None, 6):
        b_from_a = any_transform(rng, "b", "a", frames)
        both = b_from_a.inverse() @ b_from_a
        assert (both.to, both.from_) == ("a", "a")
        np.testing.assert_allclose(both.matrix(), np.broadcast_to(np.eye(4), both.matrix().shape), atol=1e-12)
        twice = b_from_a.inverse().inverse()
        np.testing.assert_allclose(twice.covariance, b_from_a.covariance, atol=1e-20)


def test_frames_that_do_not_meet_are_an_error_that_names_them(rng):
    with pytest.raises(MareyError, match="from 'b' cannot follow one to 'x'"):
        any_transform(rng, "c", "b") @ any_transform(rng, "x", "a")
    with pytest.raises(MareyError, match="has 3 frames, b from a has 4"):
        any_transform(rng, "c", "b", 3) @ any_transform(rng, "b", "a", 4)


def test_arrays_that_do_not_fit_are_an_error(rng):
    with pytest.raises(MareyError, match="do not agree"):
        NamedTransform(to="b", from_="a", rotation=np.eye(3), translation=np.zeros((2, 3)))


def disturbed(transform: NamedTransform, step: np.ndarray) -> NamedTransform:
    return replace(
        transform,
        rotation=transform.rotation @ rotations.exp(step[:3]),
        translation=transform.translation + step[3:],
        covariance=None,
    )


def difference(changed: NamedTransform, plain: NamedTransform) -> np.ndarray:
    turn = rotations.log(plain.rotation.T @ changed.rotation)
    return np.concatenate([turn, changed.translation - plain.translation])


def numeric(function, transform: NamedTransform) -> np.ndarray:
    step, plain = 1e-6, function(replace(transform, covariance=None))
    columns = [
        (difference(function(disturbed(transform, step * e)), plain)
         - difference(function(disturbed(transform, -step * e)), plain)) / (2 * step)
        for e in np.eye(6)
    ]  # fmt: skip
    return np.stack(columns, 1)


def test_covariance_propagates_through_products_and_inverses_as_differences_show(rng):
    first, second = any_transform(rng, "c", "b"), any_transform(rng, "b", "a")
    by_first, by_second = numeric(lambda t: t @ second, first), numeric(lambda t: first @ t, second)
    expected = by_first @ first.covariance @ by_first.T + by_second @ second.covariance @ by_second.T
    np.testing.assert_allclose((first @ second).covariance, expected, rtol=1e-6, atol=1e-14)
    by_own = numeric(lambda t: t.inverse(), first)
    np.testing.assert_allclose(first.inverse().covariance, by_own @ first.covariance @ by_own.T, rtol=1e-6, atol=1e-14)


def test_what_is_known_exactly_adds_no_uncertainty(rng):
    first = any_transform(rng, "c", "b", 3, uncertain=False)
    assert (first @ identity("b", "a")).covariance is None
    second = any_transform(rng, "b", "a")
    np.testing.assert_allclose((first @ second).covariance[1, :3, :3], second.covariance[:3, :3])


def test_the_chain_leads_from_the_scanner_to_the_laboratory_and_back(rng):
    chain, points = whole_chain(rng), rng.normal(size=(5, 3))
    expected = points
    for step in chain.steps:
        expected = step.apply(expected)
    np.testing.assert_allclose(chain.between(CAPTURE_GLOBAL, MR_GLOBAL).apply(points), expected)
    np.testing.assert_allclose(chain.between(MR_GLOBAL, CAPTURE_GLOBAL).apply(expected), np.stack([points] * 4))
    assert chain.between(CAPTURE_BONE, MR_ANATOMIC).covariance.shape == (4, 6, 6)
    assert not chain.between(MR_ANATOMIC, MR_GLOBAL).moves
    np.testing.assert_array_equal(chain.between(MR_GLOBAL, MR_GLOBAL).matrix(), np.eye(4))


def test_a_chain_with_a_step_in_the_wrong_place_or_an_unknown_frame_is_an_error(rng):
    chain = whole_chain(rng)
    with pytest.raises(MareyError, match="Step 4 of the chain leads to 'capture bone' from 'capture deformed'"):
        replace(chain, bone_from_deformed=chain.capture_global_from_bone)
    with pytest.raises(MareyError, match="no frame CT"):
        chain.between("CT", MR_GLOBAL)


def test_nothing_to_compose_is_an_error():
    with pytest.raises(MareyError, match="no transform"):
        compose()


def test_a_frame_without_an_estimate_stays_empty(rng):
    moving = any_transform(rng, "b", "a", 3)
    rotation = moving.rotation.copy()
    rotation[1] = np.nan
    holed = replace(moving, rotation=rotation, covariance=None)
    transformed = holed.apply(np.ones((2, 3)))
    assert np.isnan(transformed[1]).all()
    assert np.isfinite(transformed[[0, 2]]).all()
    np.testing.assert_array_equal(holed.at(0).rotation, rotation[0])


def test_the_last_three_steps_of_a_bone_lead_to_its_corrected_motion_with_its_covariance(rng):
    leg, _ = leg_and_bones(rng)
    points = leg.trajectories.points + rng.normal(0, 0.003, leg.trajectories.points.shape)
    leg = replace(leg, trajectories=replace(leg.trajectories, points=points))
    corrected, cluster = rigid(leg), rigid(replace(leg, trajectories=replace(leg.trajectories, points=points + 1e-3)))
    steps = bone_steps(cluster, corrected, "shank")
    whole = compose(*reversed(steps))
    assert (whole.to, whole.from_) == (CAPTURE_GLOBAL, CAPTURE_ANATOMIC)
    np.testing.assert_allclose(whole.rotation, corrected.bone("shank")[0], atol=1e-12)
    np.testing.assert_allclose(whole.translation, corrected.bone("shank")[1], atol=1e-12)
    np.testing.assert_allclose(whole.covariance, corrected.covariance[:, 1], atol=1e-15)
