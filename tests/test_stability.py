"""Whether objects stay where they are: margins by hand, exactly when they tip, and what must not matter."""

import math

import numpy as np
import pytest
import torch
import trimesh
from helpers import assert_camera_frame_invariant

from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.household import household_meshes, household_scene
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static
from physpose_torch.stability import TILT

INF = float("inf")
LIFT = 0.5 + 1e-7
"""[m]; the height of the slab's top and a hair: contact at exactly zero is not the point."""


def margins(poses, scene, **options):
    return physics_report(poses, scene, **options).stability_margin.tolist()


def on_slab(table, *, size=(0.2, 0.2, 0.1)):
    """A static slab with its top 0.5 m above the table, which is left out."""
    return Static(Body.box(size, label="slab"), table.at(0, 0, 0.5 - size[2] / 2))


def solid(label, *boxes):
    """A body of boxes, each given by its bounds."""
    meshes = [trimesh.creation.box(bounds=b) for b in boxes]
    parts = ConvexParts.from_hulls([np.array(m.vertices) for m in meshes])
    return Body(label, parts, trimesh.util.concatenate(meshes))


@pytest.mark.parametrize("yaw", [0.0, 0.3, 1.2, math.pi / 2])
@pytest.mark.parametrize("height", [0.0, 0.002, 0.3], ids=["resting", "2 mm above", "30 cm above"])
def test_the_margin_of_a_box_on_a_face_is_half_its_smaller_side(table, box, yaw, height):
    report = physics_report(table.poses((0.1, 0.2, 0.02 + height, (0, 0, yaw))), Scene.tabletop([box], table.plane))
    assert report.stability_margin.tolist() == pytest.approx([0.03], abs=1e-6)
    assert report.stable.tolist() == [True]


@pytest.mark.parametrize("depth", [0.001, 0.01])
def test_a_box_that_is_sunk_in_stands_too(table, box, depth):
    assert margins(table.poses((0, 0, 0.02 - depth)), Scene.tabletop([box], table.plane)) == pytest.approx([0.03])


@pytest.mark.parametrize("carrier", ["static", "object"])
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_box_tips_exactly_when_its_centre_of_mass_passes_the_edge(table, box, carrier, yaw):
    """The slab ends at x = 0.1; the box is turned so that corners, not sides, hang over."""
    for beyond, stable in ((-0.002, True), (0.002, False)):
        turn = (0, 0, yaw)
        slab = on_slab(table)
        if carrier == "static":
            scene, poses = Scene([box], [slab], gravity=table.gravity), []
        else:
            scene = Scene([box, slab.shape], [Static(table.plane)], gravity=table.gravity)
            poses = [slab.T_camera_body]
        poses = torch.stack([table.at(0.1 + beyond, 0.0, LIFT + 0.02, turn), *poses])
        report = physics_report(poses, scene)
        assert report.stable.tolist()[0] is stable
        assert report.stability_margin.tolist()[0] == pytest.approx(-beyond, abs=1e-5)
        assert report.status[0] == ("resting" if stable else "tipping")
        assert report.supporter[0] == "slab"


def test_aligned_boxes_of_one_size_carry_each_other(table, box):
    """All edges run along the borders of the other's faces."""
    report = physics_report(table.poses((0, 0, 0.02), (0, 0, 0.06)), Scene.tabletop([box, box], table.plane))
    assert report.stability_margin.tolist() == pytest.approx([0.03, 0.03], abs=1e-5)


def test_a_plate_crosswise_on_a_beam_touches_with_crossing_edges_only(table):
    plate, beam = Body.box((0.3, 0.04, 0.01), label="plate"), Body.box((0.06, 0.3, 0.05), label="beam")
    scene = Scene.tabletop([plate, beam], table.plane)
    poses = table.poses((0, 0, 0.05 + 0.005 + 1e-7), (0, 0, 0.025))
    assert margins(poses, scene) == pytest.approx([0.02, 0.03], abs=1e-5)
    off = table.poses((0.032, 0, 0.05 + 0.005 + 1e-7), (0, 0, 0.025))
    assert margins(off, scene)[0] == pytest.approx(-0.002, abs=1e-5)


def test_an_object_spans_two_supports_of_which_neither_would_do(table, box):
    plank = Body.box((0.3, 0.04, 0.01), label="plank")
    z = 0.04 + 0.005 + 1e-7
    both = [(-0.12, 0, 0.02), (0.12, 0, 0.02)]
    scene = Scene.tabletop([plank, box, box], table.plane)
    assert margins(table.poses((0, 0, z), *both), scene)[0] == pytest.approx(0.02, abs=1e-5)
    alone = Scene.tabletop([plank, box], table.plane)
    assert margins(table.poses((0, 0, z), both[0]), alone)[0] == pytest.approx(-0.07, abs=1e-5)


def test_an_object_leans_on_the_table_and_on_another(table):
    """A stick with its foot on the table and its upper end over the edge of a box: neither contact carries it alone."""
    lean = math.radians(30)
    stick, block = Body.box((0.3, 0.02, 0.01), label="stick"), Body.box((0.1, 0.2, 0.1), label="block")
    x = 0.15 * math.cos(lean) - 0.005 * math.sin(lean)
    z = 0.15 * math.sin(lean) + 0.005 * math.cos(lean)
    # its lower side meets the block's edge at height 0.1
    edge = 0.1 / math.tan(lean)
    poses = table.poses((x, 0, z, (0, -lean, 0)), (edge + 0.05 + 1e-7, 0, 0.05))
    report = physics_report(poses, Scene.tabletop([stick, block], table.plane))
    assert report.stable.tolist() == [True, True]
    assert float(report.stability_margin[0]) == pytest.approx(0.01, abs=1e-5)  # half its width
    far = poses.clone()
    far[1] = table.at(1.0, 0, 0.05)
    assert physics_report(far, Scene.tabletop([stick, block], table.plane)).status == ["tipping", "resting"]


def test_a_wall_that_is_leaned_against_carries_nothing(table):
    """On its foot's edge, its upper edge against an upright wall: friction at a wall is not counted on."""
    lean = math.radians(20)
    board = Body.box((0.01, 0.1, 0.2), label="board")
    x = 0.1 * math.sin(lean) + 0.005 * math.cos(lean)
    z = 0.1 * math.cos(lean) + 0.005 * math.sin(lean)
    wall = Static(Body.box((0.1, 0.5, 0.5), label="wall"), table.at(x + 0.05 + 1e-7, 0, 0.25))
    scene = Scene([board], [Static(table.plane), wall], gravity=table.gravity)
    assert physics_report(table.poses((0, 0, z, (0, lean, 0))), scene).status == ["tipping"]


def test_an_overhanging_arm_tips_an_object_whose_bounds_are_well_supported(table):
    """A foot of 40 mm and an arm on top of it: long, and the centre of mass is beside the foot; short, and it is over it."""
    foot = [[-0.02, -0.02, 0], [0.02, 0.02, 0.04]]
    for reach, stable in ((0.16, False), (0.06, True)):
        body = solid("L", foot, [[-0.02, -0.02, 0.04], [reach, 0.02, 0.08]])
        share = (reach + 0.02) / (reach + 0.06)  # of the mass that the arm has
        expected = 0.02 - share * (reach - 0.02) / 2
        report = physics_report(table.poses((0, 0, 0)), Scene.tabletop([body], table.plane))
        assert report.stable.tolist() == [stable]
        assert report.stability_margin.tolist() == pytest.approx([min(expected, 0.02)], abs=1e-6)


def test_feet_of_several_parts_make_one_polygon(table):
    legs = [[[x, y, 0], [x + 0.02, y + 0.02, 0.1]] for x in (-0.1, 0.08) for y in (-0.1, 0.08)]
    top = [[-0.1, -0.1, 0.1], [0.1, 0.1, 0.12]]
    stool = solid("stool", *legs, top)
    assert margins(table.poses((0, 0, 0)), Scene.tabletop([stool], table.plane)) == pytest.approx([0.1])
    two_legs = solid("half", legs[0], legs[1], top)
    assert margins(table.poses((0, 0, 0)), Scene.tabletop([two_legs], table.plane))[0] < 0


@pytest.mark.parametrize("lean", [10, 20, 30])
def test_a_can_on_its_rim_tips(table, can, lean):
    a = math.radians(lean)
    z = 0.04 * math.cos(a) + 0.03 * math.sin(a)
    report = physics_report(table.poses((0, 0, z, (a, 0, 0))), Scene.tabletop([can], table.plane))
    assert report.gap.tolist() == pytest.approx([0], abs=1e-4)  # its rim is a prism's
    assert report.status == ["tipping"]
    # the rim's lowest point, seen from the centre of mass; the less it leans, the more of the rim is near the table
    assert report.stability_margin.tolist() == pytest.approx([0.04 * math.sin(a) - 0.03 * math.cos(a)], abs=6e-3)


def test_a_face_that_is_a_little_askew_counts_as_flat(table, box):
    """Up to the tolerance in angle; half of it costs next to nothing."""
    for share, stable in ((0.5, True), (0.9, True), (1.2, False)):
        a = share * TILT
        z = 0.02 * math.cos(a) + 0.03 * math.sin(a)
        report = physics_report(table.poses((0, 0, z, (a, 0, 0))), Scene.tabletop([box], table.plane))
        assert report.stable.tolist() == [stable], share
        if share == 0.5:
            assert report.stability_margin.tolist() == pytest.approx([0.03], abs=2e-3)


def test_a_ball_rolls_on_a_spot(table):
    """Margins of a ball and of a lying can are those of the tilt that is allowed for, however near their sides are."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    ball = Body("ball", ConvexParts.from_hulls([np.array(mesh.vertices)]), mesh)
    lowest = -float(mesh.vertices[:, 2].min())
    margin = margins(table.poses((0, 0, lowest)), Scene.tabletop([ball], table.plane))[0]
    assert -1e-3 < margin < 1.5 * 0.04 * math.tan(TILT)


def test_what_nothing_carries_is_not_stable(table, box):
    slab = Static(Body.box((0.1, 0.1, 0.1), label="slab"), table.at(0.5, 0, 0))
    report = physics_report(table.poses((0, 0, 0.5)), Scene([box], [slab], gravity=table.gravity))
    assert report.stability_margin.tolist() == [-INF]
    assert report.stable.tolist() == [False]
    assert report.supporter == ["-"]


def test_without_gravity_stability_is_unknown(table, box):
    report = physics_report(table.poses((0, 0, 0.02)), Scene([box], [Static(table.plane)]))
    assert math.isnan(float(report.stability_margin))
    assert report.stable.tolist() == [False]
    assert report.status == ["free"]


def test_a_lesser_alternative_carries_nobody(table, box, can):
    """The can stands on the second of two estimates of one box; it is not there if the first is the better one."""
    scene = Scene(
        [box, box, can],
        [Static(table.plane)],
        gravity=table.gravity,
        same_object=torch.tensor([0, 0, 1]),
    )
    poses = table.poses((-0.02, 0, -0.02), (0, 0, 0.02), (0, 0, 0.0803))
    held = physics_report(poses, scene, scores=torch.tensor([0.1, 0.9, 0.5]))
    assert held.supporter[2] == "box"
    assert held.stable.tolist()[2] is True
    dropped = physics_report(poses, scene, scores=torch.tensor([0.9, 0.1, 0.5]))
    assert dropped.stability_margin.tolist()[2] == pytest.approx(0.03, abs=1e-3)  # on the box inside the table


@pytest.fixture
def heap(table, box, can, angle):
    """A can near the edge of a box, an angle on the table half on a static slab, and something in the air."""
    slab = Static(Body.box((0.2, 0.2, 0.05), label="slab"), table.at(0.3, 0.4, 0.025))
    scene = Scene([box, can, angle, box], [Static(table.plane), slab], gravity=table.gravity)
    rows = [(0, 0, 0.02), (0.045, 0.01, 0.0802, (0.01, 0.02, 0.3)), (0.19, 0.4, 0.0501), (0, 0.5, 0.03, (0.2, 0, 0))]
    return scene, table.poses(*rows)


def moved(scene, X):
    """The scene as a camera sees it that has moved."""
    statics = []
    for s in scene.statics:
        if isinstance(s.shape, Plane):
            normal = X[:3, :3] @ s.shape.normal
            statics.append(Static(Plane(normal, s.shape.offset + normal @ X[:3, 3]), image=s.image))
        else:
            statics.append(Static(s.shape, X @ s.T_camera_body, s.image))
    return Scene(
        scene.objects, statics, gravity=scene.gravity @ X[:3, :3].T, image=scene.image, same_object=scene.same_object
    )


def test_moving_camera_objects_and_statics_together_changes_nothing(heap):
    scene, poses = heap
    assert_camera_frame_invariant(lambda X: physics_report(X @ poses, moved(scene, X)).stability_margin, atol=1e-6)


def test_hypotheses_are_judged_each_on_its_own(heap):
    scene, poses = heap
    other = poses.clone()
    other[1, :3, 3] += 0.03 * poses[0, :3, 0]
    both = physics_report(torch.stack([poses, other]), scene)
    assert both.stable.shape == both.stability_margin.shape == (2, 4)
    for margin, alone in zip(both.stability_margin, (poses, other), strict=True):
        torch.testing.assert_close(margin, physics_report(alone, scene).stability_margin, atol=1e-9, rtol=0)
    assert both.stable[:, 1].tolist() == [True, False]
    assert both.supporter == physics_report(poses, scene).supporter + physics_report(other, scene).supporter


def test_many_images_are_each_as_alone(heap, table, can):
    scene, poses = heap
    another = Scene.tabletop([can], table.plane), table.poses((0, 0, 0.04))
    free = Scene([can]), table.poses((0, 0, 0.04))
    many = [(scene, poses), another, (Scene([]), poses[:0]), free, (scene, poses)]
    report = physics_report(torch.cat([p for _, p in many]), Scene.cat([s for s, _ in many]))
    alone = torch.cat([physics_report(p, s).stability_margin for s, p in many])
    torch.testing.assert_close(report.stability_margin, alone, atol=1e-9, rtol=0, equal_nan=True)


@pytest.mark.parametrize("backend", ["warp", "fcl"])
def test_backends_agree(heap, backend):
    scene, poses = heap
    expected = physics_report(poses, scene).stability_margin
    torch.testing.assert_close(
        physics_report(poses, scene, backend=backend).stability_margin, expected, atol=1e-4, rtol=0
    )


def test_single_precision_comes_back_and_says_the_same(heap):
    scene, poses = heap
    report = physics_report(poses.float(), scene)
    assert report.stability_margin.dtype == torch.float32
    assert report.stable.dtype == torch.bool
    torch.testing.assert_close(
        report.stability_margin.double(), physics_report(poses, scene).stability_margin, atol=1e-5, rtol=0
    )


def test_poses_and_planes_that_change_later_are_not_seen(table, box):
    plane = Plane(table.plane.normal.clone(), table.plane.offset.clone())
    poses = table.poses((0, 0, 0.02))
    report = physics_report(poses, Scene.tabletop([box], plane))
    poses[0] = table.at(0, 0, 0.2, (1.0, 0, 0))
    plane.offset.sub_(1.0)
    assert report.stability_margin.tolist() == pytest.approx([0.03], abs=1e-6)


def test_reading_it_in_inference_mode_works_and_it_is_worked_out_once(table, box):
    with torch.inference_mode():
        report = physics_report(table.poses((0, 0, 0.02)), Scene.tabletop([box], table.plane))
        first = report.stability_margin
    assert report.stability_margin is first
    assert not first.is_inference()


def test_no_object_no_margin(table):
    report = physics_report(torch.zeros(0, 4, 4), Scene([], [Static(table.plane)], gravity=table.gravity))
    assert report.stable.shape == (0,)
    assert report.supporter == []


def test_the_polygon_is_that_of_the_convex_hull(table):
    """Prisms with random bottoms, against the hull of the bottom."""
    from scipy.spatial import ConvexHull

    rng = np.random.default_rng(0)
    bodies, expected = [], []
    for _ in range(20):
        bottom = rng.uniform(-0.05, 0.05, size=(rng.integers(3, 9), 2))
        hull = ConvexHull(bottom)
        points = np.concatenate([np.c_[bottom[hull.vertices], np.full(len(hull.vertices), z)] for z in (0, 0.03)])
        mesh = trimesh.convex.convex_hull(points)
        bodies.append(Body("prism", ConvexParts.from_hulls([points]), mesh))
        center = bodies[-1].center_of_mass.numpy()[:2]
        expected.append(-(hull.equations[:, :2] @ center + hull.equations[:, 2]).max())
    poses = table.poses(*((i, 0, 0, (0, 0, i)) for i in range(20)))
    assert margins(poses, Scene.tabletop(bodies, table.plane)) == pytest.approx(expected, abs=2e-4)


@pytest.mark.slow
def test_everything_in_generated_scenes_is_stable_on_what_it_stands_on():
    bodies = {name: Body.from_mesh(mesh, label=name) for name, mesh in household_meshes().items()}
    for seed in range(10):
        made = household_scene(seed)
        plane = Plane(made.normal, torch.tensor(made.offset, dtype=torch.float64))
        report = physics_report(made.T_camera_object, Scene.tabletop([bodies[n] for n in made.names], plane))
        assert report.stable.all(), f"seed {seed}\n{report}"
        # neighbours may be nearer than the approximation of a wall, so who carries is only asked of those on the table
        for name, true, found in zip(made.names, made.supports, report.supporter, strict=True):
            assert found == {"table": "plane"}.get(true, true), f"seed {seed}: {name}"


@pytest.mark.data
@pytest.mark.slow
def test_true_poses_of_real_objects_on_a_table_are_stable(ycbv):
    """All of one image in each of eight scenes that are told to stand on the plane; others are inside each other there."""
    from physpose_torch.bop.dataset import BopDataset
    from physpose_torch.bop.formats import read_planes
    from physpose_torch.bop.scenes import BodyLibrary, plane_of

    dataset = BopDataset(ycbv)
    library = BodyLibrary(dataset)
    planes, _ = read_planes(ycbv / "table_planes.json")
    stable = []
    for scene_id in sorted({scene for scene, _ in planes}):
        image = min(im for scene, im in planes if scene == scene_id)
        truth = dataset.ground_truth(scene_id)
        rows = np.flatnonzero(truth.im_id == image)
        scene = Scene.tabletop([library.model(int(i)) for i in truth.obj_id[rows]], plane_of(planes[scene_id, image]))
        report = physics_report(truth.T_camera_object[rows], scene)
        stable += [s for s, by in zip(report.stable.tolist(), report.supporter, strict=True) if by == "plane"]
    assert len(stable) > 20
    assert np.mean(stable) > 0.9
