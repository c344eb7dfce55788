"""The report's numbers by hand, and the words made of them."""

import dataclasses
import json
import math

import pytest
import torch

from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static

INF = float("inf")


def test_a_box_5_mm_inside_the_table(table, box):
    report = physics_report(table.poses((0, 0, 0.015)), Scene.tabletop([box], table.plane))
    assert report.penetration_static.tolist() == pytest.approx([0.005], abs=1e-9)
    assert report.penetration_object.tolist() == [0.0]
    assert report.penetration.tolist() == pytest.approx([0.005], abs=1e-9)
    assert report.gap.tolist() == [0.0]
    assert report.support.tolist() == [1]
    assert report.status == ["penetrating"]


def test_a_box_7_mm_above_the_table(table, box):
    report = physics_report(table.poses((0, 0, 0.027)), Scene.tabletop([box], table.plane))
    assert report.penetration.tolist() == [0.0]
    assert report.gap.tolist() == pytest.approx([0.007], abs=1e-9)
    assert report.support.tolist() == [1]
    assert report.status == ["floating"]


def test_a_stack_rests_on_the_table_and_on_each_other(table, box, can):
    report = physics_report(table.poses((0, 0, 0.02), (0, 0, 0.0803)), Scene.tabletop([box, can], table.plane))
    assert report.gap.tolist() == pytest.approx([0.0, 3e-4], abs=1e-7)
    assert report.support.tolist() == [2, 0]
    assert report.status == ["resting", "resting"]


def test_the_deeper_of_two_penetrations_counts(table, box):
    """Two boxes 4 mm inside each other, one of them 6 mm inside the table, and a static slab 2 mm inside the other."""
    slab = Static(Body.box((0.1, 0.1, 0.1), label="slab"), table.at(0.194, 0, 0.05))
    scene = Scene([box, box], [Static(table.plane), slab], gravity=table.gravity)
    report = physics_report(table.poses((0, 0, 0.014), (0.096, 0, 0.02)), scene)
    assert report.penetration_static.tolist() == pytest.approx([0.006, 0.002], abs=1e-7)
    assert report.penetration_object.tolist() == pytest.approx([0.004, 0.004], abs=1e-7)
    assert report.penetration.tolist() == pytest.approx([0.006, 0.004], abs=1e-7)


def test_nothing_below_is_unsupported_and_no_gravity_is_free(table, box):
    slab = Static(Body.box((0.1, 0.1, 0.1), label="slab"), table.at(0.5, 0, 0))
    unsupported = physics_report(table.poses((0, 0, 0.5)), Scene([box], [slab], gravity=table.gravity))
    assert unsupported.gap.tolist() == [INF]
    assert unsupported.support.tolist() == [-1]
    assert unsupported.status == ["unsupported"]
    free = physics_report(table.poses((0, 0, 0.5)), Scene([box], [Static(table.plane)]))
    assert math.isnan(float(free.gap))
    assert free.support.tolist() == [-1]
    assert free.status == ["free"]


def test_alternatives_of_one_object_do_not_penetrate_each_other(table, box):
    poses = table.poses((0, 0, 0.02), (0.01, 0, 0.02))
    both = physics_report(poses, Scene.tabletop([box, box], table.plane))
    assert both.penetration_object.tolist() == pytest.approx([0.04, 0.04], abs=1e-6)
    same = torch.tensor([0, 0])
    one = physics_report(poses, Scene([box, box], [Static(table.plane)], gravity=table.gravity, same_object=same))
    assert one.penetration_object.tolist() == [0.0, 0.0]
    assert one.support.tolist() == [2, 2]


@pytest.mark.parametrize("leading", [(), (1,), (2,), (2, 3)], ids=str)
def test_supports_are_numbered_as_in_the_one_scene_also_with_hypotheses(leading, table, box, can):
    """Two images: a can on a box on the table, and a can on a static slab; another box hangs over the table."""
    slab = Static(Body.box((0.2, 0.2, 0.05), label="slab"), table.at(0, 0.4, 0.025), 1)
    scene = Scene(
        [box, can, can, box],
        [Static(table.plane), slab, Static(table.plane, image=1)],
        gravity=table.gravity,
        image=torch.tensor([0, 0, 1, 1]),
    )
    poses = table.poses((0, 0, 0.02), (0, 0, 0.08), (0, 0.4, 0.09), (0, 0, 0.03))
    report = physics_report(poses.expand(*leading, 4, 4, 4), scene)
    assert report.support.shape == (*leading, 4)
    # objects 0-3, slab 4, planes 5 and 6
    assert report.support.reshape(-1, 4).tolist() == [[5, 0, 4, 6]] * math.prod(leading)
    assert torch.allclose(report.gap, torch.tensor([0, 0, 0, 0.01], dtype=torch.float64), atol=1e-7)
    assert report.status == ["resting", "resting", "resting", "floating"] * math.prod(leading)


def test_the_text_has_a_line_for_each_object_in_millimetres(table, box, can):
    scene = Scene.tabletop([box, can], table.plane)
    poses = table.poses((0, 0, 0.015), (0.3, 0, 0.047))
    lines = str(physics_report(poses, scene)).splitlines()
    assert len(lines) == 3
    assert lines[1].split() == ["box", "5.00", "0.00", "0.00", "plane", "yes", "penetrating"]
    assert lines[2].split() == ["can", "0.00", "0.00", "7.00", "plane", "yes", "floating"]
    assert lines[0].index("carried by") == lines[1].index("plane") == lines[2].index("plane")
    assert lines[0].index("gap") + 3 == lines[1].index("0.00  plane") + 4
    assert len(str(physics_report(poses.expand(3, 2, 4, 4), scene)).splitlines()) == 7


def test_what_is_unknown_or_endless_is_a_dash_in_the_text(table, box):
    free = physics_report(table.poses((0, 0, 0.5)), Scene([box], [Static(table.plane)]))
    assert str(free).splitlines()[1].split() == ["box", "0.00", "0.00", "-", "-", "-", "free"]
    slab = Static(Body.box((0.1, 0.1, 0.1), label="slab"), table.at(0.5, 0, 0))
    unsupported = physics_report(table.poses((0, 0, 0.5)), Scene([box], [slab], gravity=table.gravity))
    assert str(unsupported).splitlines()[1].split() == ["box", "0.00", "0.00", "-", "-", "no", "unsupported"]


@pytest.mark.parametrize("leading", [(), (2,), (2, 3)], ids=str)
def test_what_carries_an_object_has_a_name(leading, table, box, can):
    slab = Static(Body.box((0.2, 0.2, 0.05), label="slab"), table.at(0, 0.4, 0.025))
    scene = Scene([box, can, can], [Static(table.plane), slab], gravity=table.gravity)
    poses = table.poses((0, 0, 0.02), (0, 0, 0.08), (0, 0.4, 0.09)).expand(*leading, 3, 4, 4)
    assert physics_report(poses, scene).supporter == ["plane", "box", "slab"] * math.prod(leading)


def test_an_object_in_contact_that_would_fall_over_is_tipping(table, box, can):
    """The can stands 10 mm beyond the edge of the box; sunk in or in the air it is called that first."""
    x = 0.05 + 0.01
    for height, word in ((0.08, "tipping"), (0.077, "penetrating"), (0.084, "floating")):
        report = physics_report(table.poses((0, 0, 0.02), (x, 0, height)), Scene.tabletop([box, can], table.plane))
        assert report.status[1] == word
        assert report.stable.tolist() == [True, False]


def test_as_a_dict_it_is_plain_numbers_in_metres_that_json_can_hold(table, box):
    slab = Static(Body.box((0.1, 0.1, 0.1), label="slab"), table.at(0.5, 0, 0))
    scene = Scene([box, box], [Static(table.plane), slab], gravity=table.gravity)
    first, second = physics_report(table.poses((0, 0, 0.015), (0, 0.3, 0.03)), scene).to_dict()["objects"]
    assert first["label"] == "box"
    assert first["penetration_static"] == pytest.approx(0.005, abs=1e-9)
    assert first["stability_margin"] == pytest.approx(0.03, abs=1e-6)
    assert (first["support"], first["stable"], first["status"]) == ("plane", True, "penetrating")
    assert second["gap"] == pytest.approx(0.01, abs=1e-9)
    nowhere = physics_report(table.poses((0, 0, 0.5)), Scene([box], [slab], gravity=table.gravity)).to_dict()
    free = physics_report(table.poses((0, 0, 0.5)), Scene([box])).to_dict()
    json.dumps([nowhere, free], allow_nan=False)
    assert nowhere["objects"][0]["gap"] is None
    assert nowhere["objects"][0]["stable"] is False
    assert free["objects"][0]["stable"] is None


def test_a_report_with_other_numbers_is_as_stable(table, box):
    """The refiner replaces lengths by those of the caller's precision."""
    report = physics_report(table.poses((0, 0, 0.02)), Scene.tabletop([box], table.plane))
    other = dataclasses.replace(report, gap=report.gap.float())
    assert other.stable.tolist() == [True]
    assert other.stability_margin.dtype == torch.float32


def test_the_report_of_a_refinement_knows_stability(table, box):
    refined = PhysPoseRefiner()(table.poses((0, 0, 0.01)).float(), Scene.tabletop([box], table.plane))
    assert refined.report.stable.tolist() == [True]
    assert "stability_margin" in vars(refined.report)
    assert "stability_margin" not in vars(PhysPoseRefiner()(table.poses((0, 0, 0.01)), Scene([box])).report)


def test_an_empty_scene_has_an_empty_report(table):
    report = physics_report(torch.zeros(0, 4, 4), Scene([], [Static(table.plane)], gravity=table.gravity))
    assert report.gap.shape == (0,)
    assert report.status == []
    assert len(str(report).splitlines()) == 1


def test_the_callers_dtype_comes_back_and_nothing_is_tracked(dtype, table, box):
    poses = table.poses((0, 0, 0.015)).to(dtype).requires_grad_()
    for report in (physics_report(poses, Scene.tabletop([box], table.plane)),):
        assert report.penetration.dtype == report.gap.dtype == dtype
        assert report.support.dtype == torch.long
        assert not report.penetration.requires_grad
    with torch.inference_mode():
        inside = physics_report(poses.detach().clone(), Scene.tabletop([box], table.plane))
    assert float(inside.penetration) == pytest.approx(0.005, abs=1e-6)


def test_a_nan_pose_is_refused_with_its_label(table, box, can):
    poses = table.poses((0, 0, 0.02), (0.3, 0, 0.04))
    poses[1, 0, 0] = math.nan
    with pytest.raises(InvalidInputError, match=r"poses\[1\] \(can\) contains NaN"):
        physics_report(poses, Scene.tabletop([box, can], table.plane))
