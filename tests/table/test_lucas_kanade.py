"""Patches are found where they are to a tenth of a pixel, and their covariances say how well, and in which direction."""

import math

import pytest
import torch

from physpose_torch.table.lucas_kanade import FLOOR, Aligned, align_patches, gray, sample

HEIGHT, WIDTH = 220, 280
EXACT = torch.eye(2, dtype=torch.float64)
TURN = math.radians(6)
MAP = torch.tensor([[1.06 * math.cos(TURN), -math.sin(TURN) + 0.04], [math.sin(TURN), 0.97 * math.cos(TURN)]]).double()
SHIFT = torch.tensor([3.3, -4.7], dtype=torch.float64)
CENTRE = torch.tensor([WIDTH / 2, HEIGHT / 2], dtype=torch.float64)


def grid(spacing=18, border=34):
    x, y = torch.arange(border, WIDTH - border, spacing), torch.arange(border, HEIGHT - border, spacing)
    return torch.cartesian_prod(x, y).double() + 0.3


def pixels():
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return torch.stack([x, y], -1).double()


class Texture:
    """Many waves 7 to 40 pixels long: a function of the plane, so that it can be seen through any map exactly."""

    def __init__(self, seed=0, count=40, direction=None, contrast=60.0):
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64)
        length = 7 * (40 / 7) ** uniform[:, 0]
        angle = 2 * math.pi * uniform[:, 1] if direction is None else torch.full((count,), direction).double()
        self.wave = 2 * math.pi / length[:, None] * torch.stack([angle.cos(), angle.sin()], 1)
        self.phase = 2 * math.pi * uniform[:, 2]
        self.contrast = contrast / count**0.5

    def __call__(self, points):
        flat = points.reshape(-1, 2)
        return (128 + self.contrast * torch.cos(flat @ self.wave.T + self.phase).sum(1)).reshape(points.shape[:-1])


def there(points, map_=MAP):
    """Where points of the first image are in the second."""
    return (points - CENTRE) @ map_.mT + CENTRE + SHIFT


def back(points, map_=MAP):
    return (points - CENTRE - SHIFT) @ torch.linalg.inv(map_).mT + CENTRE


def images(texture, *, map_=MAP, gain=1.0, offset=0.0, noise=0.0, seed=0):
    generator = torch.Generator().manual_seed(1000 + seed)
    pair = [texture(pixels()), 128 + gain * (texture(back(pixels(), map_)) - 128) + offset]
    draws = [noise * torch.randn(HEIGHT, WIDTH, generator=generator, dtype=torch.float64) for _ in pair]
    return [(image + draw).float() for image, draw in zip(pair, draws, strict=True)]


def guess(points, spread, seed=0):
    return points + spread * torch.randn(points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def whitened(found: Aligned, truth):
    """Squared errors (M,) in standard deviations."""
    error = (found.points - truth)[..., None]
    return (error.mT @ torch.linalg.solve(found.covariance, error))[:, 0, 0]


@pytest.mark.parametrize("noise", [0.0, 2.0, 4.0])
def test_patches_are_found_through_an_affine_map_a_gain_and_an_offset(noise):
    points = grid()
    found = align_patches(*images(Texture(), gain=0.7, offset=25.0, noise=noise), points, guess(there(points), 1.5))
    assert float(found.good.double().mean()) > 0.9
    error = (found.points - there(points)).norm(dim=1)[found.good]
    assert float(error.median()) < 0.1
    assert float(error.quantile(0.95)) < 0.3
    assert float((found.affine - MAP)[found.good].abs().median()) < 0.01
    assert float(found.correlation[found.good].min()) > 0.8


@pytest.mark.parametrize("deform", [True, False])
@pytest.mark.parametrize(("contrast", "noise", "least"), [(60, 1, 0), (60, 6, 0.1), (15, 1, 0.1), (15, 3, 0.1), (15, 5, 0.1)])
def test_covariances_are_honest(contrast, noise, least, deform):
    """The median of squared errors in standard deviations is 1.39 where errors are normal; less where the floor is the most."""
    points = grid()
    squared = []
    for seed in range(3):
        pair = images(Texture(seed, contrast=contrast), gain=0.9, offset=-10.0, noise=noise, seed=seed)
        start = guess(there(points), 0.5, seed)
        found = align_patches(*pair, points, start, affine=MAP.expand(len(points), 2, 2), deform=deform)
        squared.append(whitened(found, there(points))[found.good])
    squared = torch.cat(squared)
    assert len(squared) > 200
    assert least < float(squared.median()) < 2.5
    assert float((squared > 25).double().mean()) < 0.03


def test_more_noise_is_known_to_be_worse():
    points = grid()
    spread = []
    for noise in (1.0, 3.0, 9.0):
        found = align_patches(*images(Texture(), noise=noise), points, there(points))
        spread.append(float((found.covariance - FLOOR**2 * EXACT).diagonal(dim1=1, dim2=2).sum(1).sqrt().median()))
    assert 2 < spread[1] / spread[0] < 4
    assert 2 < spread[2] / spread[1] < 5


@pytest.mark.parametrize("deform", [True, False])
@pytest.mark.parametrize("direction", [0.0, 0.5, 2.0])
def test_along_stripes_nothing_is_known_and_across_them_all(direction, deform):
    """The normal of the stripes in the second image is that of the first through the inverse transposed map."""
    points = grid()
    found = align_patches(
        *images(Texture(direction=direction), noise=1.0),
        points,
        there(points),
        affine=MAP.expand(len(points), 2, 2),
        deform=deform,
    )
    across = torch.linalg.inv(MAP).mT @ torch.tensor([math.cos(direction), math.sin(direction)], dtype=torch.float64)
    across /= across.norm()
    along = torch.stack([-across[1], across[0]])
    sigma = [(found.covariance @ d @ d).sqrt() for d in (along, across)]
    good = found.good  # some slide along the stripes and do not come to rest
    assert int(good.sum()) > 15
    assert float(sigma[0][good].median()) > 1.0
    assert float(sigma[1][good].median()) < 0.15
    assert float(((found.points - there(points)) @ across)[good].abs().median()) < 0.1


def test_without_deformation_the_map_stays_as_it_was_given():
    points = grid()
    pair = images(Texture(), noise=1.0)
    start = MAP.expand(len(points), 2, 2)
    found = align_patches(*pair, points, guess(there(points), 1.0), affine=start, deform=False)
    assert torch.equal(found.affine, start)
    assert float((found.points - there(points)).norm(dim=1)[found.good].median()) < 0.1
    free = align_patches(*pair, points, guess(there(points), 1.0), affine=start)
    assert not torch.equal(free.affine, start)


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_a_flat_patch_is_not_known(noise):
    """Neither image shows anything there but noise."""
    points = grid()
    flat = images(Texture(contrast=0.0), noise=noise)
    found = align_patches(*flat, points, there(points))
    assert found.points.isfinite().all()
    assert found.covariance.isfinite().all()
    known = found.good & (found.covariance.diagonal(dim1=1, dim2=2).amin(1) < 1.0)
    assert float(known.double().mean()) < 0.02
    assert float((found.points - there(points)).norm(dim=1).max()) < 12  # it does not run, either


def test_images_of_different_things_have_hardly_a_good_patch():
    points = grid(12)
    found = align_patches(images(Texture(0), noise=2.0)[0], images(Texture(7), noise=2.0)[1], points, there(points))
    assert float(found.good.double().mean()) < 0.1


def test_patches_at_the_border_are_right_or_not_good():
    pair = images(Texture(), noise=1.0)
    ring = torch.tensor([[x, y] for x in (0, 2, 6, WIDTH - 7, WIDTH - 1) for y in range(0, HEIGHT, 9)]).double()
    found = align_patches(*pair, ring, there(ring))
    size = ring.new_tensor([WIDTH - 1, HEIGHT - 1])
    inside = ((there(ring) > 0) & (there(ring) < size)).all(1)
    assert found.points.isfinite().all()
    assert not found.good[~((found.points >= 0) & (found.points <= size)).all(1)].any()
    deep = inside & (torch.minimum(ring, size - ring).amin(1) > 1)
    error = (found.points - there(ring)).norm(dim=1)[found.good & deep]
    assert len(error) > 5
    assert float(error.median()) < 0.3
    beyond = ring - torch.tensor([3.0, 0.0]).double()
    assert not align_patches(*pair, beyond, there(beyond)).good[beyond[:, 0] < 0].any()


def test_images_of_different_sizes_are_compared_all_over():
    """Two cameras need not have equally many pixels."""
    points = grid()
    first, second = images(Texture(), map_=EXACT, noise=1.0)
    cut = torch.tensor([100.0, 60.0], dtype=torch.float64)
    truth = there(points, EXACT) - cut
    inside = ((truth > 12) & (truth < truth.new_tensor([WIDTH - 113, HEIGHT - 73]))).all(1)
    for found in (
        align_patches(first, second[60:, 100:], points[inside], truth[inside]),
        align_patches(second[60:, 100:], first, truth[inside], points[inside]),
    ):
        assert int(inside.sum()) > 20
        assert float(found.good.double().mean()) > 0.9


@pytest.mark.parametrize("deform", [True, False])
def test_a_known_map_may_turn_patches_far(deform):
    points = grid(18, 80)
    turned = MAP @ torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
    start = guess(there(points, turned), 1.0)
    pair = images(Texture(), map_=turned, noise=1.0)
    found = align_patches(*pair, points, start, affine=turned.expand(len(points), 2, 2), deform=deform)
    assert float(found.good.double().mean()) > 0.9
    assert float((found.points - there(points, turned)).norm(dim=1).median()) < 0.1
    assert float(align_patches(*pair, points, start, deform=deform).good.double().mean()) < 0.2  # and is needed


def test_patches_that_look_less_and_less_alike_are_not_good():
    points = grid()
    first, second, other = Texture(0), Texture(0), Texture(5)
    shares = []
    for mix in (0.0, 0.5, 1.0):
        pair = [images(first)[0], images(lambda p, mix=mix: second(p) + mix * (other(p) - 128))[1]]
        found = align_patches(*pair, points, there(points), affine=MAP.expand(len(points), 2, 2), deform=False)
        shares.append(float(found.good.double().mean()))
    assert shares[0] == 1.0
    assert shares[1] > 0.5
    assert shares[2] < 0.4


def test_a_gain_is_no_difference_between_patches():
    """What is left after alignment is noise, so a change of contrast must not make a match worse."""
    points = grid()
    plain, darker = (align_patches(*images(Texture(), gain=g, noise=g), points, there(points)) for g in (1.0, 0.5))
    ratio = darker.covariance.diagonal(dim1=1, dim2=2).sum(1) / plain.covariance.diagonal(dim1=1, dim2=2).sum(1)
    assert 0.5 < float(ratio.median()) < 2.0


def test_a_patch_whose_map_runs_away_is_not_good():
    points = grid(18, 80)
    large = 1.75 * EXACT
    pair = images(Texture(), map_=large)
    found = align_patches(*pair, points, there(points, large))
    assert not found.good.any()
    near = align_patches(*pair, points, there(points, large), affine=(1.6 * EXACT).expand(len(points), 2, 2))
    assert float(near.good.double().mean()) > 0.9


def test_a_patch_does_not_depend_on_the_others():
    points = grid()
    pair, start = images(Texture(), noise=1.0), guess(there(points), 1.0)
    together = align_patches(*pair, points, start)
    alone = align_patches(*pair, points[5:6], start[5:6])
    assert torch.equal(alone.good, together.good[5:6])
    torch.testing.assert_close(alone.points, together.points[5:6], atol=0.02, rtol=0)


def test_the_second_image_may_be_of_the_same_place():
    points = grid()
    image = images(Texture())[0]
    found = align_patches(image, image, points, points)
    assert bool(found.good.all())
    assert float((found.points - points).abs().max()) < 1e-3


@pytest.mark.parametrize("deform", [True, False])
def test_no_patches_are_no_patches(deform):
    none = torch.zeros(0, 2, dtype=torch.float64)
    found = align_patches(*images(Texture(count=2)), none, none, deform=deform)
    assert [tuple(x.shape) for x in found] == [(0, 2), (0, 2, 2), (0, 2, 2), (0,), (0,)]


def test_luma_weighs_the_channels_and_samples_are_at_pixel_centres():
    image = torch.zeros(2, 3, 3, dtype=torch.uint8)
    image[0, 0], image[0, 1], image[0, 2] = torch.eye(3, dtype=torch.uint8) * 200
    assert gray(image)[0].tolist() == pytest.approx([59.8, 117.4, 22.8], abs=1e-4)
    ramp = 3.0 * torch.arange(5.0)[:, None] + torch.arange(7.0)
    points = torch.tensor([[2.0, 3.0], [2.5, 3.0], [2.0, 3.25], [-5.0, 1.0], [6.0, 4.0]], dtype=torch.float64)
    assert sample(ramp, points).tolist() == pytest.approx([11.0, 11.5, 11.75, 3.0, 18.0], abs=1e-4)
    assert sample(ramp, points.reshape(5, 1, 2)).shape == (5, 1)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.5, 0.8])
def test_without_noise_patches_are_found_to_two_hundredths_of_a_pixel_wherever_they_are(part):
    """No pull towards pixel centres, nor away from them."""
    points = grid() - 0.3 + part
    found = align_patches(*images(Texture(), map_=EXACT), points, there(points, EXACT), deform=False)
    assert bool(found.good.all())
    assert float((found.points - there(points, EXACT)).abs().median()) < 0.02


def test_bicubic_samples_of_a_ramp_are_on_the_ramp():
    ramp = 3.0 * torch.arange(12.0)[:, None] + torch.arange(15.0)
    points = 4 + 4 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = points @ points.new_tensor([1.0, 3.0])
    torch.testing.assert_close(sample(ramp, points, "bicubic").double(), expected, atol=0.01, rtol=0)
