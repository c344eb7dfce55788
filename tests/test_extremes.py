"""Whatever the sizes, distances, overlaps and scores: finite, deterministic, and what is left alone is left alone exactly."""

import math
import warnings

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from physpose_torch import se3
from physpose_torch.config import RefinerConfig
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static

lengths = st.floats(1e-3, 2.0)
places = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.05, 3.0))
turns = st.tuples(*[st.floats(-3.2, 3.2)] * 3)
objects = st.lists(st.tuples(st.integers(0, 2), places, turns, st.floats(0, 1)), min_size=0, max_size=5)
planes = st.none() | st.tuples(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(-2, 2), st.sampled_from([0.0, 2e-3, 0.05]))


def made(bodies, rows, plane, images):
    """Poses, scores and scene; a plane may be anywhere, a wall or a ceiling, too."""
    poses = [
        se3.from_rotation_translation(
            se3.exp_so3(torch.tensor(w, dtype=torch.float64)), torch.tensor(t, dtype=torch.float64)
        )
        for _, t, w, _ in rows
    ]
    poses = torch.stack(poses) if rows else torch.zeros(0, 4, 4, dtype=torch.float64)
    statics, gravity = [], None
    if plane is not None:
        normal = torch.tensor(plane[0], dtype=torch.float64)
        length = normal.norm()
        normal = normal / length if length > 0.1 else torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        sigma = torch.diag(torch.tensor([plane[2], plane[2], plane[2]], dtype=torch.float64) ** 2)
        offset = torch.tensor(plane[1], dtype=torch.float64)
        statics = [Static(Plane(normal, offset, sigma if plane[2] else None), image=i) for i in range(images)]
        gravity = -normal
    image = torch.arange(len(rows)) % images
    scene = Scene([bodies[k] for k, *_ in rows], statics, gravity=gravity, image=image, n_images=images)
    return poses, torch.tensor([s for *_, s in rows], dtype=torch.float64), scene


@pytest.mark.parametrize("config", [RefinerConfig(), RefinerConfig.lm()], ids=["descent", "lm"])
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    sizes=st.tuples(*[st.tuples(lengths, lengths, lengths)] * 3), rows=objects, plane=planes, images=st.integers(1, 2)
)
def test_refinements_are_finite_repeat_and_leave_alone_exactly(config, sizes, rows, plane, images):
    bodies = [Body.box(size, label=f"box {i}") for i, size in enumerate(sizes)]
    poses, scores, scene = made(bodies, rows, plane, images)
    refiner = PhysPoseRefiner(config)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result, again = refiner(poses, scene, scores=scores), refiner(poses, scene, scores=scores)
    assert bool(result.poses.isfinite().all())
    assert torch.equal(result.poses, again.poses)
    assert result.doubts == again.doubts
    se3.check_rigid(result.poses, "refined")
    kept = result.rejected | result.unsupported | result.doubted[scene.image]
    assert torch.equal(result.poses[kept], poses[kept])
    assert not (result.rejected & result.unsupported).any()
    assert all(bool(x.isfinite().all()) for x in result.terms)
    report = physics_report(result.poses, scene, scores=scores)
    torch.testing.assert_close(report.penetration, result.report.penetration, atol=1e-9, rtol=0)
    covariance = result.covariance
    assert bool(covariance.isfinite().all())
    assert not len(rows) or float(torch.linalg.eigvalsh(covariance).min()) > 0


@pytest.mark.parametrize("copies", [2, 12])
def test_any_number_of_bodies_in_one_place(copies, table, can):
    """All but one contradict it, and are left where they are."""
    poses = table.at(0, 0, 0.04).expand(copies, 4, 4).clone()
    result = PhysPoseRefiner()(poses, Scene.tabletop([can] * copies, table.plane))
    assert int((~result.rejected).sum()) == 1
    assert torch.equal(result.poses[result.rejected], poses[result.rejected])
    assert float((result.poses - poses).abs().max()) < 1e-3


@pytest.mark.parametrize("factor", [0.02, 0.3, 20.0])
def test_scenes_of_any_size_come_to_rest(factor):
    """The same scene, all lengths times a factor: what is stated in metres stays as it is, so not quite the same result."""
    size = torch.tensor([0.1, 0.06, 0.04], dtype=torch.float64) * factor
    body = Body.box(size, label="box")
    up = torch.tensor([0.0, -math.cos(0.7), -math.sin(0.7)], dtype=torch.float64)
    plane = Plane(up, torch.tensor(-0.6 * factor, dtype=torch.float64))
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    R = torch.stack([x, torch.linalg.cross(up, x), up], dim=1)
    foot = plane.offset * up + torch.tensor([0, 0, 0], dtype=torch.float64)
    places = [foot + factor * (0.02 - 0.004) * up + factor * d * x for d in (-0.2, 0.0, 0.2)]
    poses = torch.stack([se3.from_rotation_translation(R, p) for p in places])
    result = PhysPoseRefiner()(poses, Scene.tabletop([body] * 3, plane))
    assert float(result.report.penetration.max()) < 1.5e-3 * max(factor, 1)
    assert not result.rejected.any()
