"""Scenes: what they refuse, that cat and select undo each other, and what may meet what."""

import copy
import pickle

import pytest
import torch

from physpose_torch.config import PhysicsConfig
from physpose_torch.contacts import find_contacts
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import PhysicsLoss
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static


def long(*values):
    return torch.tensor(values, dtype=torch.long)


def same_scene(a: Scene, b: Scene) -> bool:
    return (
        a.objects == b.objects
        and [(s.shape, s.T_camera_body, s.image) for s in a.statics]
        == [(s.shape, s.T_camera_body, s.image) for s in b.statics]
        and a.n_images == b.n_images
        and torch.equal(a.gravity, b.gravity)
        and torch.equal(a.image, b.image)
    )


@pytest.fixture
def shelf(table, box):
    """A static box under the camera's table, as a body."""
    return Static(box, table.at(0.3, 0, 0.02))


@pytest.fixture
def mixed(table, box, can, angle, shelf):
    """Three images: one with a plane and a body, one empty, one without statics and gravity."""
    return Scene(
        [box, can, angle, can],
        [Static(table.plane), shelf, Static(table.plane, image=1)],
        gravity=torch.stack([table.gravity, table.gravity, torch.zeros(3)]),
        image=long(0, 2, 2, 0),
        same_object=long(0, 1, 2, 1),
    )


def test_a_tabletop_has_one_image_a_plane_and_gravity_against_its_normal(table, box, can):
    scene = Scene.tabletop([box, can], table.plane)
    assert len(scene) == 2
    assert scene.labels == ["box", "can"]
    assert (scene.n_images, len(scene.statics)) == (1, 1)
    assert torch.equal(scene.gravity, -table.plane.normal[None])
    assert scene.image.tolist() == [0, 0]
    assert "2 objects, 1 statics, 1 images" in repr(scene)


def test_the_number_of_images_is_the_last_one_named(table, box):
    assert Scene([]).n_images == 1
    assert Scene([], image=long()).n_images == 0
    assert Scene([box], image=long(2)).n_images == 3
    assert Scene([box], [Static(table.plane, image=4)]).n_images == 5
    assert Scene([box], n_images=7).n_images == 7


def test_select_undoes_cat(mixed, table, box, can):
    scenes = [mixed, Scene.tabletop([can, box], table.plane), Scene([], n_images=2)]
    whole = Scene.cat(scenes)
    assert (len(whole), whole.n_images) == (6, 6)
    numbers = [set(whole.same_object[rows].tolist()) for rows in (slice(0, 4), slice(4, 6))]
    assert not numbers[0] & numbers[1]
    first_image, first_row = 0, 0
    for scene in scenes:
        images = torch.arange(first_image, first_image + scene.n_images)
        back, rows = whole.select(images)
        assert same_scene(back, scene)
        assert rows.tolist() == list(range(first_row, first_row + len(scene)))
        # alternatives keep their partners, whatever the numbers are
        assert torch.equal(
            back.same_object[:, None] == back.same_object, scene.same_object[:, None] == scene.same_object
        )
        first_image, first_row = first_image + scene.n_images, first_row + len(scene)


def test_select_follows_the_order_of_the_images(mixed):
    scene, rows = mixed.select(long(2, 0))
    assert rows.tolist() == [0, 1, 2, 3]
    assert scene.image.tolist() == [1, 0, 0, 1]
    assert torch.equal(scene.gravity, mixed.gravity[[2, 0]])
    assert [s.image for s in scene.statics] == [1, 1]
    nothing, rows = mixed.select(long())
    assert (len(nothing), nothing.n_images, len(rows)) == (0, 0, 0)


def test_cat_of_nothing_is_an_empty_batch():
    assert (len(Scene.cat([])), Scene.cat([]).n_images) == (0, 0)


def test_only_bodies_of_one_image_that_are_not_alternatives_may_meet(mixed):
    # entities: box 0, can 1, angle 2, can 3, shelf 4
    assert sorted(map(tuple, mixed.entity_pairs.tolist())) == [(0, 3), (0, 4), (1, 2), (3, 4)]
    assert sorted(map(tuple, mixed.plane_pairs.tolist())) == [(0, 0), (3, 0)]
    alike = Scene(mixed.objects, image=long(0, 0, 0, 0), same_object=long(0, 1, 1, 1))
    assert sorted(map(tuple, alike.entity_pairs.tolist())) == [(0, 1), (0, 2), (0, 3)]


def test_one_body_is_packed_once_however_often_it_stands_there(table, angle, can):
    scene = Scene.tabletop([angle, can, angle], table.plane)
    assert scene.parts.n_parts == 3
    assert scene.instance_part.tolist() == [0, 1, 2, 0, 1]
    assert scene.instance_entity.tolist() == [0, 0, 1, 2, 2]


def test_pairs_are_those_of_all_pairs_tried_in_their_order(table, box, can, angle):
    """Images of any size in any order, empty ones, static bodies in between, and several planes an image."""
    generator = torch.Generator().manual_seed(0)
    for n, bodies, planes, n_images in [(0, 0, 0, 0), (7, 0, 2, 1), (0, 3, 3, 2), (25, 6, 9, 7), (12, 4, 0, 30)]:
        draw = [torch.randint(max(n_images, 1), (k,), generator=generator) for k in (n, bodies, planes)]
        same = torch.randint(max(n, 1), (n,), generator=generator)
        statics = [Static(box, table.at(), int(i)) for i in draw[1]] + [
            Static(table.plane, image=int(i)) for i in draw[2]
        ]
        scene = Scene(([box, can, angle] * n)[:n], statics, image=draw[0], n_images=n_images, same_object=same)
        image = torch.cat(draw[:2]).tolist()
        expected = [
            (i, j)
            for i in range(n)
            for j in range(i + 1, n + bodies)
            if image[i] == image[j] and (j >= n or same[i] != same[j])
        ]
        assert sorted(map(tuple, scene.entity_pairs.tolist())) == expected
        on_planes = [(i, k) for i in range(n) for k in range(planes) if draw[0][i] == draw[2][k]]
        assert list(map(tuple, scene.plane_pairs.tolist())) == on_planes


def test_what_is_made_of_a_scene_shares_its_parts(mixed, table, box, angle):
    """So whatever is worked out about them once, or copied to a device, holds for hypotheses and selections too."""
    few, rows = mixed.select(long(2))
    assert few.parts is mixed.parts is Scene.cat([mixed, few, mixed]).parts
    alone = Scene([mixed.objects[i] for i in rows.tolist()], gravity=mixed.gravity[2], same_object=long(1, 2))
    assert few.instance_entity.tolist() == alone.instance_entity.tolist()
    vertices = [[scene.parts.part(p)[0] for p in scene.instance_part.tolist()] for scene in (few, alone)]
    assert all(torch.equal(a, b) for a, b in zip(*vertices, strict=True))
    assert torch.equal(few.object_center, alone.object_center)
    assert torch.equal(few.entity_span, alone.entity_span)
    other = Scene.tabletop([angle, box], table.plane)
    whole = Scene.cat([mixed, other])
    assert whole.parts.n_bodies == mixed.parts.n_bodies == 3
    assert torch.equal(whole.instance_start.diff()[[4, 5]], other.instance_start.diff())


def test_cat_and_select_take_gravity_and_static_poses_over_bit_by_bit(table, box):
    """Poses of statics may carry a graph, and dividing a unit vector by its length again could change its last digit."""
    pose = table.at(0.3, 0, 0.02).requires_grad_()
    gravity = torch.nn.functional.normalize(
        torch.rand(40, 3, generator=torch.Generator().manual_seed(1)).double(), dim=1
    )
    scenes = [Scene([box], [Static(box, pose)], gravity=g) for g in gravity]
    whole = Scene.cat(scenes)
    few, _ = whole.select(torch.arange(39, -1, -2))
    assert torch.equal(whole.gravity, torch.cat([s.gravity for s in scenes]))
    assert torch.equal(few.gravity, whole.gravity.flip(0)[::2])
    assert all(s.T_camera_body is pose for s in (*whole.statics, *few.statics))
    assert [s.image for s in whole.statics] == list(range(40))
    assert scenes[3].statics[0].image == 0  # theirs is left alone


def test_an_image_without_anything_static_or_several_planes_is_fine(table, box):
    wall = Plane(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), torch.tensor(-0.06, dtype=torch.float64))
    scene = Scene(
        [box, box],
        [Static(table.plane), Static(wall)],
        gravity=table.gravity,
        image=long(0, 1),
    )
    poses = table.poses((0, 0, 0.02), (0, 0, 0.02))
    poses[:, 0, 3] -= 0.02
    report = physics_report(poses, scene)
    assert report.penetration_static.tolist() == pytest.approx([0.01, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda b, t: Scene(["box"]), r"objects\[0\] is a str"),
        (lambda b, t: Scene([b], image=long(0, 1)), r"image has shape \(2,\)"),
        (lambda b, t: Scene([b], image=torch.tensor([0.0])), "image.*float32"),
        (lambda b, t: Scene([b], image=long(-1)), "image has negative"),
        (lambda b, t: Scene([b], image=long(3), n_images=2), "image 3.*n_images = 2"),
        (lambda b, t: Scene([b], [Static(t.plane, image=5)], n_images=2), "image 5.*n_images = 2"),
        (lambda b, t: Scene([b], [Static(t.plane, image=-1)]), "image -1"),
        (lambda b, t: Scene([b], same_object=long(0, 1)), r"same_object has shape \(2,\)"),
        (lambda b, t: Scene([b], same_object=torch.tensor([True])), "same_object.*bool"),
        (lambda b, t: Scene([b], gravity=torch.tensor([0.0, 9.81, 0.0])), r"9\.81.*unit vectors"),
        (lambda b, t: Scene([b], gravity=torch.ones(2, 3)), r"gravity has shape \(2, 3\)"),
        (lambda b, t: Scene([b], gravity=torch.tensor([0.0, float("nan"), 0.0])), "finite"),
        (lambda b, t: Scene([b], [t.plane]), r"statics\[0\] is a Plane"),
        (lambda b, t: Static(b), "'box' needs its pose"),
        (lambda b, t: Static(b, torch.eye(3)), r"'box'.*\(3, 3\)"),
        (lambda b, t: Static(b, 2 * torch.eye(4)), "T_camera_body of static 'box'"),
        (lambda b, t: Static(t.plane, torch.eye(4)), "Plane.*no T_camera_body"),
        (lambda b, t: Static("table"), "str, expected a Body or a Plane"),
    ],
)
def test_a_wrong_scene_is_refused_by_name(make, message, box, table):
    with pytest.raises(InvalidInputError, match=message):
        make(box, table)


def test_a_plane_moved_in_place_or_first_seen_without_gradients_is_seen_as_it_is(table, box):
    """Nothing of a plane may be remembered: its offset may be a parameter that an optimizer moves."""
    offset = table.plane.offset.clone().requires_grad_()
    scene = Scene.tabletop([box], Plane(table.plane.normal, offset))
    pose = table.poses((0, 0, 0.02))
    with torch.no_grad():
        assert float(PhysicsLoss()(pose, scene).collision) == pytest.approx(0, abs=1e-9)
        offset += 0.005
    assert float(physics_report(pose, scene).penetration) == pytest.approx(0.005)
    for _ in range(2):  # and twice: nothing of the first graph is kept
        (gradient,) = torch.autograd.grad(PhysicsLoss()(pose, scene).collision.sum(), offset)
        assert float(gradient) == pytest.approx(1.0)


@pytest.mark.parametrize("gravity", ["support", "paper"])
def test_a_scene_first_used_or_made_in_inference_mode_can_be_trained_on(table, angle, gravity):
    loss, box = PhysicsLoss(PhysicsConfig(gravity=gravity)), Body.box((0.1, 0.06, 0.04), label="box")
    can = Body.cylinder(0.03, 0.08, label="can")

    def make():
        statics = [Static(Plane.from_pose(table.at())), Static(box, table.at(0.0, 0.05, 0.02))]
        return Scene([can, angle], statics, gravity=-Plane.from_pose(table.at()).normal)

    with torch.inference_mode():
        scenes = [make(), make()]
        poses = table.poses((0, 0, 0.03), (0.02, 0.05, 0.05))
        loss(poses, scenes[0])
        physics_report(poses, scenes[0])
    poses = poses.clone()
    for scene in [*scenes, make()]:
        leaf = poses.clone().requires_grad_()
        terms = loss(leaf, scene, measured=poses)
        terms.total.sum().backward()
        assert bool(leaf.grad.isfinite().all())
        assert float(leaf.grad.abs().max()) > 0


def test_copies_of_a_scene_stand_by_themselves(table, box, can):
    """Their parts have numbers of their own, in another process, too."""
    poses = table.poses((0, 0, 0.03), (0.02, 0.05, 0.05))
    scene = Scene([box, can], [Static(box, table.at(0.0, 0.05, 0.02))], gravity=table.gravity)
    expected = PhysicsLoss()(poses, scene).total
    copies = [copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))]
    assert len({s.parts.handle for s in [scene, *copies]}) == 3
    del scene
    for other in copies:
        torch.testing.assert_close(PhysicsLoss()(poses, other).total, expected, atol=0, rtol=0)


def test_a_body_first_used_in_inference_mode_can_be_trained_on(table):
    with torch.inference_mode():
        bodies = [Body.box((0.1, 0.1, 0.1), label="crate"), Body.cylinder(0.03, 0.08, label="can")]
        physics_report(table.poses((0, 0, 0.05), (0, 0, 0.13)), Scene.tabletop(bodies, table.plane))
    leaf = table.poses((0, 0, 0.04), (0, 0, 0.12)).requires_grad_()
    PhysicsLoss()(leaf, Scene.tabletop(bodies, table.plane)).total.sum().backward()
    assert bool(leaf.grad.isfinite().all())


def test_a_static_part_pushes_where_a_plane_would(table, box):
    """A static slab whose top is the table gives the distances of the plane."""
    slab = Body.box((2.0, 2.0, 0.2), label="slab")
    pose = table.poses((0, 0, 0.015, (0, 0, 0.3)))
    flat = find_contacts(pose, Scene.tabletop([box], table.plane))
    solid = find_contacts(pose, Scene([box], [Static(slab, table.at(0, 0, -0.1))], gravity=table.gravity))
    assert float(flat.distance) == pytest.approx(-0.005, abs=1e-9)
    assert float(solid.distance) == pytest.approx(-0.005, abs=1e-7)
