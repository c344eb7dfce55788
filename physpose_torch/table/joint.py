"""Method ``joint``: everything that images and poses say of the table, in one robust least-squares problem."""

import logging
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.table.adjustment import FINE, ROUGH, Fit, State, Term, adjust, unknowns_at
from physpose_torch.table.alignment import (
    BORDER,
    CLEAR,
    Located,
    corners,
    find_outlines,
    find_textures,
    plane_matches,
    predict_matches,
    surface_matches,
)
from physpose_torch.table.evidence import CommonDepth, Contact, Gravity, NotBelow, PlaneMatches, PosePrior, Upright
from physpose_torch.table.found import Problem
from physpose_torch.table.lucas_kanade import align_patches, gray, sample
from physpose_torch.table.roles import Matches
from physpose_torch.table.standing import ROLL, plane_hypotheses, standing_on
from physpose_torch.table.template import Template, eroded, grown, render_template
from physpose_torch.table.two_view import motion_from_matches, motion_from_objects, triangulate

__all__ = ["Solution", "Supported", "fit_joint", "fit_support", "rival_cost"]

logger = logging.getLogger("physpose_torch")

STANDS = 16.0
"""Squared deviation of the feet of an object that stands, in standard deviations of contacts; about three count."""
FITS = 9.0
"""The same of a match that is where it should be."""
WIDEST = 3.0
"""Scale from which contacts are looked for by the poses alone, where nothing else could contradict them."""
HOPELESS = 40.0
"""A plane whose cost by the poses alone is this much higher will not be the table."""
SAME_MOTION = (math.radians(1.0), 0.1)
"""Motions that differ by less than this, in rotation [rad] and in position as a share of the baseline, end alike."""
ENOUGH = 12
"""Points of an object's texture that were found, from which on its outline is not needed."""
REACH = (10, 4)
"""[px]; how far from where the poses put them the outlines are looked for, at first and then."""
SPACING = (6, 4)
"""[px] between points to be matched on the table, and on objects."""


class Solution(NamedTuple):
    """What was found."""

    fit: "Supported"
    table: Matches | None
    """Matches on the table."""
    rival: float
    """By how much the next best, different plane explains everything worse (difference of costs); infinite: there is none."""
    disagreement: float
    """Squared deviation of the typical object from its estimate across the viewing ray, in standard deviations; 2 is the mean.
    Images that are scaled or moved against the poses pull objects sideways."""
    two: bool
    """Whether the second view had a say."""


class Supported(NamedTuple):
    """A fit, and which objects stand on its plane."""

    state: State
    covariance: Tensor
    """(3, 3) see :class:`~physpose_torch.table.adjustment.Fit`."""
    relative: Tensor
    """(3, 3) likewise."""
    cost: float
    standing: Tensor
    """(N,) bool."""


def fit_support(problem: Problem, motion: Tensor | None = None) -> list[Supported]:
    """Planes by the poses alone, the likeliest first: stable faces, bottoms, priors, gravity.

    Args:
        problem: what is given.
        motion: T_view1_view0, if the second view's poses are to count.
    """
    poses = _base_poses(problem, motion)
    here = poses.isfinite().flatten(1).all(1)
    if not bool(here.any()):
        return []
    middle = se3.apply(poses[here], problem.centers[here][:, None])[:, 0].mean(0)
    eye, one = torch.eye(4, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    filled = torch.where(here[:, None, None], poses, eye)
    fits = []
    for guess in plane_hypotheses(problem.bodies, poses, problem.config, gravity=problem.gravity):
        state = State(eye if motion is None else motion, filled, guess.normal, guess.offset, one, middle)
        for schedule in (ROUGH, FINE):
            terms = _pose_terms(problem, state, two=motion is not None)
            state = adjust(state, terms, schedule, widest=WIDEST).state
        terms = _pose_terms(problem, state, two=motion is not None)
        fits.append(_supported(problem, adjust(state, terms, ()), terms))
    return sorted(fits, key=lambda fit: fit.cost)


def fit_joint(problem: Problem, find_matches: Callable[[Tensor, Tensor], Matches | None]) -> Solution | None:
    """The plane by all there is; None where not even the poses tell of one.

    Args:
        problem: what is given.
        find_matches: pixels of two images (H, W, 3) that show the same, right to a pixel or two.
    """
    views = problem.views
    motion = motion_from_objects(*problem.measured) if len(views) == 2 else None
    matches = None
    grays = [None if v.image is None else gray(v.image) for v in views]
    if len(views) == 2 and all(g is not None for g in grays):
        rough = find_matches(views[0].image, views[1].image)
        matches = None if rough is None else Located.of(rough, grays)
    motions = _motions(problem, motion, matches)
    supported = fit_support(problem, motions[0] if motions else None)
    if not supported:
        return None
    two = bool(motions)

    # where objects are in the images does not depend on which plane it is
    state = supported[0].state
    evidence = _aligned(problem, state, grays, REACH[0], two)
    fits: list[Fit] = []
    starts = [(state, m) for m in motions or [state.T_view1_view0]]
    rivals = [fit for fit in supported[1:] if fit.cost < supported[0].cost + HOPELESS and _differ(fit.state, state)]
    starts += [(fit.state, None) for fit in rivals[:2]]
    for start, motion in starts:
        start = start._replace(T_view1_view0=motion if motion is not None else fits[0].state.T_view1_view0)
        fit, _ = _fit_all(problem, start, evidence, matches if two else None, two, ROUGH)
        fits = sorted([*fits, fit], key=lambda fit: fit.cost)
    rival = rival_cost(fits)

    state = fits[0].state
    evidence = _aligned(problem, state, grays, REACH[1], two)
    if matches is not None and two:
        matches = _denser(problem, state, grays, matches)
    fit, terms = _fit_all(problem, state, evidence, matches if two else None, two, FINE)
    return _solution(problem, fit, terms, rival, two)


def rival_cost(fits: Sequence[Fit | Supported]) -> float:
    """By how much the best of the others that is another plane is worse than the first; infinite if there is none."""
    return min((f.cost for f in fits[1:] if _differ(f.state, fits[0].state)), default=math.inf) - fits[0].cost


def _base_poses(problem: Problem, motion: Tensor | None) -> Tensor:
    """(N, 4, 4) in view 0: as estimated there, or else as the other view has them."""
    poses = problem.measured[0]
    if motion is None:
        return poses
    other = se3.inverse(motion) @ problem.measured[1]
    return torch.where(poses.isnan(), other, poses)


def _pose_terms(problem: Problem, state: State, *, two: bool) -> list[Term]:
    """Terms that need no image."""
    terms: list[Term] = []
    for view in range(2 if two else 1):
        owner = problem.measured[view].isfinite().flatten(1).all(1).nonzero()[:, 0]
        if len(owner):
            measured = problem.measured[view][owner]
            terms.append(PosePrior(view, measured, problem.centers[owner], owner, problem.config))
    feet = standing_on(problem.bodies, state.poses, state.normal)
    terms.append(Contact.of(feet, problem.config.sigma_contact))
    there = feet.lowest.isfinite().all(1).nonzero()[:, 0]
    terms.append(NotBelow(feet.lowest[there], there, 3 * problem.config.sigma_contact))
    terms.append(CommonDepth(problem.config.sigma_depth_common))
    if problem.gravity is not None:
        terms.append(Gravity(problem.gravity, problem.config.sigma_gravity))
    else:
        terms.append(Upright(ROLL))
    return terms


def _templates(problem: Problem, state: State, two: bool) -> list[Template]:
    poses = [state.poses, state.T_view1_view0 @ state.poses]
    return [
        render_template(problem.bodies, T, v.K, v.size)
        for v, T in zip(problem.views[: 1 + two], poses, strict=False)
    ]


def _aligned(problem: Problem, state: State, grays: Sequence[Tensor | None], reach: int, two: bool):
    """Templates at the state's poses, and terms of where their textures and outlines are in the images."""
    templates = _templates(problem, state, two)
    terms: list[Term] = []
    if problem.config.align:
        for k, (view, template) in enumerate(zip(problem.views, templates, strict=False)):
            if grays[k] is None:
                continue
            textures = find_textures(template, grays[k], view, k, problem.config)
            terms.append(textures)
            # colours say where an object is better than its outline, which has shadows beside it
            count = torch.zeros(len(problem.bodies)) if textures is None else torch.bincount(
                textures.owner, minlength=len(problem.bodies)
            )
            rest = (count < ENOUGH).nonzero()[:, 0].tolist()
            terms.append(find_outlines(template, view.image, view, k, problem.config, only=rest, reach=reach))
    return templates, [t for t in terms if t is not None]


def _object_terms(problem: Problem, state: State, evidence, matches: Located | None, two: bool) -> list[Term]:
    """All terms but those of matches off the objects."""
    templates, aligned = evidence
    terms = [*_pose_terms(problem, state, two=two), *aligned]
    if matches is not None:
        on_objects = surface_matches(state, matches, templates, problem.views, problem.config)
        terms += [on_objects] if on_objects is not None else []
    return terms


def _fit_all(
    problem: Problem, state: State, evidence, matches: Located | None, two: bool, schedule: Sequence[float]
) -> tuple[Fit, list[Term]]:
    """Adjust to all terms. What objects say of the plane decides which matches may be on it."""
    for _ in range(2):  # feet of objects are those of where it has come so far
        terms = _object_terms(problem, state, evidence, matches, two)
        fit = adjust(state, terms, schedule)
        state = fit.state
    if matches is not None:
        for schedule in (FINE[:3], FINE[3:]):
            terms = _object_terms(problem, state, evidence, matches, two)
            terms += plane_matches(state, fit.covariance, matches, evidence[0], problem.views)
            fit = adjust(state, terms, schedule)
            state = fit.state
    return fit, terms


def _motions(problem: Problem, by_objects: Tensor | None, matches: Located | None) -> list[Tensor]:
    """T_view1_view0 to start from."""
    motions = [] if by_objects is None else [by_objects]
    if matches is None:
        return motions
    K0, K1 = (v.K for v in problem.views)
    plain = Matches(matches.points_0, matches.points_1, torch.ones(len(matches.points_0)))
    unit, info = motion_from_matches(plain, K0, K1)
    if unit is None:
        return motions
    # how long the baseline is, only objects can tell
    first = problem.measured[0]
    here = first.isfinite().flatten(1).all(1)
    if not bool(here.any()):
        return motions
    template = render_template(problem.bodies, first, K0, problem.views[0].size)
    points, _ = triangulate(unit, K0, K1, matches.points_0, matches.points_1)
    x, y = matches.points_0.round().long().unbind(1)
    on = info.inliers & (eroded(template.owner >= 0, BORDER)[y, x])
    if int(on.sum()) < 5:
        return motions
    length = (template.depth[y, x] / points[:, 2])[on].median()
    by_matches = unit.clone()
    by_matches[:3, 3] *= length
    if motions:
        turn = float(se3.log_so3(by_matches[:3, :3].mT @ motions[0][:3, :3]).norm())
        shift = float((by_matches - motions[0])[:3, 3].norm() / by_matches[:3, 3].norm())
        if turn < SAME_MOTION[0] and shift < SAME_MOTION[1]:
            return [by_matches]
    return [by_matches, *motions]


def _denser(problem: Problem, state: State, grays: Sequence[Tensor], matches: Located) -> Located:
    """Matches all over the table and the objects, found from where the state says they are.

    View 1 is warped into view 0 by the surfaces, and what is left of shifts is looked for: patches of curved surfaces map by
    no affine map, and would all be off to the same side.
    """
    K0, K1 = (v.K for v in problem.views)
    template = _templates(problem, state, two=False)[0]
    on = template.owner >= 0
    inner = torch.zeros_like(on)
    for k in range(len(problem.bodies)):
        inner |= eroded(template.owner == k, BORDER)
    points = torch.cat([corners(grays[0], ~grown(on, CLEAR), SPACING[0]), corners(grays[0], inner, SPACING[1])])
    warp, _ = predict_matches(state, template, K0, K1, _all_pixels(on.shape))
    warped = sample(grays[1], warp.nan_to_num(-1.0).reshape(*on.shape, 2), "bicubic")
    found = align_patches(grays[0], warped, points, points, deform=False)
    where, affine = predict_matches(state, template, K0, K1, points)
    where = where + (affine @ (found.points - points)[..., None])[..., 0]
    covariance = affine @ found.covariance @ affine.mT
    inside = ((where > 0) & (where < where.new_tensor(list(grays[1].shape[::-1])) - 1)).all(1) & found.good
    # rough matches still tell of what is neither table nor object
    x, y = matches.points_0.round().long().unbind(1)
    off = ~grown(on, CLEAR)[y.clamp(0, on.shape[0] - 1), x.clamp(0, on.shape[1] - 1)]
    dense = Located(points[inside], where[inside], covariance[inside])
    return Located(*(torch.cat([new, old[off]]) for new, old in zip(dense, matches, strict=True)))


def _all_pixels(size: tuple[int, int]) -> Tensor:
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2).double()


def _differ(first: State, second: State) -> bool:
    """Whether two planes are not the same but for noise."""
    tilt = torch.arccos((first.normal @ second.normal).clamp(-1.0, 1.0))
    height = (first.offset - first.normal @ first.middle) - (second.offset - second.normal @ first.middle)
    return float(tilt) > math.radians(5.0) or abs(float(height)) > 0.02


def _supported(problem: Problem, fit: Fit, terms: Sequence[Term]) -> Supported:
    standing = torch.zeros(len(problem.bodies), dtype=torch.bool)
    for term, squared in zip(terms, fit.surprise, strict=True):
        if isinstance(term, Contact):
            standing[term.owner] = squared < STANDS
    return Supported(fit.state, fit.covariance, fit.relative, fit.cost, standing)


def _solution(problem: Problem, fit: Fit, terms: Sequence[Term], rival: float, two: bool) -> Solution:
    table, priors = None, []
    for term, squared in zip(terms, fit.surprise, strict=True):
        if isinstance(term, PosePrior):
            across = term.residual(unknowns_at(fit.state))[0, :, 1:3]
            priors.append((across**2).sum(1))
        if isinstance(term, PlaneMatches):
            on = squared < FITS
            points_0 = term.rays[on] @ problem.views[0].K.mT
            table = Matches(points_0[:, :2], term.points_1[on], torch.ones(int(on.sum())))
    disagreement = float(torch.cat(priors).median()) if priors else 0.0
    return Solution(_supported(problem, fit, terms), table, rival, disagreement, two)
