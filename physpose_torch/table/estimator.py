"""The support table from one or two images of a scene whose objects have estimated poses (paper, Sec. 3.2)."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import TableConfig
from physpose_torch.errors import InvalidInputError, MissingExtraError, TableNotFoundError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.table.view import View

if TYPE_CHECKING:
    from physpose_torch.table.found import Problem
    from physpose_torch.table.roles import Matches

__all__ = ["TableEstimate", "TableEstimator"]

logger = logging.getLogger("physpose_torch")

STILL = 1.0
"""[px]; matches that move by less than this, in the median, show no other view."""
RIVAL = 5.0
"""Two planes whose costs differ by less than this are about as likely."""
DISAGREE = 7.0
"""Squared deviation of the typical object from its estimate across the viewing ray, 2 in the mean if all is well; above this,
something is wrong with all of them."""
IMPLAUSIBLE = 16.0
"""The same of the depth factor that all poses share."""
FEW_MATCHES = 8
"""Fewer matches on the table than this say little of it."""


@dataclass(frozen=True, eq=False)
class TableEstimate:
    """A table plane, and what it is worth."""

    plane: Plane
    """In the camera of view 0. Its covariance is that against poses estimated in the same images, which share the error of its
    scale: what contacts with it need."""
    covariance: Tensor
    """(3, 3) the same against the world: that error included."""
    method: str
    """What it was found by."""
    scale: float | None
    """Metres a unit of the two-view reconstruction: the length of the baseline, or the factor of a given depth map. None: of
    one view there is none."""
    inliers: int
    """Matches that are on the table."""
    warnings: tuple[str, ...]
    """What should be known before it is used."""
    depth_factor: float
    """What the estimated translations must be multiplied by to agree with the images; 1 where nothing was found of it."""
    T_view1_view0: Tensor | None
    """(4, 4) where the second camera is [m]; None for one view."""
    poses: Tensor
    """(N, 4, 4) T_camera_object in view 0 that go with the plane: aligned with the images by ``joint``, else as given [m]."""
    standing: Tensor
    """(N,) bool: objects that stand on it."""
    contacts: Tensor
    """(C, 3) where they do, view 0 [m]."""

    @property
    def sigma_tilt(self) -> float:
        """Standard deviation of the normal against the world, the worse of two axes [rad]."""
        return float(torch.linalg.eigvalsh(self.covariance[:2, :2].double()).amax().sqrt())

    @property
    def sigma_offset(self) -> float:
        """Standard deviation of the height under the objects against the world [m]."""
        return float(self.covariance[2, 2].double().sqrt())

    def __repr__(self) -> str:
        normal = ", ".join(f"{x:.4f}" for x in self.plane.normal.tolist())
        return (
            f"TableEstimate(normal=({normal}) ± {math.degrees(self.sigma_tilt):.2f}°, offset={float(self.plane.offset):.4f} m "
            f"± {1e3 * self.sigma_offset:.1f} mm, {self.method}, {int(self.standing.sum())} objects stand on it, "
            f"{self.inliers} matches, {len(self.warnings)} warnings)"
        )


class TableEstimator:
    """Estimates the plane that objects stand on, from their estimated poses in one or two images.

    Args:
        config: method and standard deviations; see :class:`~physpose_torch.config.TableConfig`.
        models: models by role (:mod:`physpose_torch.table.roles`), or a manifest of ONNX files (models/README.md). An
            extractor, matcher or pair matcher finds the matches instead of XFeat or SIFT; a reconstructor and a detector
            serve method ``paper``.
    """

    def __init__(
        self, config: TableConfig | None = None, *, models: Mapping[str, Callable] | str | Path | None = None
    ) -> None:
        self.config = TableConfig() if config is None else config
        self._given = models

    @cached_property
    def models(self) -> Mapping[str, Callable]:
        """Models by role."""
        if isinstance(self._given, str | Path):
            from physpose_torch.table.onnx import load_models

            return load_models(self._given)
        return self._given or {}

    def __call__(
        self, views: View | Sequence[View], bodies: Sequence[Body], *, gravity: Tensor | None = None
    ) -> TableEstimate:
        """Find the table.

        Args:
            views: one or two images with the objects' poses; the plane comes in the camera of the first.
            bodies: N objects, in the order of the poses. Meshes with colours are used by their colours.
            gravity: (3,) unit vector pointing down in the camera of view 0, by an IMU or a robot: a soft prior.

        Raises:
            InvalidInputError: numbers of views, bodies and poses do not fit, or gravity is no unit vector.
            TableNotFoundError: the evidence is too thin, or contradicts itself.
        """
        with torch.inference_mode(False), torch.no_grad():
            problem = self._problem(views, bodies, gravity)
            estimate = self._solve(problem)
        like = next(v.poses for v in problem.views if v.poses is not None)
        plane = estimate.plane
        plane = Plane(*(x.to(like) for x in (plane.normal, plane.offset, plane.covariance)))
        moved = {name: getattr(estimate, name).to(like) for name in ("covariance", "poses", "contacts")}
        return TableEstimate(**{**estimate.__dict__, **moved, "plane": plane})

    def _problem(self, views: View | Sequence[View], bodies: Sequence[Body], gravity: Tensor | None) -> "Problem":
        from physpose_torch.table.found import Problem

        views = [views] if isinstance(views, View) else list(views)
        if len(views) not in (1, 2) or not all(isinstance(v, View) for v in views):
            raise InvalidInputError(f"got {len(views)} views, expected one or two of physpose_torch.View")
        for i, body in enumerate(bodies):
            if not isinstance(body, Body):
                raise InvalidInputError(f"bodies[{i}] is a {type(body).__name__}, expected a Body")
        measured = []
        for i, view in enumerate(views):
            if view.poses is not None and len(view.poses) != len(bodies):
                raise InvalidInputError(
                    f"views[{i}] has {len(view.poses)} poses for {len(bodies)} bodies; give NaN rows for objects not seen"
                )
            none = torch.full((len(bodies), 4, 4), torch.nan, dtype=torch.float64)
            measured.append(none if view.poses is None else view.poses.detach().to("cpu", torch.float64).clone())
        seen = [bool(m.isfinite().flatten(1).all(1).any()) for m in measured]
        if not any(seen):
            raise TableNotFoundError("no object has an estimated pose; without objects nothing tells how large things are")
        if not seen[0]:
            raise TableNotFoundError(
                "no object has an estimated pose in view 0, in whose camera the plane is wanted; swap the views"
            )
        if gravity is not None:
            gravity = torch.as_tensor(gravity).detach().to("cpu", torch.float64)
            if gravity.shape != (3,) or not abs(float(torch.linalg.vector_norm(gravity)) - 1) < 1e-3:
                raise InvalidInputError(f"gravity = {gravity.tolist()}, expected a unit vector (3,) pointing down")
        return Problem(views, list(bodies), measured, self.config, gravity)

    def _solve(self, problem: "Problem") -> TableEstimate:
        from physpose_torch.table.homography import fit_homography
        from physpose_torch.table.joint import fit_joint, fit_support, rival_cost
        from physpose_torch.table.paper import fit_paper

        method = self.config.method
        if method in ("homography", "paper"):
            if method == "paper":
                found = fit_paper(problem, self._find_matches, self.models)
            else:
                found = fit_homography(problem, self._find_matches)
            motion = found.motion
            if motion is not None:
                motion = motion.clone()
                motion[:3, 3] *= found.unit
            inliers = 0 if found.table is None else len(found.table.points_0)
            return self._checked(problem, found.normal, found.offset, found.covariance, method, found.scale, inliers, motion)
        warnings: list[str] = []
        if method == "support":
            fits = fit_support(problem._replace(views=problem.views[:1], measured=problem.measured[:1]))
            if not fits:
                raise TableNotFoundError("no object has a pose in view 0 and a shape that can stand on something")
            rival = rival_cost(fits)
            return self._of_fit(problem, fits[0], "support", rival, None, warnings, two=False)
        problem, matches = self._usable_views(problem, warnings)
        solution = fit_joint(problem, lambda *images: matches)
        if solution is not None and solution.two and not bool(solution.fit.standing.any()):
            warnings.append("with the second image nothing stands on any plane: it was left out")
            problem = problem._replace(views=problem.views[:1], measured=problem.measured[:1])
            solution = fit_joint(problem, lambda *images: None)
        if solution is None:
            raise TableNotFoundError("no object has a shape and a pose with which it could stand on something")
        # what the images say of all distances together, against what was believed of them
        off = ((float(solution.fit.state.depth_factor) - 1.0) / self.config.sigma_depth_common) ** 2
        if solution.disagreement > DISAGREE or off > IMPLAUSIBLE:
            # images that contradict all poses belong to other poses, or to another camera
            warnings.append(
                "images and estimated poses contradict each other (wrong intrinsics, or poses of another image?): "
                "the table is by the poses alone"
            )
            fits = fit_support(problem._replace(views=problem.views[:1], measured=problem.measured[:1]))
            if not fits:
                raise TableNotFoundError("images and estimated poses contradict each other; check the intrinsics")
            rival = rival_cost(fits)
            worse = max(solution.disagreement, off) / 2.0
            fit = fits[0]._replace(covariance=fits[0].covariance * worse, relative=fits[0].relative * worse)
            return self._of_fit(problem, fit, "support", rival, None, warnings, two=False)
        two = solution.two
        return self._of_fit(problem, solution.fit, "joint", solution.rival, solution.table, warnings, two=two)

    def _find_matches(self, image_0: Tensor, image_1: Tensor) -> "Matches":
        """By the user's models, XFeat or SIFT."""
        from physpose_torch.table.matching import MutualNearest, Sift, join

        if "pair_matcher" in self.models:
            return self.models["pair_matcher"](image_0, image_1)
        matcher = self.models.get("matcher", MutualNearest())
        if "extractor" in self.models:
            return matcher(self.models["extractor"](image_0), self.models["extractor"](image_1))
        sift = Sift()
        matches = MutualNearest()(sift(image_0), sift(image_1))
        if self.config.features == "sift":
            return matches
        try:
            from physpose_torch.table.xfeat import XFeatPair

            return join(matches, self._xfeat(XFeatPair)(image_0, image_1))
        except MissingExtraError:
            if self.config.features == "xfeat":
                raise
            logger.info("XFeat is not installed (extra 'table'): matches are by SIFT alone")
            return matches

    def _xfeat(self, kind: Callable) -> Callable:
        if not hasattr(self, "_pair"):
            self._pair = kind()
        return self._pair

    def _usable_views(self, problem: "Problem", warnings: list[str]) -> tuple["Problem", "Matches | None"]:
        """Leave out a second view that shows nothing else, and say so."""
        views = problem.views
        if len(views) < 2 or any(v.image is None for v in views):
            return problem, None
        matches = self._find_matches(views[0].image, views[1].image)
        moved = torch.linalg.vector_norm(matches.points_1 - matches.points_0, dim=1)
        if len(moved) >= FEW_MATCHES and float(moved.median()) < STILL:
            warnings.append("both images are from the same place: the second was left out")
            return problem._replace(views=views[:1], measured=problem.measured[:1]), None
        return problem, matches

    def _of_fit(self, problem: "Problem", fit, method: str, rival: float, table, warnings: list[str], *, two: bool):
        state = fit.state
        inliers = 0 if table is None else len(table.points_0)
        standing = fit.standing
        count = int(standing.sum())
        if rival < RIVAL:
            raise TableNotFoundError(
                f"two different planes are about as likely ({len(problem.bodies)} objects, {inliers} matches on the table); "
                "give the direction of gravity, or a second view of a table with texture"
            )
        if not count:
            raise TableNotFoundError(
                f"none of {len(problem.bodies)} objects stands on the plane that explains poses and images best; are they "
                "on the table, and the poses those of these images?"
            )
        if (count == 1 or (count == 2 and problem.gravity is None)) and inliers < FEW_MATCHES:
            # two may as well lean on a wall
            warnings.append(
                f"only {count} object{'s' * (count > 1)} stand{'s' * (count == 1)} on the table that was found, and no image "
                "confirms it; the direction of gravity would"
            )
        elif count * 3 < len(problem.bodies):
            warnings.append(f"only {count} of {len(problem.bodies)} objects stand on the table that was found")
        if method == "joint" and len(problem.views) == 2 and not two:
            warnings.append("the second image does not match the first: it was left out")
        elif method == "joint" and two and inliers < FEW_MATCHES:
            warnings.append("there are hardly any matches on the table: it is known by the objects that stand on it")
        motion = state.T_view1_view0 if two else None
        scale = float(torch.linalg.vector_norm(motion[:3, 3])) if two else None
        return self._checked(
            problem,
            state.normal,
            state.offset,
            fit.covariance,
            method,
            scale,
            inliers,
            motion,
            poses=state.poses,
            standing=standing,
            depth_factor=float(state.depth_factor),
            relative=fit.relative,
            warnings=warnings,
        )

    def _checked(
        self,
        problem: "Problem",
        normal: Tensor,
        offset: Tensor,
        covariance: Tensor,
        method: str,
        scale: float | None,
        inliers: int,
        motion: Tensor | None,
        *,
        poses: Tensor | None = None,
        standing: Tensor | None = None,
        depth_factor: float = 1.0,
        relative: Tensor | None = None,
        warnings: Sequence[str] = (),
    ) -> TableEstimate:
        """The estimate, if it is worth one."""
        from physpose_torch.table.standing import standing_on

        covariance = 0.5 * (covariance + covariance.mT)
        relative = covariance.clone() if relative is None else 0.5 * (relative + relative.mT)
        if method != "support":
            covariance[2, 2] += (self.config.sigma_scale * offset) ** 2
        tilt = float(torch.linalg.eigvalsh(covariance[:2, :2]).amax().clamp_min(0).sqrt())
        height = float(covariance[2, 2].clamp_min(0).sqrt())
        if not (tilt < self.config.widest_tilt and height < self.config.widest_offset):
            raise TableNotFoundError(
                f"the table is known only to {math.degrees(tilt):.1f}° and {1e3 * height:.0f} mm (standard deviations), worse "
                f"than the {math.degrees(self.config.widest_tilt):.1f}° and {1e3 * self.config.widest_offset:.0f} mm asked for "
                "(widest_tilt, widest_offset); more objects, texture, a second view or the direction of gravity would help"
            )
        if float(offset) >= 0:
            raise TableNotFoundError("the plane that was found is above the camera; are the poses in this camera's frame?")
        warnings = list(warnings)
        if problem.gravity is not None:
            apart = math.acos(max(-1.0, min(1.0, float(-normal @ problem.gravity))))
            if apart > 4 * math.hypot(tilt, self.config.sigma_gravity):
                warnings.append(f"the table is {math.degrees(apart):.1f} degrees off level by the gravity that was given")
        poses = problem.measured[0] if poses is None else poses
        feet = standing_on(problem.bodies, poses, normal)
        if standing is None:
            here = feet.lowest.isfinite().all(1)
            height_of = se3.apply(poses, feet.lowest[:, None])[:, 0] @ normal - offset
            slack = self.config.sigma_ray_fraction * torch.linalg.vector_norm(poses[:, :3, 3], dim=1)
            standing = here & (height_of.abs() < 3 * slack)
        contacts = se3.apply(poses[standing], feet.points[standing]).reshape(-1, 3)
        plane = Plane(normal, offset, relative)
        return TableEstimate(
            plane, covariance, method, scale, inliers, tuple(warnings), depth_factor, motion, poses, standing, contacts
        )
