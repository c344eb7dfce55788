"""Who touches whom, what carries what, and on whom each contact acts."""

import pytest
import torch

from physpose_torch import se3
from physpose_torch.contacts import find_contacts, find_drops, find_static_gaps
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.scene import Scene, Static


def drops(poses, scene, reach=0.1, **options):
    return find_drops(poses, scene, reach=reach, **options)


def test_a_pair_of_bodies_has_the_distances_of_all_its_part_pairs(table, angle, box):
    """The box stands 5 mm inside the end of the L's foot, and away from its post, which is not even measured."""
    poses = table.poses((0.0, 0.0, 0.0), (0.085 + 0.05, 0.015, 0.02))
    contacts = find_contacts(poses, Scene([angle, box]))
    assert contacts.pair_first.tolist() == [0]
    assert contacts.pair_second.tolist() == [1]
    assert contacts.distance.tolist() == pytest.approx([-0.005], abs=1e-7)
    assert contacts.moves_first.tolist() == contacts.moves_second.tolist() == [True]


def test_every_part_is_measured_against_its_planes(table, angle):
    contacts = find_contacts(table.poses((0, 0, -0.004)), Scene.tabletop([angle], table.plane))
    assert contacts.distance.tolist() == pytest.approx([-0.004, 0.026], abs=1e-9)
    assert contacts.pair.tolist() == [0, 0]
    assert contacts.pair_second.tolist() == [1]
    assert contacts.moves_second.tolist() == [False]


def test_bodies_of_different_images_do_not_meet(table, box):
    image = torch.tensor([0, 1])
    poses = table.poses((0, 0, 0.02), (0, 0, 0.02))
    assert len(find_contacts(poses, Scene([box, box], image=image)).distance) == 0
    assert len(find_contacts(poses, Scene([box, box])).distance) == 1


def test_a_margin_adds_near_misses(table, box):
    poses = table.poses((0, 0, 0.02), (0.103, 0, 0.02))
    assert len(find_contacts(poses, Scene([box, box]), margin=0.001).distance) == 0
    assert find_contacts(poses, Scene([box, box]), margin=0.01).distance.tolist() == pytest.approx([0.003], abs=1e-7)


def test_a_drop_is_the_gap_along_gravity_to_the_nearest_support(table, box, can):
    """A box 4 mm over a box on the table, a can 7 mm over the table beside them, another can 3 mm over a slab."""
    slab = Static(Body.box((0.2, 0.2, 0.05), label="slab"), table.at(0, 0.4, 0.025))
    scene = Scene([box, box, can, can], [Static(table.plane), slab], gravity=table.gravity)
    poses = table.poses((0, 0, 0.02), (0.01, 0, 0.064), (0.2, 0, 0.047), (0, 0.4, 0.093))
    found = drops(poses, scene)
    assert found.height.tolist() == pytest.approx([0.0, 0.004, 0.007, 0.003], abs=1e-7)
    assert found.support.tolist() == [5, 0, 5, 4]
    assert found.touching.tolist()[1:] == [False, False, False]


def test_what_hangs_higher_than_the_reach_has_no_support(table, box, can):
    found = drops(table.poses((0, 0, 0.19), (0.2, 0, 0.05)), Scene.tabletop([box, can], table.plane), reach=0.1)
    assert found.height.tolist() == pytest.approx([float("inf"), 0.01])
    assert found.support.tolist() == [-1, 2]
    assert found.touching.tolist() == [False, False]


def test_a_drop_is_measured_along_gravity_not_along_the_normal(table, box):
    """Over a plane that slopes by 30° a gap of 10 mm along the normal is 10 / cos 30° along gravity."""
    tilt = se3.exp_so3(torch.tensor([0.0, torch.pi / 6, 0.0], dtype=torch.float64))
    normal = table.T[:3, :3] @ tilt @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    pose = table.poses((0, 0, 0, (0, torch.pi / 6, 0)))
    lowest = float(normal @ pose[0, :3, 3]) - 0.02
    scene = Scene([box], [Static(Plane(normal, lowest - 0.01))], gravity=table.gravity)
    assert float(drops(pose, scene).height) == pytest.approx(0.01 / (3**0.5 / 2), abs=1e-9)


def test_a_wall_that_is_grazed_or_penetrated_carries_nothing(table, box):
    """A slab upright beside the box and 1 mm inside it: the box still hangs 10 mm above the table."""
    wall = Static(Body.box((0.02, 0.4, 0.4), label="wall"), table.at(0.059, 0, 0.2))
    scene = Scene([box], [Static(table.plane), wall], gravity=table.gravity)
    found = drops(table.poses((0, 0, 0.03)), scene)
    assert float(found.height) == pytest.approx(0.01, abs=1e-7)
    assert not bool(found.touching)
    steep = Scene([box], [Static(Plane(table.T[:3, 0], -1.0))], gravity=table.gravity)
    assert drops(table.poses((0, 0, 0.03)), steep).height.tolist() == [float("inf")]


def test_nothing_falls_in_an_image_without_gravity(table, box):
    scene = Scene(
        [box, box],
        [Static(table.plane), Static(table.plane, image=1)],
        gravity=torch.stack([torch.zeros(3, dtype=torch.float64), table.gravity]),
        image=torch.tensor([0, 1]),
    )
    assert drops(table.poses((0, 0, 0.03), (0, 0, 0.03)), scene).height.tolist() == pytest.approx([float("inf"), 0.01])


def test_gravity_pulls_the_falling_object_down_and_leaves_what_is_below_alone(table, box, can):
    slab = table.at(0.3, 0, -0.005).requires_grad_()
    offset = table.plane.offset.clone().requires_grad_()
    scene = Scene(
        [box, can, box],
        [Static(Plane(table.plane.normal, offset)), Static(Body.box((0.2, 0.2, 0.05), label="slab"), slab)],
        gravity=table.gravity,
    )
    leaf = table.poses((0, 0, 0.025), (0, 0, 0.09), (0.3, 0, 0.05)).requires_grad_()
    found = drops(leaf, scene)
    assert found.support.tolist() == [4, 0, 3]
    on_can = torch.autograd.grad(found.height[1], leaf, retain_graph=True)[0]
    assert torch.allclose(on_can[1, :3, 3], table.up, atol=1e-6)
    assert not bool(on_can[0].any())
    assert not bool(on_can[2].any())
    # what is static has a gradient: it may be a robot's link, or a table that is being estimated
    assert float(torch.autograd.grad(found.height[0], offset, retain_graph=True)[0]) == pytest.approx(-1.0)
    on_slab = torch.autograd.grad(found.height[2], slab)[0]
    assert torch.allclose(on_slab[:3, 3], -table.up, atol=1e-6)


def test_the_papers_gap_is_the_mean_over_parts_to_the_nearest_static_part(table, angle):
    """The L 8 mm up: its foot is 8 mm and its post 38 mm above the table, 23 mm on average."""
    scene = Scene.tabletop([angle], table.plane)
    poses = table.poses((0, 0, 0.008))
    found = find_static_gaps(poses, scene, find_contacts(poses, scene, margin=1e-4), tolerance=1e-4)
    assert found.height.tolist() == pytest.approx([0.023], abs=1e-9)
    assert found.support.tolist() == [1]
    assert found.touching.tolist() == [False]


def test_the_papers_gap_is_to_the_part_of_a_static_body_that_is_nearest_along_gravity(table, box, angle):
    """Over the post of a static L, not over its foot; and beside it the table is nearest."""
    scene = Scene([box, box], [Static(table.plane), Static(angle, table.at())], gravity=table.gravity)
    poses = table.poses((0.015, 0.015, 0.09 + 0.02 + 0.006), (0.5, 0.5, 0.025))
    found = find_static_gaps(poses, scene, find_contacts(poses, scene, margin=1e-4), tolerance=1e-4)
    assert found.height.tolist() == pytest.approx([0.006, 0.005], abs=1e-7)
    assert found.support.tolist() == [2, 3]


def test_the_papers_gravity_is_off_next_to_anything_and_on_again_beyond_the_tolerance(table, box):
    scene = Scene.tabletop([box, box], table.plane)
    for gap, off in ((5e-5, True), (2e-4, False)):
        poses = table.poses((0, 0, 0.03), (0.1 + gap, 0, 0.03))
        found = find_static_gaps(poses, scene, find_contacts(poses, scene, margin=1e-4), tolerance=1e-4)
        assert found.touching.tolist() == [off, off]


def test_an_alternative_that_pushes_nobody_does_not_switch_the_papers_gravity_off(table, box):
    """Two estimates of one box; the one that does not act touches another box, which hangs 10 mm above the table."""
    scene = Scene.tabletop([box, box, box], table.plane)
    scene = Scene(scene.objects, scene.statics, gravity=table.gravity, same_object=torch.tensor([0, 1, 1]))
    poses = table.poses((0, 0, 0.03), (0.3, 0, 0.03), (0.09, 0, 0.03))
    acts = torch.tensor([True, True, False])
    contacts = find_contacts(poses, scene, acts=acts, margin=1e-4)
    found = find_static_gaps(poses, scene, contacts, tolerance=1e-4)
    assert found.touching.tolist() == [False, False, True]


def test_an_alternative_that_pushes_nobody_feels_its_neighbours_and_carries_nobody(table, box):
    scene = Scene([box] * 3, [Static(table.plane)], gravity=table.gravity, same_object=torch.tensor([0, 1, 1]))
    poses = table.poses((0, 0, 0.064), (0.3, 0, 0.02), (0, 0, 0.02))
    acts = torch.tensor([True, True, False])
    found = drops(poses, scene, acts=acts)
    assert found.support.tolist() == [3, 3, 3]
    assert found.height[0] == pytest.approx(0.044, abs=1e-9)
    close = table.poses((0, 0, 0.02), (0.3, 0, 0.02), (0.09, 0, 0.02))
    leaf = close.requires_grad_()
    contacts = find_contacts(leaf, scene, acts=acts)
    pushed = contacts.distance[contacts.distance < -1e-3]
    assert pushed.tolist() == pytest.approx([-0.01], abs=1e-7)
    gradient = torch.autograd.grad(pushed.sum(), leaf)[0]
    assert not bool(gradient[:2].any())
    assert float(gradient[2].abs().max()) > 0.5


def test_a_planes_variance_grows_with_the_distance_from_under_the_objects_centre(table, box):
    """Offset 2 mm, tilt 0.01 rad: 100 mm from the middle it is 2² + 1² mm², whatever way the tangents point."""
    covariance = torch.diag(torch.tensor([1e-4, 1e-4, 4e-6], dtype=torch.float64))
    scene = Scene.tabletop([box, box], Plane(table.plane.normal, table.plane.offset, covariance))
    poses = table.poses((-0.06, -0.08, 0.02), (0.06, 0.08, 0.02))
    contacts = find_contacts(poses, scene)
    assert contacts.variance.tolist() == pytest.approx([5e-6, 5e-6])
    assert drops(poses, scene).variance.tolist() == pytest.approx([5e-6, 5e-6])
    exact = Scene.tabletop([box, box], table.plane)
    assert find_contacts(poses, exact).variance.tolist() == [0.0, 0.0]
