"""Objects are found in generated photographs where they truly are: textures, outlines, surfaces and the table beside them."""

import math
from typing import NamedTuple

import pytest
import torch

from physpose_torch import se3
from physpose_torch.config import TableConfig
from physpose_torch.geometry.body import Body
from physpose_torch.photograph import HouseholdPair, household_pair
from physpose_torch.table.adjustment import State, unknowns_at
from physpose_torch.table.alignment import (
    CLEAR,
    INDEPENDENT,
    INDEPENDENT_OUTLINE,
    OUTLINE_SIGMA,
    Located,
    corners,
    find_outlines,
    find_textures,
    plane_matches,
    predict_matches,
    surface_matches,
)
from physpose_torch.table.evidence import EpipolarMatches, PlaneMatches
from physpose_torch.table.lucas_kanade import align_patches, gray
from physpose_torch.table.roles import Matches
from physpose_torch.table.template import Template, grown, render_template
from physpose_torch.table.view import View, pixel_rays, project

CONFIG = TableConfig()
FLOOR = 0.72
"""The floor is so far below the table [m]."""


class Photographed(NamedTuple):
    """A pair of photographs with what is true about it."""

    pair: HouseholdPair
    bodies: list[Body]
    views: tuple[View, View]
    templates: tuple[Template, Template]
    """At the true poses."""
    state: State

    def template(self, view: int, poses) -> Template:
        return render_template(self.bodies, poses, self.pair.K, self.views[view].size)

    def into_view1(self, points):
        """Pixels in view 1 of points of view 0's frame."""
        return project(self.pair.K, se3.apply(self.pair.T_view1_view0, points))

    def on_plane(self, pixels, below=0.0):
        """Points that pixels of view 0 see of the table, or of a plane below it."""
        rays = pixel_rays(self.pair.K, pixels)
        return rays * ((self.pair.offset - below) / (rays @ self.pair.normal))[:, None]


@pytest.fixture(scope="module")
def photographed() -> Photographed:
    pair = household_pair(1, table="wood", objects=4)
    bodies = [Body.from_hull(pair.meshes[name], label=name) for name in pair.names]
    views = tuple(View(image, pair.K, T) for image, T in zip(pair.images, pair.T_camera_object, strict=True))
    templates = tuple(render_template(bodies, v.measured, pair.K, v.size) for v in views)
    offset, one = torch.tensor(pair.offset, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    middle = pair.T_camera_object[0][:, :3, 3].mean(0)
    state = State(pair.T_view1_view0, pair.T_camera_object[0], pair.normal, offset, one, middle)
    return Photographed(pair, bodies, views, templates, state)


def disturbed(poses, seed):
    """All of them off by 2 mm and by 1°, each in its own direction."""
    draw = torch.randn(len(poses), 2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    draw = torch.nn.functional.normalize(draw, dim=2) * draw.new_tensor([0.002, math.radians(1.0)])[:, None]
    return se3.retract(poses, draw.flatten(1))


def where(term, poses, K):
    """Pixels (M, 2) that a term's points would be at if objects were at these poses."""
    return project(K, se3.apply(poses[term.owner], term.points[:, None])[:, 0])


def across(term):
    """Unit normals of outlines."""
    return torch.nn.functional.normalize(term.across, dim=1)


def grid(view, step=9, border=12):
    height, width = view.size
    x, y = torch.arange(border, width - border, step), torch.arange(border, height - border, step)
    return torch.cartesian_prod(x, y).double()


def at(mask, points):
    x, y = points.round().long().unbind(1)
    return mask[y, x]


@pytest.mark.parametrize("k", [0, 1])
def test_textures_are_found_at_the_true_poses(photographed, k):
    p = photographed
    found = find_textures(p.templates[k], gray(p.views[k].image), p.views[k], k, CONFIG)
    assert found.view == k
    error = found.pixels - where(found, p.views[k].measured, p.pair.K)
    assert len(error) > 40
    assert len(found.owner.unique()) == 4
    assert float(error.norm(dim=1).median()) < 0.25
    whitened = (found.whitening @ error[..., None])[..., 0]
    assert float((whitened**2).sum(1).median()) < 1.4  # these meshes are exact, real ones are off by a little


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("k", [0, 1])
def test_textures_lead_back_from_disturbed_poses(photographed, k, seed):
    p, truth = photographed, photographed.views[k].measured
    poses = disturbed(truth, seed)
    found = find_textures(p.template(k, poses), gray(p.views[k].image), p.views[k], k, CONFIG)
    there = where(found, truth, p.pair.K)
    before, after = ((x - there).norm(dim=1).median() for x in (where(found, poses, p.pair.K), found.pixels))
    assert len(there) > 40
    assert float(after) < 0.25
    assert float(before) > 4 * float(after)


def test_points_of_textures_are_on_the_surface_and_count_for_so_many(photographed):
    p = photographed
    found = find_textures(p.templates[0], gray(p.views[0].image), p.views[0], 0, CONFIG)
    drawn = where(found, p.views[0].measured, p.pair.K)
    assert torch.equal(at(p.templates[0].owner, drawn), found.owner)
    torch.testing.assert_close(drawn, drawn.round(), atol=1e-5, rtol=0)  # where the template has them
    count = torch.bincount(found.owner, weights=found.weight)
    torch.testing.assert_close(count, torch.bincount(found.owner).double().clamp_max(INDEPENDENT))


def test_objects_without_colours_have_no_textures_but_outlines(photographed):
    p = photographed
    plain = [Body(b.label, b.parts, b.mesh) for b in p.bodies]
    template = render_template(plain, p.views[0].measured, p.pair.K, p.views[0].size)
    assert find_textures(template, gray(p.views[0].image), p.views[0], 0, CONFIG) is None
    mixed = render_template([p.bodies[0], *plain[1:]], p.views[0].measured, p.pair.K, p.views[0].size)
    assert find_textures(mixed, gray(p.views[0].image), p.views[0], 0, CONFIG).owner.unique().tolist() == [0]
    outlines = find_outlines(template, p.views[0].image, p.views[0], 0, CONFIG, only=range(4), reach=4)
    assert len(outlines.owner.unique()) == 4


@pytest.mark.parametrize("k", [0, 1])
def test_outlines_are_found_at_the_true_poses(photographed, k):
    p = photographed
    found = find_outlines(p.templates[k], p.views[k].image, p.views[k], k, CONFIG, only=range(4), reach=4)
    off = ((found.pixels - where(found, p.views[k].measured, p.pair.K)) * across(found)).sum(1)
    assert len(off) > 80
    assert len(found.owner.unique()) == 4
    assert float(off.abs().median()) < 0.35
    assert float(off.abs().quantile(0.9)) < 1.5
    assert abs(float(off.median())) < 0.3
    sigma = 1 / found.across.norm(dim=1)
    assert float(sigma.min()) >= OUTLINE_SIGMA
    count = torch.bincount(found.owner, weights=found.weight)
    torch.testing.assert_close(count, torch.full((4,), INDEPENDENT_OUTLINE, dtype=torch.float64))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("k", [0, 1])
def test_outlines_lead_back_from_disturbed_poses(photographed, k, seed):
    """What is found of outlines is near the true ones, though it is other points of the objects that are on them."""
    p, truth = photographed, photographed.views[k].measured
    poses = disturbed(truth, seed)
    found = find_outlines(p.template(k, poses), p.views[k].image, p.views[k], k, CONFIG, only=range(4), reach=10)
    there = where(found, truth, p.pair.K)
    before, after = (((x - there) * across(found)).sum(1).abs() for x in (where(found, poses, p.pair.K), found.pixels))
    assert len(there) > 80
    assert float(after.median()) < 0.5
    assert float(before.median()) > 1.4 * float(after.median())
    assert float(before.quantile(0.9)) > 1.1 * float(after.quantile(0.9))


def test_normals_of_outlines_point_outwards(photographed):
    p = photographed
    found = find_outlines(p.templates[0], p.views[0].image, p.views[0], 0, CONFIG, only=range(4), reach=4)
    drawn = where(found, p.views[0].measured, p.pair.K)
    for k, outline in enumerate(p.templates[0].outlines):
        own = found.owner == k
        inside, outside = (at(outline, drawn[own] + s * across(found)[own]).double().mean() for s in (-3, 3))
        assert float(inside) > 0.9
        assert float(outside) < 0.1


def test_only_what_is_asked_for_is_outlined(photographed):
    p = photographed
    found = find_outlines(p.templates[0], p.views[0].image, p.views[0], 0, CONFIG, only=[1, 3], reach=4)
    assert found.owner.unique().tolist() == [1, 3]
    assert find_outlines(p.templates[0], p.views[0].image, p.views[0], 0, CONFIG, only=[], reach=4) is None


@pytest.mark.parametrize("gone", [torch.nan, 3.0], ids=["unknown", "beside the image"])
def test_an_object_out_of_sight_gives_nothing(photographed, gone):
    p = photographed
    poses = p.views[0].measured.clone()
    poses[2, 0, 3] = gone
    if math.isnan(gone):
        poses[2] = gone
    template = p.template(0, poses)
    assert template.outlines[2] is None
    assert find_outlines(template, p.views[0].image, p.views[0], 0, CONFIG, only=[2], reach=4) is None
    image = gray(p.views[0].image)
    assert 2 not in find_textures(template, image, p.views[0], 0, CONFIG).owner.tolist()
    outlines = find_outlines(template, p.views[0].image, p.views[0], 0, CONFIG, only=range(4), reach=4)
    assert 2 not in outlines.owner.tolist()
    none = p.template(0, torch.full((4, 4, 4), torch.nan, dtype=torch.float64))
    assert find_textures(none, image, p.views[0], 0, CONFIG) is None


def test_an_image_that_shows_nothing_gives_nothing(photographed):
    p = photographed
    blank = torch.full_like(p.views[0].image, 120)
    assert find_textures(p.templates[0], gray(blank), p.views[0], 0, CONFIG) is None
    assert find_outlines(p.templates[0], blank, p.views[0], 0, CONFIG, only=range(4), reach=4) is None


def test_matches_are_predicted_where_surfaces_truly_are_in_the_other_view(photographed):
    """Every pixel of an object, by its depth, and of the table, by the plane."""
    p = photographed
    points = grid(p.views[0], 5)
    K, template = p.pair.K, p.templates[0]
    found, affine = predict_matches(p.state, template, K, K, points)
    on = at(template.owner, points) >= 0
    seen = torch.where(on[:, None], pixel_rays(K, points) * at(template.depth, points)[:, None], p.on_plane(points))
    ahead = on | (p.on_plane(points)[:, 2] > 0)  # else above the horizon
    assert int(on.sum()) > 500
    assert int((ahead & ~on).sum()) > 3000
    torch.testing.assert_close(found[ahead], p.into_view1(seen)[ahead], atol=1e-6, rtol=0)
    # offsets map as that face, or the table, is seen; edge-on faces stretch
    step = torch.tensor([0.3, -0.4], dtype=torch.float64)
    near, _ = predict_matches(p.state, template, K, K, points + step)
    tame = ahead & ((affine - torch.eye(2, dtype=torch.float64)).abs().flatten(1).amax(1) < 1)
    assert float(tame.double().mean()) > 0.7
    torch.testing.assert_close((near - found)[tame], (affine @ step)[tame], atol=0.02, rtol=0)


def test_predicted_matches_look_alike(photographed):
    """The proof that predictions are right is in the pixels, which know nothing of templates."""
    p = photographed
    points = grid(p.views[0], 7, 20)
    points = points[at(p.templates[0].owner >= 0, points)]
    K = p.pair.K
    guess, affine = predict_matches(p.state, p.templates[0], K, K, points)
    grays = [gray(v.image) for v in p.views]
    found = align_patches(*grays, points, guess, affine=affine, deform=False)
    assert float(found.good.double().mean()) > 0.3
    assert float((found.points - guess)[found.good].norm(dim=1).median()) < 0.3


def located(p, points_0, points_1):
    return Located(points_0, points_1, 0.09 * torch.eye(2, dtype=torch.float64).expand(len(points_0), 2, 2))


KNOWN = torch.diag(torch.tensor([0.01, 0.01, 0.004], dtype=torch.float64) ** 2)


def on_table(p, below=0.0):
    """Pixels of view 0, and where what they see of a plane is in view 1, if that is in the image."""
    points_0 = grid(p.views[0])
    points = p.on_plane(points_0, below)
    points_1 = p.into_view1(points)
    size = points_1.new_tensor(p.views[1].size[::-1])
    keep = (points[:, 2] > 0.1) & (points[:, 2] < 4.0) & ((points_1 > 5) & (points_1 < size - 6)).all(1)
    return points_0[keep], points_1[keep]


def free(p, points_0, points_1):
    """What is clear of objects in both views."""
    return ~at(grown(p.templates[0].owner >= 0, CLEAR), points_0) & ~at(grown(p.templates[1].owner >= 0, CLEAR), points_1)


def test_matches_on_the_table_are_taken_and_those_on_the_floor_are_not(photographed):
    p = photographed
    table, floor = on_table(p), on_table(p, FLOOR)
    both = located(p, *(torch.cat(x) for x in zip(table, floor, strict=True)))
    epipolar, plane = plane_matches(p.state, KNOWN, both, p.templates, p.views)
    assert isinstance(epipolar, EpipolarMatches)
    assert isinstance(plane, PlaneMatches)
    count = [int(free(p, *x).sum()) for x in (table, floor)]
    assert min(count) > 300
    assert len(epipolar.rays) == sum(count)  # the floor, too, tells how the camera moved
    assert len(plane.rays) == count[0]
    for term in (epipolar, plane):
        assert float(term.residual(unknowns_at(p.state)).abs().max()) < 1e-6
    only = plane_matches(p.state, KNOWN, located(p, *floor), p.templates, p.views)
    assert len(only[1].rays) == 0


def test_matches_on_objects_or_close_to_them_say_nothing_of_the_plane(photographed):
    p = photographed
    points_0, points_1 = on_table(p)
    near = ~free(p, points_0, points_1)
    assert int(near.sum()) > 50
    assert plane_matches(p.state, KNOWN, located(p, points_0[near], points_1[near]), p.templates, p.views) == []
    nothing = torch.zeros(0, 2, dtype=torch.float64)
    assert plane_matches(p.state, KNOWN, located(p, nothing, nothing), p.templates, p.views) == []


def on_objects(p, step=3):
    points_0 = grid(p.views[0], step)
    points_0 = points_0[at(p.templates[0].owner, points_0) >= 0]
    depth = at(p.templates[0].depth, points_0)
    points_1 = p.into_view1(pixel_rays(p.pair.K, points_0) * depth[:, None])
    size = points_1.new_tensor(p.views[1].size[::-1])
    keep = ((points_1 > 5) & (points_1 < size - 6)).all(1)
    return points_0[keep], points_1[keep]


def test_matches_on_surfaces_fit_the_true_poses_and_their_objects(photographed):
    p = photographed
    points_0, points_1 = on_objects(p)
    term = surface_matches(p.state, located(p, points_0, points_1), p.templates, p.views, CONFIG)
    assert len(term.owner) > 500
    assert len(term.owner.unique()) == 4
    assert float(term.residual(unknowns_at(p.state)).abs().max()) < 1e-4
    pixels = term.rays @ p.pair.K.T
    assert torch.equal(at(p.templates[0].owner, pixels[:, :2]), term.owner)
    count = torch.bincount(term.owner, weights=term.weight)
    assert float(count.max()) <= INDEPENDENT + 1e-9
    # what is off by a millimetre is off by about as much as a surface may be
    moved = p.state._replace(poses=se3.retract(p.state.poses, torch.tensor([0, 0, 0.001, 0, 0, 0]).double().expand(4, 6)))
    assert 0.05 < float(term.residual(unknowns_at(moved)).norm(dim=-1).median()) < 3


def test_matches_that_are_not_on_one_object_in_both_views_are_not_on_surfaces(photographed):
    p = photographed
    table = on_table(p)
    beside = located(p, *(x[free(p, *table)] for x in table))
    assert surface_matches(p.state, beside, p.templates, p.views, CONFIG) is None
    points_0, points_1 = on_objects(p)
    owner = at(p.templates[0].owner, points_0)
    first, second = points_0[owner == 1], points_1[owner == 2]
    count = min(len(first), len(second))
    swapped = located(p, first[:count], second[:count])
    assert surface_matches(p.state, swapped, p.templates, p.views, CONFIG) is None


def test_corners_are_where_the_mask_allows_and_apart(photographed):
    image = gray(photographed.views[0].image)
    mask = torch.zeros(image.shape, dtype=torch.bool)
    mask[200:400, 100:300] = True
    points = corners(image, mask, 8)
    assert len(points) > 50
    assert bool(at(mask, points).all())
    apart = torch.cdist(points, points).fill_diagonal_(torch.inf)
    assert float(apart.min()) >= 8
    assert len(corners(image, mask, 8, 20)) == 20
    assert corners(image, torch.zeros_like(mask), 8).shape == (0, 2)
    assert corners(torch.full_like(image, 90.0), mask, 8).shape == (0, 2)


def test_located_are_matches_that_could_be_aligned(photographed):
    """Rough matches on the table, off by a pixel, come to where they are; matches of nothing are left out."""
    p = photographed
    points_0, points_1 = on_table(p)
    keep = free(p, points_0, points_1)
    points_0, points_1 = points_0[keep][::3], points_1[keep][::3]
    noise = torch.randn(points_1.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rough = Matches(points_0, points_1 + 0.8 * noise, torch.ones(len(points_0)))
    grays = [gray(v.image) for v in p.views]
    found = Located.of(rough, grays)
    assert len(found.points_0) > 50
    truth = p.into_view1(p.on_plane(found.points_0))
    off = (found.points_1 - truth)[..., None]
    # the grain of wood can be told across, not along
    best = torch.linalg.eigh(found.covariance)[1][:, :, 0]
    assert float((off[..., 0] * best).sum(1).abs().median()) < 0.15
    assert float((off.mT @ torch.linalg.solve(found.covariance, off)).median()) < 3
    shuffled = Matches(points_0, points_1.flip(0), torch.ones(len(points_0)))
    assert len(Located.of(shuffled, grays).points_0) < 0.2 * len(points_0)
