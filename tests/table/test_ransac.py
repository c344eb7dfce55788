"""RANSAC finds planes among outliers and scales in spite of wrong depths, the same for the same seed."""

import pytest
import torch

from physpose_torch.errors import InvalidInputError
from physpose_torch.table.ransac import _draw, _pairs, ransac_plane, ransac_scale

NORMAL = torch.nn.functional.normalize(torch.tensor([0.1, -0.7, -0.6], dtype=torch.float64), dim=0)
OFFSET = -0.55


def uniform(*shape, seed=0, low=-1.0, high=1.0):
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def on_plane(count, *, noise=0.0, seed=0):
    """Points (count, 3) within a metre of each other."""
    points = uniform(count, 3, seed=seed)
    height = points @ NORMAL - OFFSET - noise * normal(count, seed=seed + 1)
    return points - height[:, None] * NORMAL


def with_outliers(share, *, count=400, noise=0.002, seed=0):
    good = round((1 - share) * count)
    return torch.cat([on_plane(good, noise=noise, seed=seed), uniform(count - good, 3, seed=seed + 7)]), good


def angle(a, b):
    return float(torch.linalg.cross(a, b).norm().asin())


@pytest.mark.parametrize("share", [0.0, 0.5, 0.7])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_plane_is_found_among_outliers_as_well_as_its_points_know_it(share, seed):
    """The least-squares plane of M points with noise s is known to about s / sqrt(M) per metre."""
    points, good = with_outliers(share, seed=seed)
    (n, d), info = ransac_plane(points, tolerance=0.008)
    assert angle(n, NORMAL) < 6 * 0.002 / good**0.5
    assert abs(float(d) - OFFSET) < 6 * 0.002 / good**0.5
    assert float(n.norm()) == pytest.approx(1.0)
    assert int(info.inliers[:good].sum()) > 0.98 * good
    assert float(info.inliers[good:].double().mean() if good < 400 else 0.0) < 0.05


def test_a_plane_through_exact_points_is_exact():
    (n, d), info = ransac_plane(on_plane(50), tolerance=1e-6)
    assert angle(n, NORMAL) < 1e-12
    assert float(d) == pytest.approx(OFFSET, abs=1e-12)
    assert bool(info.inliers.all())
    assert float(info.residual.max()) < 1e-12


def test_the_same_seed_finds_the_same():
    points, _ = with_outliers(0.7, noise=0.004)
    (n0, d0), i0 = ransac_plane(points, tolerance=0.004, samples=30, seed=3)
    (n1, d1), i1 = ransac_plane(points, tolerance=0.004, samples=30, seed=3)
    assert torch.equal(n0, n1)
    assert torch.equal(d0, d1)
    assert torch.equal(i0.inliers, i1.inliers)
    others = [ransac_plane(points, tolerance=0.004, samples=30, seed=s)[0][1] for s in range(4, 9)]
    assert any(not torch.equal(d0, d) for d in others)


def test_the_global_random_state_is_left_alone():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    ransac_plane(on_plane(10), tolerance=0.01)
    ransac_scale(on_plane(10), on_plane(10), torch.zeros(10, dtype=torch.int64), tolerance=0.1)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_camera_is_on_the_upper_side(sign):
    (n, d), _ = ransac_plane(sign * on_plane(50), tolerance=0.01)
    assert float(d) == pytest.approx(OFFSET)
    assert torch.allclose(n, sign * NORMAL)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_plane_may_be_given_in_any_unit(unit):
    points, _ = with_outliers(0.5)
    (n, d), info = ransac_plane(points, tolerance=0.008)
    (n_, d_), info_ = ransac_plane(unit * points, tolerance=unit * 0.008)
    assert torch.allclose(n, n_)
    assert float(d_) == pytest.approx(unit * float(d))
    assert torch.equal(info.inliers, info_.inliers)


@pytest.mark.parametrize(
    "points",
    [
        torch.zeros(0, 3),
        torch.rand(1, 3),
        torch.rand(2, 3),
        torch.ones(9, 3),
        torch.linspace(0, 1, 9, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0, -1.0]) + 0.3,
    ],
    ids=["none", "one", "two", "equal", "collinear"],
)
def test_what_spans_no_plane_gives_none(points):
    plane, info = ransac_plane(points, tolerance=0.01)
    assert plane is None
    assert info.inliers.tolist() == [False] * len(points)
    assert bool(info.residual.isinf().all())


def test_info_tells_distances_and_the_number_of_samples():
    points, _ = with_outliers(0.5)
    (n, d), info = ransac_plane(points, tolerance=0.01, samples=123)
    assert info.samples == 123
    torch.testing.assert_close(info.residual, (points @ n - d).abs())
    assert torch.equal(info.inliers, info.residual < 0.01)


def test_points_in_float32_are_judged_in_float64():
    (n, d), _ = ransac_plane(on_plane(50).float(), tolerance=0.01)
    assert n.dtype == d.dtype == torch.float64


@pytest.mark.parametrize(
    "spoil",
    [
        dict(tolerance=0.0),
        dict(tolerance=-1.0),
        dict(tolerance=float("nan")),
        dict(points=torch.rand(9, 2)),
        dict(points=torch.rand(3)),
        dict(points=torch.ones(9, 3, dtype=torch.int64)),
        dict(points=torch.full((9, 3), torch.nan)),
        dict(points=torch.full((9, 3), torch.inf)),
    ],
    ids=["zero", "negative", "NaN tolerance", "2-D", "one point", "integers", "NaN", "infinite"],
)
def test_bad_arguments_are_refused(spoil):
    points, tolerance = spoil.get("points", torch.rand(9, 3)), spoil.get("tolerance", 0.1)
    with pytest.raises(InvalidInputError, match="tolerance" if "tolerance" in spoil else "points"):
        ransac_plane(points, tolerance=tolerance)
    with pytest.raises(InvalidInputError, match="tolerance" if "tolerance" in spoil else "points"):
        ransac_scale(points, points, torch.zeros(9, dtype=torch.int64), tolerance=tolerance)


class Objects:
    """Points on objects of 0.1 m about a metre away, and the same in a reconstruction that is 1 / 2.5 of it."""

    scale = 2.5

    def __init__(self, counts=(40, 30, 20), seed=0):
        self.owner = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
        centres = uniform(len(counts), 3, seed=seed) + torch.tensor([0.0, 0.0, 2.0])
        self.target = centres[self.owner] + 0.05 * uniform(len(self.owner), 3, seed=seed + 1)
        self.source = self.target / self.scale

    def find(self, *, tolerance=0.05, **options):
        return ransac_scale(self.source, self.target, self.owner, tolerance=tolerance, **options)


def test_an_exact_scale_is_exact():
    scale, info = Objects().find()
    assert float(scale) == pytest.approx(2.5, rel=1e-12)
    assert scale.shape == ()
    assert bool(info.inliers.all())
    assert float(info.residual.max()) < 1e-12
    assert info.samples == 1000


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_points_without_a_depth_are_refused(value):
    objects = Objects()
    objects.target[7, 2] = value
    with pytest.raises(InvalidInputError, match="target contains NaN or infinity"):
        objects.find()


def test_objects_at_wrong_depths_do_no_harm():
    """Each object is moved along its ray by 3 %: ratios of depths would be off, distances on each object are not."""
    objects = Objects()
    wrong = 0.03 * torch.tensor([1.0, -1.0, 0.7], dtype=torch.float64)
    centres = torch.stack([objects.target[objects.owner == k].mean(0) for k in range(3)])
    objects.target = objects.target + (wrong[:, None] * centres)[objects.owner]
    scale, info = objects.find()
    assert float(scale) == pytest.approx(2.5, rel=1e-9)
    assert bool(info.inliers.all())


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_wrong_correspondences_do_no_harm(share):
    objects = Objects((100, 80, 60), seed=3)
    bad = uniform(len(objects.owner), low=0.0, seed=5) < share
    objects.target = torch.where(bad[:, None], objects.target + 0.1 * normal(*objects.target.shape, seed=6), objects.target)
    objects.source = objects.source * (1 + 0.0003 * normal(*objects.source.shape, seed=8))
    scale, info = objects.find(samples=2000)
    assert float(scale) == pytest.approx(2.5, rel=0.005)
    if share < 0.5:
        assert float(info.inliers[~bad].double().mean()) > 0.9
    assert float(info.inliers[bad].double().mean()) < 0.05


def test_the_scale_is_that_of_most_pairs_not_of_their_mean():
    objects = Objects((80, 30))
    objects.target = torch.where((objects.owner == 1)[:, None], 1.5 * objects.target, objects.target)
    scale, info = objects.find()
    assert float(scale) == pytest.approx(2.5, rel=1e-9)
    assert torch.equal(info.inliers, objects.owner == 0)


def test_long_pairs_count_more():
    """Of a crumb, on which 60 points are known to a tenth of its size, nothing is learned beside a box of 0.1 m."""
    errors = []
    for seed in range(8):
        objects = Objects((60, 40), seed=10 * seed)
        crumb = (objects.owner == 0)[:, None]
        centre = objects.target[:1]
        objects.target = torch.where(crumb, centre + 0.06 * (objects.target - centre), objects.target)
        objects.source = objects.target / 2.5
        objects.target = objects.target + 0.0003 * normal(*objects.target.shape, seed=seed)
        errors.append(abs(float(objects.find(tolerance=0.2)[0]) / 2.5 - 1))
    assert max(errors) < 0.002


@pytest.mark.parametrize("counts", [(), (1,), (1, 1, 1)], ids=["none", "one", "three alone"])
def test_no_two_points_on_one_object_give_no_scale(counts):
    owner = torch.arange(len(counts))
    points = uniform(len(counts), 3)
    scale, info = ransac_scale(points, points, owner, tolerance=0.1)
    assert scale is None
    assert info.inliers.tolist() == [False] * len(counts)
    assert bool(info.residual.isinf().all())


def test_equal_points_give_no_scale():
    points = torch.ones(6, 3, dtype=torch.float64)
    assert ransac_scale(points, points, torch.zeros(6, dtype=torch.int64), tolerance=0.1)[0] is None


def test_a_point_alone_on_its_object_is_no_inlier():
    objects = Objects((30, 1))
    scale, info = objects.find()
    assert float(scale) == pytest.approx(2.5)
    assert info.inliers.tolist() == [True] * 30 + [False]
    assert float(info.residual[-1]) == torch.inf


def test_the_same_seed_finds_the_same_scale():
    objects = Objects()
    objects.target = objects.target + 0.003 * normal(*objects.target.shape)
    assert torch.equal(objects.find(seed=5)[0], objects.find(seed=5)[0])
    assert not torch.equal(objects.find(seed=5)[0], objects.find(seed=6)[0])


@pytest.mark.parametrize("other", ["target", "owner"])
def test_unequal_numbers_of_points_are_refused(other):
    objects = Objects()
    setattr(objects, other, getattr(objects, other)[:-1])
    with pytest.raises(InvalidInputError, match="target is"):
        objects.find()


@pytest.mark.parametrize("count", [3, 4, 9])
def test_draws_are_of_different_indices_and_all_equally_likely(count):
    drawn = _draw(count, 3, 6000, seed=0)
    assert drawn.shape == (6000, 3)
    assert bool(((drawn >= 0) & (drawn < count)).all())
    assert all(len(set(row)) == 3 for row in drawn.tolist())
    for column in drawn.unbind(1):
        share = torch.bincount(column, minlength=count) / 6000
        assert float((share - 1 / count).abs().max()) < 0.025
    assert len({tuple(sorted(row)) for row in drawn.tolist()}) == (count * (count - 1) * (count - 2)) // 6
    assert torch.equal(_draw(count, 3, 50, seed=1), _draw(count, 3, 50, seed=1))
    assert not torch.equal(_draw(9, 3, 50, seed=1), _draw(9, 3, 50, seed=2))


def test_too_few_to_draw_from_give_no_draws():
    assert _draw(2, 3, 100, seed=0).shape == (0, 3)


def test_pairs_are_two_different_points_of_one_object():
    owner = torch.tensor([2, 0, 2, 5, 0, 2, 7, 7])  # unordered; object 5 is alone
    first, second = _pairs(owner, 5000, seed=0)
    assert len(first) == len(second) == 5000
    assert bool((first != second).all())
    assert torch.equal(owner[first], owner[second])
    assert not bool((owner[first] == 5).any())
    pairs = {tuple(sorted(p)) for p in zip(first.tolist(), second.tolist(), strict=True)}
    assert pairs == {(0, 2), (0, 5), (2, 5), (1, 4), (6, 7)}
    # objects with more points are drawn more often
    assert float((owner[first] == 2).double().mean()) == pytest.approx(3 / 7, abs=0.03)
