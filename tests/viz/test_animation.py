"""The moving picture shows the steps of the refinement, red only while something penetrates, and its numbers are true."""

import itertools

import numpy as np
import pytest
import torch
from PIL import Image

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene
from physpose_torch.viz import trajectory_animation

K = torch.tensor([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]], dtype=torch.float64)
SMALL = {"K": K, "height": 480, "width": 640, "column": 120}
BOX = Body.box((0.1, 0.1, 0.1), label="box")
GREY = [(0.6, 0.6, 0.65)]


def rising(table, first=-0.02, steps=4):
    """A box that comes out of the table: (steps + 1, 1, 4, 4)."""
    return torch.stack([table.poses((0, 0, 0.05 + first * (1 - k / steps))) for k in range(steps + 1)])


def red(frame, column=120):
    """Clearly red pixels of the two panels; the numbers below them are red, too."""
    r, g, b = np.asarray(frame).astype(int).transpose(2, 0, 1)[:, 30:-66]
    return int(((r > 1.9 * g) & (r > 1.9 * b) & (r > 110)).sum())


def test_red_shrinks_with_the_penetration_and_is_gone_with_it(table):
    scene = Scene.tabletop([BOX], table.plane)
    animation = trajectory_animation(rising(table), scene, colors=GREY, **SMALL)
    assert animation.steps == [0, 1, 2, 3, 4]
    areas = [red(frame) for frame in animation.frames]
    assert all(a > b for a, b in itertools.pairwise(areas))
    assert areas[0] > 100
    assert areas[-1] == 0
    torch.testing.assert_close(
        animation.penetration, torch.tensor([0.020, 0.015, 0.010, 0.005, 0.0], dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_numbers_are_those_of_the_report(table, box, can):
    trajectory = torch.stack([table.poses((0, 0, 0.02 + h), (0.08 + h, 0.0, 0.04 - h)) for h in (0.012, 0.006, 0.0)])
    scene = Scene.tabletop([box, can], table.plane)
    animation = trajectory_animation(trajectory, scene, **SMALL)
    for k, step in enumerate(animation.steps):
        report = physics_report(trajectory[step], scene)
        assert float(animation.penetration[k]) == pytest.approx(float(report.penetration.max()), abs=1e-9)
        assert float(animation.gap[k]) == pytest.approx(float(report.gap.max()), abs=1e-9)
    assert float(animation.gap[0]) > 0.01


def test_the_file_is_a_gif_that_repeats_with_a_pause_at_its_end(table, tmp_path):
    path = tmp_path / "a.gif"
    scene = Scene.tabletop([BOX], table.plane)
    animation = trajectory_animation(
        rising(table, steps=3), scene, colors=GREY, milliseconds=80, pause=1500, path=path, **SMALL
    )
    with Image.open(path) as gif:
        assert gif.n_frames == len(animation.frames) == 4
        assert gif.info["loop"] == 0
        shown, first, last = [], None, None
        for k in range(gif.n_frames):
            gif.seek(k)
            shown.append(gif.info["duration"])
            first, last = (gif.convert("RGB"), last) if k == 0 else (first, gif.convert("RGB"))
    assert shown == animation.milliseconds == [750, 80, 80, 1500]
    for kept, frame in ((first, animation.frames[0]), (last, animation.frames[-1])):
        error = np.abs(np.asarray(kept).astype(int) - np.asarray(frame))
        assert error.mean() < 3
        assert np.quantile(error, 0.99) < 24
    assert path.stat().st_size < 300_000


def test_long_trajectories_are_thinned_where_nothing_moves(table):
    """First and last step are among them; the fast part at the beginning gets more of the frames than its share of steps."""
    ease = 1 - 0.8 ** torch.arange(41)
    trajectory = torch.stack([table.poses((0, 0, 0.03 + 0.02 * float(e))) for e in ease])
    animation = trajectory_animation(trajectory, Scene.tabletop([BOX], table.plane), frames=8, **SMALL)
    assert animation.steps[0] == 0
    assert animation.steps[-1] == 40
    assert animation.steps == sorted(set(animation.steps))
    assert len(animation.frames) <= 8
    assert sum(step <= 10 for step in animation.steps) >= 4
    assert len(np.asarray(animation.frames[0]).shape) == 3
    assert len({frame.size for frame in animation.frames}) == 1


def test_one_image_of_a_batch_is_that_image_alone(table, box):
    alone = Scene.tabletop([BOX], table.plane)
    both = Scene.cat([Scene.tabletop([box], table.plane), alone])
    trajectory = rising(table, steps=2)
    other = table.poses((0.3, 0, 0.02))[None].repeat(3, 1, 1, 1)
    first = trajectory_animation(trajectory, alone, **SMALL)
    second = trajectory_animation(torch.cat([other, trajectory], 1), both, image=1, **SMALL)
    for a, b in zip(first.frames, second.frames, strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_without_a_table_overlap_is_red_all_the_same():
    T = se3.from_rotation_translation(torch.eye(3, dtype=torch.float64), torch.tensor([0, 0, 0.8]).double())
    apart = T.clone()
    apart[0, 3] = 0.12
    overlapping = T.clone()
    overlapping[0, 3] = 0.07
    trajectory = torch.stack([torch.stack([T, overlapping]), torch.stack([T, apart])])
    animation = trajectory_animation(trajectory, Scene([BOX, BOX]), colors=GREY * 2, **SMALL)
    first, last = (red(frame) for frame in animation.frames)
    assert first > 100
    assert last == 0
    assert animation.gap.tolist() == [0, 0]


def test_bad_input_is_named(table):
    scene, T = Scene.tabletop([BOX], table.plane), rising(table)
    for trajectory, options, message in (
        (None, {}, "keep_trajectory"),
        (T[:, None], {}, "1 hypotheses"),
        (T.repeat(1, 2, 1, 1), {}, r"expected \(T \+ 1, 1, 4, 4\)"),
        (T, {"image": 1}, "has 1 images"),
        (T, {"frames": 1}, "at least 2 frames"),
        (T, {"colors": ["red", "blue"]}, "2 colors for 1 objects"),
        (T, {"meshes": []}, "0 meshes for 1 objects"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            trajectory_animation(trajectory, scene, **{**SMALL, **options})
