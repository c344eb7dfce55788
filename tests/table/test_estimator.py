"""The table from generated images, where it is known; and what happens where it cannot be found."""

import math

import pytest
import torch

from physpose_torch import (
    Body,
    InvalidInputError,
    PhysPoseRefiner,
    Scene,
    TableConfig,
    TableEstimator,
    TableNotFoundError,
    View,
    physics_report,
)
from physpose_torch.distance.smoothing import tangent_basis

SIFT = TableConfig(features="sift")  # the export of XFeat has tests of its own


@pytest.fixture(scope="module")
def on_wood(wood):
    return TableEstimator(SIFT)(wood.views, wood.bodies)


def test_two_views_tell_the_table_to_a_fraction_of_a_degree(wood, on_wood):
    angle, height = wood.errors(on_wood.plane)
    assert angle < 0.3
    assert abs(height) < 2.5
    assert on_wood.method == "joint"
    assert on_wood.inliers > 200
    assert not on_wood.warnings


def test_the_second_camera_is_found_to_scale(wood, on_wood):
    true = wood.pair.T_view1_view0
    turn = true[:3, :3].mT @ on_wood.T_view1_view0[:3, :3]
    assert math.degrees(math.acos(min(1.0, float((turn.trace() - 1) / 2)))) < 0.2
    baseline = float(true[:3, 3].norm())
    assert on_wood.scale == pytest.approx(baseline, rel=0.02)


def test_objects_that_stand_on_others_do_not_stand_on_the_table(wood, on_wood):
    for name, support, stands in zip(wood.pair.names, wood.pair.supports, on_wood.standing.tolist(), strict=True):
        if support not in ("table", "plate"):  # what lies in a plate is a few millimetres above the table
            assert not stands, name
    assert int(on_wood.standing.sum()) >= 4
    height = on_wood.contacts @ on_wood.plane.normal - on_wood.plane.offset
    assert float(height.abs().max()) < 4e-3


def test_aligned_poses_are_nearer_to_the_truth_than_the_estimates(wood, on_wood):
    true = wood.pair.T_camera_object[0][:, :3, 3]
    before = (wood.estimates[0][:, :3, 3] - true).norm(dim=1).median()
    after = (on_wood.poses[:, :3, 3] - true).norm(dim=1).median()
    assert float(after) < 0.4 * float(before)


def test_a_bare_table_is_found_by_what_stands_on_it(plain):
    estimate = TableEstimator(SIFT)(plain.views, plain.bodies)
    angle, height = plain.errors(estimate.plane)
    assert angle < 1.0
    assert abs(height) < 5.0


@pytest.mark.slow
def test_a_common_bias_of_depth_does_not_move_the_table(wood):
    biased = []
    for view in (0, 1):
        poses = wood.estimates[view].clone()
        poses[:, :3, 3] *= 1.03
        biased.append(wood.view(view, poses=poses))
    estimate = TableEstimator(SIFT)(biased, wood.bodies)
    angle, height = wood.errors(estimate.plane)
    assert angle < 0.3
    assert abs(height) < 3.0
    assert estimate.depth_factor == pytest.approx(1 / 1.03, abs=0.01)


def test_one_view_works_and_says_that_it_knows_less(wood, on_wood):
    estimate = TableEstimator(SIFT)(wood.view(0), wood.bodies)
    angle, height = wood.errors(estimate.plane)
    assert angle < 1.0
    assert abs(height) < 5.0
    assert estimate.T_view1_view0 is None
    assert estimate.scale is None
    assert estimate.sigma_tilt > 2 * on_wood.sigma_tilt


def test_poses_alone_tell_a_table_within_what_they_say_they_know(wood):
    estimate = TableEstimator(TableConfig(method="support"))(wood.view(0, image=None), wood.bodies)
    angle, height = wood.errors(estimate.plane)
    assert estimate.method == "support"
    assert math.radians(angle) < 4 * estimate.sigma_tilt
    assert 1e-3 * abs(height) < 3.5 * estimate.sigma_offset
    assert estimate.sigma_offset > 5e-3


@pytest.mark.parametrize("method", ["support", "joint"])
def test_objects_refined_on_the_estimated_table_do_not_sink_into_it(wood, method):
    """Its distance is known no better than the scale of the images, and poses alone do not know that at all; but the poses
    share the error."""
    views = wood.view(0, image=None) if method == "support" else wood.view(0)
    estimate = TableEstimator(TableConfig(method=method, features="sift"))(views, wood.bodies)
    assert bool(torch.linalg.eigvalsh(estimate.covariance - estimate.plane.covariance).min() > -1e-9)
    assert float(estimate.plane.covariance[2, 2]) < 0.2 * float(estimate.covariance[2, 2])
    scene = Scene.tabletop(wood.bodies, estimate.plane)
    standing = estimate.standing
    before = physics_report(wood.estimates[0], scene).penetration_static[standing]
    after = PhysPoseRefiner()(wood.estimates[0], scene).report.penetration_static[standing]
    assert float(after.max()) < 0.3 * float(before.max())
    assert float(after.median()) < 1e-3


@pytest.mark.slow
def test_a_second_view_needs_no_poses(wood):
    estimate = TableEstimator(SIFT)([wood.view(0), wood.view(1, poses=None)], wood.bodies)
    angle, height = wood.errors(estimate.plane)
    assert angle < 0.3
    assert abs(height) < 3.0


def test_without_poses_in_the_first_view_the_remedy_is_named(wood):
    unseen = wood.view(0, poses=torch.full_like(wood.estimates[0], torch.nan))
    with pytest.raises(TableNotFoundError, match="swap the views"):
        TableEstimator(SIFT)([unseen, wood.view(1)], wood.bodies)


@pytest.mark.parametrize("method", ["homography", "paper"])
def test_the_methods_by_images_alone_find_a_textured_table(wood, method):
    estimate = TableEstimator(TableConfig(method=method, features="sift"))(wood.views, wood.bodies)
    angle, height = wood.errors(estimate.plane)
    assert estimate.method == method
    assert angle < 3.0
    assert abs(height) < 35.0
    assert 1e-3 * abs(height) < 4 * estimate.sigma_offset


@pytest.mark.parametrize("method", ["homography", "paper"])
def test_the_methods_by_images_alone_say_what_they_miss(wood, method):
    with pytest.raises(TableNotFoundError, match="two images"):
        TableEstimator(TableConfig(method=method))(wood.view(0), wood.bodies)


def test_a_depth_map_of_any_scale_serves_the_paper_method(wood):
    pair = wood.pair
    rays = _rays(pair)
    depth = (pair.offset / (rays @ pair.normal)).clamp(0, 3)  # a table without objects …
    from physpose_torch.table.template import render_template

    template = render_template(wood.bodies, pair.T_camera_object[0], pair.K, tuple(pair.images[0].shape[:2]))
    depth = torch.where(template.owner >= 0, template.depth, depth)  # … and with them
    estimate = TableEstimator(TableConfig(method="paper"))(wood.view(0, depth=0.37 * depth), wood.bodies)
    angle, height = wood.errors(estimate.plane)
    assert angle < 0.5
    assert abs(height) < 15.0
    assert estimate.scale == pytest.approx(1 / 0.37, rel=0.03)


def _rays(pair):
    from physpose_torch.table.view import pixel_rays

    height, width = pair.images[0].shape[:2]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return pixel_rays(pair.K, torch.stack([x, y], -1).double())


def test_gravity_draws_the_table_level(plain):
    one = plain.view(0, image=None)
    down = -plain.pair.normal
    without = TableEstimator(TableConfig(method="support"))(one, plain.bodies)
    known = TableEstimator(TableConfig(method="support", sigma_gravity=math.radians(0.2)))(one, plain.bodies, gravity=down)
    assert plain.errors(known.plane)[0] < 0.3
    assert known.sigma_tilt < 0.5 * without.sigma_tilt


@pytest.mark.slow
def test_gravity_that_contradicts_everything_is_told(wood):
    tilted = torch.nn.functional.normalize(-wood.pair.normal + 0.3 * tangent_basis(wood.pair.normal[None])[0, 0], dim=0)
    estimate = TableEstimator(SIFT)(wood.views, wood.bodies, gravity=tilted)
    assert any("off level" in warning for warning in estimate.warnings)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_callers_dtype_comes_back(wood, dtype):
    view = wood.view(0, image=None, poses=wood.estimates[0].to(dtype))
    estimate = TableEstimator(TableConfig(method="support"))(view, wood.bodies)
    assert estimate.plane.normal.dtype == estimate.plane.covariance.dtype == estimate.poses.dtype == dtype


@pytest.mark.slow
def test_the_same_twice_is_the_same(wood):
    first, second = (TableEstimator(SIFT)(wood.views, wood.bodies).plane for _ in range(2))
    assert torch.equal(first.normal, second.normal)
    assert torch.equal(first.covariance, second.covariance)


# ---- what cannot work


def test_the_same_image_twice_is_told_and_used_once(wood):
    estimate = TableEstimator(SIFT)([wood.view(0), wood.view(0)], wood.bodies)
    assert any("same place" in warning for warning in estimate.warnings)
    assert estimate.T_view1_view0 is None
    alone = TableEstimator(SIFT)(wood.view(0), wood.bodies)
    torch.testing.assert_close(estimate.plane.covariance, alone.plane.covariance)
    torch.testing.assert_close(estimate.covariance, alone.covariance)


def test_an_image_of_something_else_is_left_out(wood, plain):
    other = View(plain.pair.images[0], wood.pair.K)
    estimate = TableEstimator(SIFT)([wood.view(0), other], wood.bodies)
    assert any("does not match" in warning for warning in estimate.warnings)
    assert wood.errors(estimate.plane)[0] < 1.0


@pytest.mark.parametrize("focal", [0.5, 1.3])
def test_wrong_intrinsics_give_no_confident_wrong_plane(wood, focal):
    K = wood.pair.K.clone()
    K[0, 0], K[1, 1] = K[0, 0] * focal, K[1, 1] * focal
    try:
        estimate = TableEstimator(SIFT)([wood.view(0, K=K), wood.view(1, K=K)], wood.bodies)
    except TableNotFoundError:
        return
    angle, height = wood.errors(estimate.plane)
    assert estimate.warnings
    assert math.radians(angle) < 4 * estimate.sigma_tilt
    assert 1e-3 * abs(height) < 4 * estimate.sigma_offset


def test_images_that_show_nothing_leave_the_poses(wood):
    blank = torch.full_like(wood.pair.images[0], 128)
    estimate = TableEstimator(SIFT)([wood.view(0, image=blank), wood.view(1, image=blank)], wood.bodies)
    assert any("hardly any matches" in warning for warning in estimate.warnings)
    assert estimate.sigma_offset > 5e-3
    angle, height = wood.errors(estimate.plane)
    assert math.radians(angle) < 4 * estimate.sigma_tilt
    assert 1e-3 * abs(height) < 3.5 * estimate.sigma_offset


def test_one_box_may_stand_on_several_of_its_sides(table):
    box = Body.box((0.08, 0.07, 0.09), label="box")
    K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    # seen over a corner, three of its sides are hidden
    pose = table.at(turn=(0.0, 0.0, 0.8), z=0.045)[None]
    # … by a camera that is held askew, so that none of them is likelier for being below
    c, d = math.cos(0.9), math.sin(0.9)
    roll = torch.tensor([[c, -d, 0, 0], [d, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    with pytest.raises(TableNotFoundError, match="gravity"):
        TableEstimator(TableConfig(method="support"))(View(None, K, roll @ pose), [box])
    estimate = TableEstimator(TableConfig(method="support"))(View(None, K, pose), [box], gravity=table.gravity)
    assert float(estimate.plane.normal @ table.plane.normal) > 0.9999
    assert any("only 1 object" in warning for warning in estimate.warnings)


def test_objects_that_stand_on_nothing_in_common_give_no_table(table, box, can):
    K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    poses = table.poses((-0.2, 0, 0.3, (0.4, 0.5, 0)), (0.1, 0, 0.1, (0.7, -0.4, 0)), (0.2, 0.1, 0.5, (-0.6, 0.4, 0.0)))
    try:
        estimate = TableEstimator(TableConfig(method="support"))(View(None, K, poses), [box, can, box])
    except TableNotFoundError:
        return
    assert estimate.warnings


def test_nothing_in_nothing_out(wood):
    K = wood.pair.K
    with pytest.raises(TableNotFoundError, match="no object"):
        TableEstimator()(View(wood.pair.images[0], K, torch.zeros(0, 4, 4)), [])
    with pytest.raises(TableNotFoundError, match="no object"):
        TableEstimator()(View(wood.pair.images[0], K), wood.bodies)


def test_a_plane_that_is_known_too_badly_is_refused(wood):
    strict = TableConfig(method="support", widest_offset=1e-3)
    with pytest.raises(TableNotFoundError, match=r"known only to .* mm"):
        TableEstimator(strict)(wood.view(0, image=None), wood.bodies)


def test_wrong_arguments_are_named(wood):
    estimator = TableEstimator()
    with pytest.raises(InvalidInputError, match="3 views"):
        estimator([wood.view(0)] * 3, wood.bodies)
    with pytest.raises(InvalidInputError, match=r"views\[0\] has .* poses for 2 bodies"):
        estimator(wood.view(0), wood.bodies[:2])
    with pytest.raises(InvalidInputError, match=r"bodies\[0\] is a str"):
        estimator(wood.view(0), ["mug"] * len(wood.bodies))
    with pytest.raises(InvalidInputError, match="gravity"):
        estimator(wood.view(0), wood.bodies, gravity=torch.tensor([0.0, 9.81, 0.0]))


@pytest.mark.parametrize(("name", "value"), [("method", "magic"), ("features", "orb"), ("sigma_contact", 0.0)])
def test_options_out_of_range_are_named(name, value):
    with pytest.raises(InvalidInputError, match=name):
        TableConfig(**{name: value})


@pytest.mark.slow
def test_models_of_the_user_find_the_matches(wood):
    asked = []

    def pair_matcher(first, second):
        from physpose_torch.table.matching import MutualNearest, Sift

        asked.append(first.shape)
        sift = Sift()
        return MutualNearest()(sift(first), sift(second))

    estimate = TableEstimator(SIFT, models={"pair_matcher": pair_matcher})(wood.views, wood.bodies)
    assert asked
    assert estimate.inliers > 200


def test_covariance_covers_the_errors_of_many_draws(plain):
    """Mahalanobis distance below what 99.7 % of honest errors keep to, in at least 90 % of 20 draws of poses, one view."""
    from physpose_torch.household import perturb_like_estimator

    inside = told = 0
    for seed in range(20):
        poses = perturb_like_estimator(
            plain.pair.T_camera_object[0], seed=seed, depth_bias=0.0, depth_sigma=0.015, lateral_sigma=0.002
        )
        try:
            estimate = TableEstimator(TableConfig(method="support"))(plain.view(0, image=None, poses=poses), plain.bodies)
        except TableNotFoundError:
            continue
        told += 1
        normal, offset = estimate.plane.normal, estimate.plane.offset
        middle = torch.stack([(T[:3, :3] @ b.center) + T[:3, 3] for T, b in zip(poses, plain.bodies, strict=True)]).mean(0)
        tilt = -(tangent_basis(normal[None])[0] @ plain.pair.normal)
        height = (plain.pair.offset - plain.pair.normal @ middle) - (offset - normal @ middle)
        error = torch.cat([tilt, height[None]])
        inside += float(error @ torch.linalg.solve(estimate.covariance, error)) < 14.16
    assert told >= 15
    assert inside >= 0.9 * told
