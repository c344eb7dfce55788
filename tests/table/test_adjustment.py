"""The adjustment finds the truth from all kinds of evidence, knows how well, and is not misled by a few that are wrong."""

import math
from dataclasses import fields, replace

import pytest
import torch
from helpers import pose

from physpose_torch import se3
from physpose_torch.config import TableConfig
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.geometry.body import Body
from physpose_torch.table.adjustment import (
    FINE,
    RIDGE,
    ROUGH,
    SHARED,
    State,
    Unknowns,
    _moved,
    _normal_equations,
    _unknowns,
    adjust,
    unknowns_at,
)
from physpose_torch.table.evidence import (
    CommonDepth,
    Contact,
    EpipolarMatches,
    Gravity,
    ModelPoints,
    NotBelow,
    Outlines,
    PlaneMatches,
    PosePrior,
    SurfaceMatches,
    Upright,
    few,
    plane_terms,
)
from physpose_torch.table.standing import standing_on
from physpose_torch.table.view import pixel_rays, project

CONFIG = TableConfig()
K0 = torch.tensor([[600.0, 0.0, 320.0], [0.0, 605.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
K1 = torch.tensor([[800.0, 0.0, 400.0], [0.0, 800.0, 300.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
ROUND = torch.diag(torch.tensor([600.0, 600.0, 1.0], dtype=torch.float64))
"""Of a camera that looks the same however it is rolled."""
MOTION = pose((0.03, -0.27, 0.02), (0.22, 0.02, 0.05))
PIXEL = 0.3
"""Standard deviation of matches [px]."""
ALL = ("prior 0", "prior 1", "contact", "below", "depth", "gravity", "epipolar", "plane")
ALL = (*ALL, "surface", "model 0", "model 1", "outline")


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def uniform(*shape, seed=0):
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1


class Scene:
    """Four boxes on the tests' table before two cameras, and exact evidence of every kind."""

    def __init__(self, table, count=4, matches=100, K0=K0, K1=K1, motion=MOTION):
        places = [(-0.12, -0.05, 0.02), (0.1, 0.06, 0.05), (0.02, -0.1, 0.03), (-0.05, 0.1, 0.02)][:count]
        sizes = [(0.1, 0.06, 0.04), (0.05, 0.05, 0.1), (0.08, 0.04, 0.06), (0.06, 0.09, 0.04)][:count]
        self.bodies = [Body.box(size, label=f"box {k}") for k, size in enumerate(sizes)]
        poses = table.poses(*((*place, (0.0, 0.0, 0.7 * k)) for k, place in enumerate(places)))
        one = torch.ones((), dtype=torch.float64)
        self.state = State(motion, poses, table.up, table.plane.offset, one, poses[:, :3, 3].mean(0))
        self.K0, self.K1 = K0, K1
        owner = torch.arange(count)
        center = torch.zeros(count, 3, dtype=torch.float64)
        feet = standing_on(self.bodies, poses, table.up)
        self.on_table = se3.apply(table.T, torch.cat([0.3 * uniform(matches, 2), torch.zeros(matches, 1)], 1).double())
        pixels = self.seen(self.on_table, 0), self.seen(self.on_table, 1)
        covariance = PIXEL**2 * torch.eye(2, dtype=torch.float64).expand(matches, 2, 2)
        known = torch.diag(torch.tensor([0.05, 0.05, 0.02], dtype=torch.float64) ** 2)
        epipolar, plane = plane_terms(self.state, known, K0, K1, *pixels, covariance)

        # points of the tops of boxes: both cameras see them
        half = torch.stack([b.upper for b in self.bodies])
        who = owner.repeat_interleave(8)
        top = half[who] * torch.cat([uniform(len(who), 2, seed=1), torch.ones(len(who), 1)], 1)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(who), 3)
        at = se3.apply(poses[who], top[:, None])[:, 0]
        sharp = torch.eye(2, dtype=torch.float64).expand(len(who), 2, 2) / PIXEL
        weight = few(who, 20.0)
        across = torch.nn.functional.normalize(normal(len(who), 2, seed=2), dim=1)
        self.terms = {
            "prior 0": PosePrior(0, poses, center, owner, CONFIG),
            "prior 1": PosePrior(1, motion @ poses, center, owner, CONFIG),
            "contact": Contact.of(feet, CONFIG.sigma_contact),
            "below": NotBelow(feet.lowest, owner, 3 * CONFIG.sigma_contact),
            "depth": CommonDepth(CONFIG.sigma_depth_common),
            "gravity": Gravity(table.gravity, CONFIG.sigma_gravity),
            "upright": Upright(0.35),
            "epipolar": epipolar,
            "plane": plane,
            "surface": SurfaceMatches(pixel_rays(K0, self.seen(at, 0)), self.seen(at, 1), top, up, sharp, who, K1, weight),
            "model 0": ModelPoints(0, top, self.seen(at, 0), sharp, who, K0, weight),
            "model 1": ModelPoints(1, top, self.seen(at, 1), sharp, who, K1, weight),
            "outline": Outlines(0, top, self.seen(at, 0), across, who, K0, few(who, 8.0)),
        }

    def seen(self, points, view):
        """Pixels of points of view 0's frame in a view."""
        return project(self.K0, points) if view == 0 else project(self.K1, se3.apply(self.state.T_view1_view0, points))

    def some(self, *names):
        return [self.terms[n] for n in names]

    def change(self, name, **values):
        self.terms[name] = replace(self.terms[name], **values)

    def start(self, *, seed=0, shift=0.008, turn=0.03):
        """Off the truth, all of it."""
        n = len(self.state.poses)
        size = torch.tensor([shift] * 3 + [turn] * 3, dtype=torch.float64)
        step = normal(SHARED + 6 * n, seed=seed)
        step = step * torch.cat([size, torch.tensor([turn, turn, shift, 0.02], dtype=torch.float64), size.repeat(n)])
        return _moved(self.state, step)


@pytest.fixture
def scene(table):
    return Scene(table)


def plane_off(state, truth):
    """Two tilts and the height at the middle, of one plane over another: what the covariance is of."""
    lean = tangent_basis(truth.normal[None])[0] @ (truth.normal - state.normal)
    rise = (state.offset - state.normal @ truth.middle) - (truth.offset - truth.normal @ truth.middle)
    return torch.cat([lean, rise[None]])


def assert_states_agree(a, b, atol):
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y, atol=atol, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_exact_evidence_leads_to_the_truth(scene, seed):
    start = scene.start(seed=seed)
    assert float(plane_off(start, scene.state).abs().max()) > 0.005
    fit = adjust(adjust(start, scene.some(*ALL), ROUGH).state, scene.some(*ALL), FINE)
    assert_states_agree(fit.state, scene.state, 1e-6)
    for surprise in fit.surprise:
        assert float(surprise.max()) < 1e-6
    se3.check_rigid(fit.state.poses, "poses")
    se3.check_rigid(fit.state.T_view1_view0, "motion")
    assert float(fit.state.normal.norm()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "names",
    [
        ("prior 0", "contact", "depth"),
        ("prior 0", "depth", "gravity", "contact", "below"),
        ("prior 0", "prior 1", "epipolar", "plane", "depth"),
        ("model 0", "model 1", "contact", "depth"),
        ("model 0", "surface", "plane", "epipolar", "depth"),
        ("prior 0", "outline", "surface", "contact", "depth"),
    ],
    ids=["poses", "gravity", "matches, poses", "colours", "colours, matches", "outlines"],
)
def test_every_combination_that_holds_the_plane_finds_it(scene, names):
    fit = adjust(adjust(scene.start(), scene.some(*names), ROUGH).state, scene.some(*names), FINE * 2)
    assert float(plane_off(fit.state, scene.state).abs().max()) < 1e-4


def test_matches_on_the_table_alone_do_not_know_its_distance(scene):
    """Scale comes from the objects."""
    names = ("epipolar", "plane")
    fit = adjust(scene.state, scene.some(*names), FINE)
    known = adjust(scene.state, scene.some(*names, "prior 0", "prior 1", "depth"), FINE)
    assert float(fit.covariance[2, 2].sqrt()) > 20 * float(known.covariance[2, 2].sqrt())


def test_a_common_factor_of_all_depths_is_told_by_what_does_not_share_it(scene):
    """Poses 3 % too near, two cameras, matches on the objects' surfaces: the baseline is of the same unit, models are not."""
    measured = scene.state.poses.clone()
    measured[:, :3, 3] /= 1.03
    scene.change("prior 0", measured=measured)
    names = ("prior 0", "model 0", "model 1", "contact", "plane", "epipolar", "surface")
    fit = adjust(scene.state, scene.some(*names), ROUGH)
    assert float(fit.state.depth_factor) == pytest.approx(1.03, abs=1e-6)
    assert float(plane_off(fit.state, scene.state).abs().max()) < 1e-6


def residuals(term, state):
    return term.residual(unknowns_at(state))[0]


@pytest.mark.parametrize(("scale", "capped"), [(1.0, 1.0), (3.0, 1.0), (3.0, 2.0)])
def test_the_normal_equations_are_those_of_all_rows_and_all_unknowns(scene, scale, capped):
    """Against central differences of whole states, object by object, and weights written out."""
    start = scene.start(shift=0.003, turn=0.008)
    terms = [*scene.some(*ALL), scene.terms["upright"]]
    size = SHARED + 6 * len(start.poses)
    matrix = torch.diag(torch.tensor([RIDGE[0]] * 6 + [RIDGE[2]] * 3 + [RIDGE[1]] * (size - 9), dtype=torch.float64))
    gradient, total = torch.zeros(size, dtype=torch.float64), 0.0
    h = 1e-5
    moved = [(_moved(start, h * e), _moved(start, -h * e)) for e in torch.eye(size, dtype=torch.float64)]
    for term in terms:
        r = residuals(term, start)
        J = torch.stack([(residuals(term, a) - residuals(term, b)) / (2 * h) for a, b in moved], -1)
        squared = (r**2).sum(1)
        if term.cap is not None:
            share = 2 * term.cap / (2 * term.cap + squared / capped**2)
            weight, cost = share**2, term.cap * squared / (2 * term.cap + squared)
        elif math.isinf(term.nu):
            weight, cost = torch.ones_like(squared), 0.5 * squared
        else:
            d = term.nu + r.shape[1]
            weight, cost = d / (term.nu + squared / scale**2), 0.5 * d * torch.log1p(squared / term.nu)
        weight = weight * term.weight
        matrix += torch.einsum("gki,g,gkj->ij", J, weight, J)
        gradient += torch.einsum("gki,g,gk->i", J, weight, r)
        total += float((cost * term.weight).sum()) + getattr(term, "cost", 0.0)
    found, pull, cost, surprise = _normal_equations(start, terms, scale, capped)
    scales = matrix.diagonal().sqrt()
    torch.testing.assert_close(found / scales / scales[:, None], matrix / scales / scales[:, None], atol=1e-4, rtol=0)
    torch.testing.assert_close(pull / scales, gradient / scales, atol=2e-3, rtol=1e-4)
    assert cost == pytest.approx(total, rel=1e-9)
    for term, squared in zip(terms, surprise, strict=True):
        torch.testing.assert_close(squared, (residuals(term, start) ** 2).sum(1))


@pytest.mark.parametrize("robust", ["prior 0", "contact", "gravity", "plane", "outline"])
def test_weights_at_scale_one_are_the_slope_of_the_cost(scene, robust):
    """So that what the steps come to rest at is a minimum of it."""
    start = scene.start(shift=0.002, turn=0.005)
    term = scene.terms[robust]
    _, gradient, _, _ = _normal_equations(start, [term], 1.0)
    h = 1e-5
    for k, e in enumerate(torch.eye(len(gradient), dtype=torch.float64)):
        a, b = (_normal_equations(_moved(start, s * e), [term], 1.0)[2] for s in (h, -h))
        assert float(gradient[k]) == pytest.approx((a - b) / (2 * h), rel=1e-3, abs=0.05)


@pytest.mark.parametrize("name", [*ALL, "upright"])
def test_residuals_of_a_term_keep_leading_dimensions(scene, name):
    states = [scene.start(seed=k) for k in range(6)]
    xs = [unknowns_at(s) for s in states]
    many = Unknowns(*(torch.cat(column) for column in zip(*xs, strict=True)))
    shaped = Unknowns(*(v.reshape(2, 3, *v.shape[1:]) for v in many))
    none = Unknowns(*(v[4] for v in many))
    term = scene.terms[name]
    flat, grid, one = (term.residual(x) for x in (many, shaped, none))
    rows = 1 if term.owner is None and name in ("depth", "gravity", "upright") else flat.shape[1]
    assert flat.shape[:2] == (6, rows)
    assert grid.shape == (2, 3, *flat.shape[1:])
    torch.testing.assert_close(grid.reshape(flat.shape), flat)
    torch.testing.assert_close(one, flat[4])
    for x, expected in zip(xs, flat, strict=True):
        torch.testing.assert_close(term.residual(x)[0], expected)


def pose_noise(T, seed):
    """Steps (N, 6) by which poses (N, 4, 4) are off, as the configuration says."""
    noise = normal(len(T), 6, seed=seed)
    ray = torch.nn.functional.normalize(T[:, :3, 3], dim=1)
    across = torch.einsum("ni,nij->nj", noise[:, 1:3] * CONFIG.sigma_lateral, tangent_basis(ray))
    along = noise[:, :1] * CONFIG.sigma_ray_fraction * T[:, :3, 3]
    return torch.cat([across + along, noise[:, 3:] * CONFIG.sigma_rotation], 1)


def noisy(table, seed, matched):
    """The scene with draws of what its terms say they are off by."""
    scene = Scene(table)
    poses, n = scene.state.poses, len(scene.state.poses)
    factor = 1 + CONFIG.sigma_depth_common * normal(1, seed=10 * seed + 4)
    for view, T in ((0, poses), (1, MOTION @ poses)):
        measured = se3.retract(T, pose_noise(T, 10 * seed + view))
        measured[:, :3, 3] /= factor
        scene.change(f"prior {view}", measured=measured)
    feet = scene.terms["contact"].feet
    # eight feet count as three: a level and two slopes of each object's base
    A = torch.cat([feet.points[..., :2], torch.ones(n, 8, 1, dtype=torch.float64)], 2)
    base = torch.linalg.cholesky(torch.linalg.inv(A.mT @ A * 3 / 8)) @ normal(n, 3, 1, seed=10 * seed + 2)
    scene.change("contact", feet=feet._replace(rest=feet.rest + CONFIG.sigma_contact * (A @ base)[..., 0]))
    names = ["prior 0", "contact", "depth"]
    if matched:
        points_1 = scene.terms["plane"].points_1
        points_1 = points_1 + PIXEL * normal(*points_1.shape, seed=10 * seed + 3)
        scene.change("plane", points_1=points_1)
        scene.change("epipolar", points_1=points_1)
        names += ["prior 1", "epipolar", "plane"]
    return scene, scene.some(*names)


@pytest.mark.parametrize("matched", [False, True], ids=["poses", "poses and matches"])
def test_the_covariance_is_the_scatter_of_planes(table, matched):
    """Over draws of all noise there is: poses one by one, a factor of all depths, what stands on the table, and matches."""
    off, said = [], []
    for seed in range(110):
        scene, terms = noisy(table, seed, matched)
        fit = adjust(scene.state, terms, (1.0, 1.0, 1.0))
        off.append(plane_off(fit.state, scene.state))
        said.append(fit.covariance)
    off, said = torch.stack(off), torch.stack(said).mean(0)
    assert float((off.mean(0) / off.std(0)).abs().max()) < 0.45
    ratio = off.var(0) / said.diagonal()
    assert bool(((ratio > 1 / 1.5**2) & (ratio < 1.5**2)).all())
    distance = (off * torch.linalg.solve(said, off.T).T).sum(1)
    assert 1.2 < float(distance.median()) < 4.0  # 2.4 for three degrees of freedom


def test_more_matches_than_independent_ones_do_not_make_it_surer(table):
    few_, many = (
        adjust(s.state, s.some("prior 0", "prior 1", "epipolar", "plane"), FINE).covariance.diagonal().sqrt()
        for s in (Scene(table, matches=100), Scene(table, matches=800))
    )
    assert bool((many > 0.8 * few_).all())
    assert bool((many < 1.2 * few_).all())


def test_matches_that_are_wrong_move_nothing(scene):
    """One of ten, by 5 to 30 px, after the gate let them through."""
    points_1 = scene.terms["plane"].points_1 + PIXEL * normal(100, 2, seed=3)
    scene.change("plane", points_1=points_1)
    scene.change("epipolar", points_1=points_1)
    names = ("prior 0", "prior 1", "epipolar", "plane", "contact", "depth")
    clean = adjust(scene.state, scene.some(*names), ROUGH)
    wrong = points_1.clone()
    wrong[:10] += torch.linspace(5, 30, 10, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.3], dtype=torch.float64)
    scene.change("plane", points_1=wrong)
    scene.change("epipolar", points_1=wrong)
    fit = adjust(scene.state, scene.some(*names), ROUGH)
    sigma = clean.covariance.diagonal().sqrt()
    assert float((plane_off(fit.state, clean.state) / sigma).abs().max()) < 1.0
    assert float(fit.surprise[3][:10].min()) > 50
    assert float(fit.surprise[3][10:].max()) < 30


@pytest.mark.parametrize("lift", [0.04, 0.06, 0.09, 0.15])
def test_an_object_that_is_estimated_to_stand_elsewhere_is_not_pulled_in(scene, lift):
    """It is held above the table, which matches know; that the others were off instead would be far less likely."""
    lifted = scene.state.poses.clone()
    lifted[1, :3, 3] += lift * scene.state.normal
    scene.change("prior 0", measured=lifted)
    scene.change("prior 1", measured=MOTION @ lifted)
    names = ("prior 0", "prior 1", "contact", "below", "depth", "epipolar", "plane")
    fit = adjust(scene.state._replace(poses=lifted), scene.some(*names), ROUGH + FINE)
    assert float(plane_off(fit.state, scene.state).abs().max()) < 5e-4
    torch.testing.assert_close(fit.state.poses[1], lifted[1], atol=2e-3, rtol=0)
    assert (fit.surprise[2] < 16).tolist() == [True, False, True, True]


@pytest.mark.parametrize("lift", [0.04, 0.06, 0.09])
def test_an_object_that_does_not_stand_moves_nothing(scene, lift):
    """It is held above the table, which matches know; that the others were off instead would be far less likely."""
    lifted = scene.state.poses.clone()
    lifted[1, :3, 3] += lift * scene.state.normal
    scene.change("prior 0", measured=lifted)
    scene.change("prior 1", measured=MOTION @ lifted)
    names = ("prior 0", "prior 1", "contact", "below", "depth", "epipolar", "plane")
    fit = adjust(scene.start(shift=0.003, turn=0.01), scene.some(*names), ROUGH * 2)
    assert float(plane_off(fit.state, scene.state).abs().max()) < 5e-4
    torch.testing.assert_close(fit.state.poses[1], lifted[1], atol=2e-3, rtol=0)
    standing = fit.surprise[2] < 16
    assert standing.tolist() == [True, False, True, True]


def test_an_object_whose_pose_is_wrong_in_one_view_moves_little(scene):
    """Its colours and contact say otherwise."""
    wrong = scene.state.poses.clone()
    wrong[2] = wrong[2] @ pose((0.0, 0.9, 0.0), (0.03, 0.02, 0.05))
    scene.change("prior 0", measured=wrong)
    fit = adjust(scene.start(shift=0.003, turn=0.01), scene.some(*ALL), ROUGH * 2)
    assert float(plane_off(fit.state, scene.state).abs().max()) < 2e-4
    torch.testing.assert_close(fit.state.poses[2], scene.state.poses[2], atol=1e-3, rtol=0)


def test_scales_from_far_to_one_find_what_scale_one_does_not(scene):
    """From a start that is off by 5°, good evidence looks like outliers at first, and a fifth of the matches are wrong."""
    wrong = scene.terms["plane"].points_1.clone()
    wrong[::5] += 40 * normal(20, 2, seed=9)
    scene.change("plane", points_1=wrong)
    names = ("prior 0", "prior 1", "plane", "depth")
    graduated, plain = [], []
    for seed in range(8):
        start = scene.start(seed=seed, shift=0.01, turn=0.08)
        for off, schedule in ((graduated, ROUGH), (plain, (1.0,) * len(ROUGH))):
            fit = adjust(start, scene.some(*names), schedule)
            off.append(float(plane_off(fit.state, scene.state).abs().max()))
    assert max(graduated) < 2e-3
    assert sum(plain) > sum(graduated)


def test_cost_and_covariance_are_at_scale_one_whatever_the_schedule_was(table):
    """With noise: without it, weights are the same at all scales."""
    scene, terms = noisy(table, 0, True)
    start = scene.start(shift=0.002, turn=0.005)
    still = adjust(start, terms, ())
    assert_states_agree(still.state, start, 0.0)
    matrix, _, cost, _ = _normal_equations(start, terms, 1.0)
    assert still.cost == pytest.approx(cost)
    everything = torch.linalg.inv(matrix)
    torch.testing.assert_close(still.covariance, everything[6:9, 6:9])
    # for a given depth factor: what is left of it by the rule for conditional normal distributions
    cross = everything[6:9, 9]
    torch.testing.assert_close(still.relative, everything[6:9, 6:9] - cross[:, None] * cross / everything[9, 9])
    a, b = (adjust(start, terms, s + (1.0,) * 12) for s in (ROUGH, FINE))
    assert a.cost == pytest.approx(b.cost, rel=1e-6)
    torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-3, atol=0)
    assert still.cost > a.cost


def test_a_step_leads_to_the_same_plane_whether_it_is_tried_or_taken(scene):
    for seed in range(4):
        step = torch.cat([torch.zeros(6), 0.2 * normal(3, seed=seed), torch.zeros(7)]).double()
        tried = _unknowns(scene.state, step[None])
        taken = _moved(scene.state, torch.cat([step[:SHARED], torch.zeros(24, dtype=torch.float64)]))
        length = tried.normal[0].norm()
        assert float(length) > 1.001
        torch.testing.assert_close(taken.normal, tried.normal[0] / length)
        torch.testing.assert_close(taken.offset, tried.offset[0] / length)


def test_an_unknown_that_nothing_holds_stays_where_it_is(scene):
    """One object without evidence, and a second camera that sees nothing."""
    start = scene.start(shift=0.002)
    prior = scene.terms["prior 0"]
    rows = torch.tensor([0, 1, 3])
    prior = replace(prior, measured=prior.measured[rows], center=prior.center[rows], owner=rows)
    fit = adjust(start, [prior, scene.terms["gravity"]], FINE)
    torch.testing.assert_close(fit.state.poses[2], start.poses[2], atol=1e-9, rtol=0)
    torch.testing.assert_close(fit.state.T_view1_view0, start.T_view1_view0, atol=1e-9, rtol=0)
    assert fit.covariance.isfinite().all()


def test_without_objects_there_is_still_a_plane(scene):
    state = scene.state._replace(poses=scene.state.poses[:0])
    fit = adjust(state, scene.some("epipolar", "plane", "gravity", "depth"), FINE)
    assert_states_agree(fit.state, state, 1e-9)


def test_turning_the_cameras_turns_the_solution(table):
    """Poses, contacts and gravity, with noise; each camera about its centre, since that is where rays come from."""
    scene, _ = noisy(table, 5, False)
    names = ("prior 0", "prior 1", "contact", "below", "gravity", "depth")
    scene.change("gravity", down=se3.exp_so3(torch.tensor([0.02, -0.01, 0.01]).double()) @ table.gravity)
    expected = adjust(scene.state, scene.some(*names), ROUGH)
    for turn_0, turn_1 in (((0.4, -0.3, 1.0), (0.0, 0.2, 0.3)), ((-1.0, 2.0, 0.5), (1.0, 0.0, -2.0))):
        X, Y = pose(turn_0), pose(turn_1)
        other, R = Scene(table), X[:3, :3]
        other.terms = dict(scene.terms)
        other.change("prior 0", measured=X @ scene.terms["prior 0"].measured)
        other.change("prior 1", measured=Y @ scene.terms["prior 1"].measured)
        other.change("gravity", down=R @ scene.terms["gravity"].down)
        start = moved_state(scene.state, X, Y)
        fit = adjust(start, other.some(*names), ROUGH)
        assert_states_agree(fit.state, moved_state(expected.state, X, Y), 1e-6)
        assert fit.cost == pytest.approx(expected.cost, rel=1e-6)
        assert float(fit.covariance.det()) == pytest.approx(float(expected.covariance.det()), rel=1e-4)
        assert float(fit.covariance[2, 2]) == pytest.approx(float(expected.covariance[2, 2]), rel=1e-4)


def moved_state(state, X, Y):
    """The same seen by cameras that are turned by X and Y."""
    R = X[:3, :3]
    return state._replace(
        T_view1_view0=Y @ state.T_view1_view0 @ se3.inverse(X),
        poses=X @ state.poses,
        normal=R @ state.normal,
        middle=R @ state.middle,
    )


def test_rolling_the_cameras_rolls_the_solution_of_what_images_say(table):
    """About the optical axes, which pixels roll about if the principal point is in the origin; all terms, with noise."""
    scene = Scene(table, K0=ROUND, K1=ROUND)
    names = ALL
    for k, name in enumerate(("epipolar", "plane", "surface", "model 0", "model 1", "outline")):
        pixels = "pixels" if "pixels" in {f.name for f in fields(scene.terms[name])} else "points_1"
        value = getattr(scene.terms[name], pixels)
        scene.change(name, **{pixels: value + PIXEL * normal(*value.shape, seed=k)})
    expected = adjust(scene.state, scene.some(*names), ROUGH)
    assert float(plane_off(expected.state, scene.state).abs().max()) > 1e-6
    X, Y = pose((0.0, 0.0, 0.7)), pose((0.0, 0.0, -1.9))
    X2, Y2 = X[:2, :2], Y[:2, :2]
    other = Scene(table, K0=ROUND, K1=ROUND)
    other.terms = dict(scene.terms)
    t = scene.terms
    other.change("prior 0", measured=X @ t["prior 0"].measured)
    other.change("prior 1", measured=Y @ t["prior 1"].measured)
    other.change("gravity", down=X[:3, :3] @ t["gravity"].down)
    for name, row in (("epipolar", "across"), ("plane", "along")):
        rolled = getattr(t[name], row) @ Y2.T
        other.change(name, rays=t[name].rays @ X[:3, :3].T, points_1=t[name].points_1 @ Y2.T, **{row: rolled})
    s = t["surface"]
    other.change("surface", rays=s.rays @ X[:3, :3].T, points_1=s.points_1 @ Y2.T, whitening=s.whitening @ Y2.T)
    for name, R in (("model 0", X2), ("model 1", Y2)):
        other.change(name, pixels=t[name].pixels @ R.T, whitening=t[name].whitening @ R.T)
    other.change("outline", pixels=t["outline"].pixels @ X2.T, across=t["outline"].across @ X2.T)
    fit = adjust(moved_state(scene.state, X, Y), other.some(*names), ROUGH)
    assert_states_agree(fit.state, moved_state(expected.state, X, Y), 1e-6)
    assert fit.cost == pytest.approx(expected.cost, rel=1e-6)


def test_an_object_counts_for_so_many_and_no_more():
    owner = torch.tensor([0, 0, 0, 0, 2, 2, 5])
    assert few(owner, 2.0).tolist() == [0.5] * 4 + [1.0, 1.0, 1.0]
    assert few(owner, 20.0).tolist() == [1.0] * 7
    assert few(owner[:0], 3.0).tolist() == []


def test_contacts_are_of_what_does_not_lean(box, can, table):
    poses = table.poses((0.0, 0.0, 0.02), (0.1, 0.0, 0.06, (0.6, 0.0, 0.0)), (-0.1, 0.0, 0.02))
    poses[2] = torch.nan
    term = Contact.of(standing_on([box, can, box], poses, table.up), 0.001)
    assert term.owner.tolist() == [0]
    assert term.cost == Contact.cap  # one leans; of the other nothing is known
    one = torch.ones((), dtype=torch.float64)
    state = State(MOTION, poses[:2], table.up, table.plane.offset, one, poses[0, :3, 3])
    assert float(residuals(term, state).abs().max()) < 1e-6
    higher = _moved(state, torch.zeros(SHARED + 12, dtype=torch.float64).index_fill_(0, torch.tensor([8]), 0.002))
    off = residuals(term, higher)
    assert float((off**2).sum()) == pytest.approx(3 * 2.0**2, rel=1e-4)  # three feet, two sigma each


def test_being_below_costs_and_being_above_does_not(scene):
    term = scene.terms["below"]
    for rise, count in ((0.01, 4), (-0.01, 0)):  # of the table
        step = torch.zeros(SHARED + 24, dtype=torch.float64)
        step[8] = rise
        r = residuals(term, _moved(scene.state, step))
        assert int((r < -1).sum()) == count
        assert bool((r <= 0).all())


def test_gravity_is_known_in_all_directions_even_upside_down(table, scene):
    costs = []
    for angle in (0.0, 0.05, 0.5, 1.5, 3.0, math.pi):
        turned = scene.state._replace(normal=se3.exp_so3(torch.tensor([angle, 0.0, 0.0]).double()) @ table.up)
        costs.append(float((residuals(scene.terms["gravity"], turned) ** 2).sum()))
    assert costs == sorted(costs)
    assert costs[0] < 1e-9
    assert costs[1] == pytest.approx((0.05 / CONFIG.sigma_gravity) ** 2, rel=1e-3)


class Planes:
    """Matches on the table and others, as :func:`plane_terms` gets them."""

    def __init__(self, scene, height=0.0, noise=PIXEL, count=150):
        basis = tangent_basis(scene.state.normal[None])[0]
        points = scene.state.middle + 0.25 * uniform(count, 2, seed=4) @ basis
        points = points - ((points @ scene.state.normal) - scene.state.offset - height)[:, None] * scene.state.normal
        self.points_0 = scene.seen(points, 0)
        self.points_1 = scene.seen(points, 1) + noise * normal(count, 2, seed=5)
        self.covariance = PIXEL**2 * torch.eye(2, dtype=torch.float64).expand(count, 2, 2)

    def terms(self, scene, known=(0.005, 0.005, 0.002)):
        known = torch.diag(torch.tensor(known, dtype=torch.float64) ** 2)
        return plane_terms(scene.state, known, K0, K1, self.points_0, self.points_1, self.covariance)


def test_matches_on_the_table_are_whitened_along_and_across_their_lines(scene):
    epipolar, plane = Planes(scene).terms(scene)
    assert isinstance(epipolar, EpipolarMatches)
    assert isinstance(plane, PlaneMatches)
    assert len(plane.rays) > 140
    for term in (epipolar, plane):
        r = residuals(term, scene.state)[:, 0]
        assert 0.8 < float(r.std()) < 1.2
    assert float(torch.einsum("mi,mi->m", epipolar.across[: len(plane.along)], plane.along).abs().max()) < 1e-6


def test_matches_on_another_plane_say_nothing_of_this_one(scene):
    """A floor 70 cm below agrees with the motion, not with the table; a magazine of 2 mm is on it."""
    epipolar, plane = Planes(scene, height=-0.7).terms(scene)
    assert len(plane.rays) == 0
    assert plane.cost == 0.0
    assert len(epipolar.rays) == 150
    assert float(residuals(epipolar, scene.state).abs().max()) < 5
    assert len(Planes(scene, height=0.001).terms(scene)[1].rays) > 140


def test_what_is_not_known_of_the_plane_widens_the_gate(scene):
    planes = Planes(scene, height=0.02)
    well, high, tilted = (
        len(planes.terms(scene, (tilt, tilt, rise))[1].rays)
        for tilt, rise in ((0.001, 0.001), (0.001, 0.02), (0.1, 0.001))
    )
    assert well == 0
    assert high > 140
    assert 50 < tilted < 150


def test_matches_above_the_horizon_or_off_their_lines_are_not_on_the_plane(scene):
    planes = Planes(scene)
    planes.points_0[:30] = torch.tensor([300.0, -900.0], dtype=torch.float64)
    planes.points_1[30:60] += torch.tensor([0.0, 25.0], dtype=torch.float64)
    epipolar, plane = planes.terms(scene)
    assert 80 < len(plane.rays) <= 90
    for term in (epipolar, plane):
        assert residuals(term, scene.state).isfinite().all()


def test_the_more_is_on_a_plane_the_less_it_costs(scene):
    many, some = Planes(scene, count=100).terms(scene)[1], Planes(scene, count=60).terms(scene)[1]
    assert many.cost < some.cost < 0
    assert Planes(scene, count=40).terms(scene)[1].cost == 0.0
    assert Planes(scene, count=400).terms(scene)[1].cost == pytest.approx(Planes(scene, count=900).terms(scene)[1].cost)


def test_noise_of_poses_does_not_shrink_the_scene(table):
    """Nothing but poses in two views, of seven objects: the common factor is 1 in the mean."""
    factors = []
    for seed in range(30):
        poses = table.poses(*((*xy, 0.02) for xy in (0.25 * uniform(7, 2, seed=seed)).tolist()))
        one, rows = torch.ones((), dtype=torch.float64), torch.arange(7)
        state = State(MOTION, poses, table.up, table.plane.offset, one, poses[:, :3, 3].mean(0))
        terms = [CommonDepth(CONFIG.sigma_depth_common)]
        for view, T in ((0, poses), (1, MOTION @ poses)):
            measured = se3.retract(T, pose_noise(T, 2 * seed + view))
            terms.append(PosePrior(view, measured, torch.zeros(7, 3, dtype=torch.float64), rows, CONFIG))
        factors.append(float(adjust(state, terms, (1.0,) * 6).state.depth_factor))
    assert abs(sum(factors) / 30 - 1) < 0.003
