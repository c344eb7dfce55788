"""Pose collections of happypose, MegaPose and CosyPose: in as a depth refiner, out with refined poses.

What is asked of a ``PandasTensorCollection``: ``infos``, a pandas table with a column ``label``; ``poses`` (N, 4, 4), set like
an attribute; ``clone()``; ``len()``. Nothing is imported from the project, nor is pandas.
"""

import time
from collections.abc import Hashable, Iterable, Mapping, Sequence
from copy import copy
from typing import Any, Literal

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.adapters.surroundings import SurroundingsOf, bodies_by_label, body_of, surroundings_of
from physpose_torch.alternatives import find_alternatives
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene

__all__ = ["HappyPoseRefiner"]

SCORES = ("pose_score", "coarse_score", "score")
"""MegaPose's score of the refined pose, that of the coarse one, and the detector's, which all hypotheses share."""
IMAGES = (("scene_id", "view_id"), ("scene_id", "im_id"), ("batch_im_id",))
"""``batch_im_id`` comes last: it starts anew with each batch, so in predictions of many batches it names many images."""


class HappyPoseRefiner:
    """Make the poses of a ``PandasTensorCollection`` physically consistent, image by image, all images in one batch.

    It has the signature of happypose's ``DepthRefiner`` and goes where ICP or TEASER++ would,
    ``PoseEstimator(depth_refiner=…)``. As that asks for RGB-D input then, call it on the pipeline's output otherwise::

        refine = HappyPoseRefiner(bodies_from_rigid_objects(object_dataset), surroundings=Plane(normal, offset))
        refined = refine(predictions)                          # or: refined, extra_data = refine.refine_poses(predictions)

    Rows of one image, label and ``instance_id`` are hypotheses of one object (happypose counts instances anew for each
    label), and so are rows of one label that overlap deeply, see :func:`~physpose_torch.alternatives.find_alternatives`. All
    are refined; the best-scored one acts on the scene, the others push nobody.

    Args:
        bodies: by the estimator's labels, or an iterable of bodies that bear them.
        surroundings: table, static bodies and gravity: a :class:`~physpose_torch.geometry.body.Plane` (horizontal, camera
            frame) or a pair (statics, gravity), for all images; a mapping from an image's key to that; or a function of
            the key. The key is the row's value of ``group_by``, a tuple where that is several columns. None: only
            collisions act.
        config: cost and optimizer; None: the tuned default.
        score: column that ranks hypotheses; None: the first of ``pose_score``, ``coarse_score``, ``score`` that there is,
            and without any the first row counts.
        group_by: columns that name an image; None: ``scene_id, view_id``, else ``scene_id, im_id``, else ``batch_im_id``, and
            without any all rows are of one image, with key 0.
        unknown: rows whose label has no body: ``"raise"``, or ``"keep"`` them as they are and out of the scene.
        duplicates: look for rows that overlap deeply; False: every instance is an object of its own.

    Raises:
        InvalidInputError: bodies or options that are none.
    """

    def __init__(
        self,
        bodies: Mapping[str, Body] | Iterable[Body],
        *,
        surroundings: SurroundingsOf = None,
        config: RefinerConfig | None = None,
        score: str | None = None,
        group_by: str | Sequence[str] | None = None,
        unknown: Literal["raise", "keep"] = "raise",
        duplicates: bool = True,
    ) -> None:
        if unknown not in ("raise", "keep"):
            raise InvalidInputError(f"unknown = {unknown!r}, expected 'raise' or 'keep'")
        self.bodies = bodies_by_label(bodies)
        self.surroundings = surroundings
        self.refiner = PhysPoseRefiner(config)
        self.score, self.unknown, self.duplicates = score, unknown, duplicates
        self.group_by = (group_by,) if isinstance(group_by, str) else group_by

    def __call__(self, predictions: Any) -> Any:
        """The refined collection alone; see :meth:`refine_poses`."""
        return self.refine_poses(predictions)[0]

    def refine_poses(
        self, predictions: Any, masks: Tensor | None = None, depth: Tensor | None = None, K: Tensor | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Refine all poses of a collection.

        Args:
            predictions: T_camera_object in ``poses`` (N, 4, 4) [m]; it is not changed.
            masks: ignored, as are ``depth`` and ``K``: physics asks for no image.

        Returns:
            A clone with new ``poses`` on the same device and of the same dtype, all else (tensors, columns, index, ``meta``)
            as it was; and a dict: ``refinement`` (:class:`~physpose_torch.refiner.Refinement`) and its ``report``, whose
            object i is row ``rows[i]`` (long) of the collection and whose image j is ``images[j]``, and ``time`` [s].

        Raises:
            UnknownLabelError: a label without a body, unless they are kept.
            InvalidInputError: a column is missing or has gaps, poses are not rigid or not in metres, or the surroundings do
                not fit.
        """
        begin = time.perf_counter()
        poses = self._poses(predictions)
        scene, rows, keys, scores = self._scene(predictions, poses)
        refinement = self.refiner(poses[rows.to(poses.device)], scene, scores=scores)
        refined = predictions.clone()
        refined.infos = predictions.infos.copy()  # happypose's clone numbers the rows anew,
        if hasattr(predictions, "meta"):  # and forgets meta
            refined.meta = copy(predictions.meta)
        if len(rows):
            # unless gradients come out of the refiner, none of the rows that are kept should claim to have any
            new = poses.clone() if refinement.poses.requires_grad else poses.detach().clone()
            new[rows.to(poses.device)] = refinement.poses
            refined.poses = new
        extra_data = {
            "refinement": refinement,
            "report": refinement.report,
            "rows": rows,
            "images": keys,
            "time": time.perf_counter() - begin,
        }
        return refined, extra_data

    def _poses(self, predictions: Any) -> Tensor:
        if not hasattr(predictions, "infos"):
            kind = type(predictions).__name__
            raise InvalidInputError(f"predictions is a {kind}, expected a PandasTensorCollection with infos and poses")
        if len(predictions) == 0:  # happypose has no columns then, and tensors of any shape or none
            return torch.zeros(0, 4, 4)
        poses = getattr(predictions, "poses", None)
        if not isinstance(poses, Tensor) or poses.shape != (len(predictions), 4, 4):
            given = f"shape {tuple(poses.shape)}" if isinstance(poses, Tensor) else type(poses).__name__
            raise InvalidInputError(
                f"predictions.poses: got {given}, expected a tensor ({len(predictions)}, 4, 4), one pose a row of infos"
            )
        return poses

    def _scene(self, predictions: Any, poses: Tensor) -> tuple[Scene, Tensor, list[Hashable], Tensor]:
        """The scene of all images, the row of each of its objects, the key of each image, and the objects' scores."""
        if len(predictions) == 0:
            return Scene((), n_images=0), torch.zeros(0, dtype=torch.long), [], torch.zeros(0)
        infos = predictions.infos
        labels = _column(infos, "label")
        known = [i for i, label in enumerate(labels) if label in self.bodies or self.unknown == "raise"]
        bodies = {i: body_of(labels[i], self.bodies, f"predictions row {i}") for i in known}
        chosen = torch.zeros(len(labels), dtype=torch.bool)
        chosen[known] = True
        # here, as the scene knows its objects only by other numbers than the rows
        se3.check_rigid(
            torch.where(chosen[:, None, None], poses.detach().cpu(), torch.eye(4)), "predictions.poses", labels
        )
        image_of = self._images(infos)
        keys = list(dict.fromkeys(image_of[i] for i in known))
        number = {key: j for j, key in enumerate(keys)}
        image = torch.tensor([number[image_of[i]] for i in known], dtype=torch.long)
        objects = [bodies[i] for i in known]
        scores = self._scores(infos, known)
        instances = _column(infos, "instance_id") if "instance_id" in infos else [None] * len(labels)
        groups = [i if _missing(instances[i]) else (image_of[i], labels[i], instances[i]) for i in known]
        plain = Scene(objects, image=image, n_images=len(keys))
        rows = torch.tensor(known, dtype=torch.long)
        same = _same_object(poses.cpu()[rows], plain, scores, groups, self.duplicates)
        around = [surroundings_of(self.surroundings, key) for key in keys]
        statics = [static.in_image(j) for j, found in enumerate(around) for static in found.statics]
        down = torch.zeros(len(keys), 3, dtype=torch.float64)
        for j, (_, gravity) in enumerate(around):
            if gravity is not None:
                down[j] = torch.as_tensor(gravity).detach().to(down)
        scene = Scene(objects, statics, gravity=down, image=image, n_images=len(keys), same_object=same)
        return scene, rows, keys, scores

    def _images(self, infos: Any) -> list[Hashable]:
        """The key of each row's image."""
        columns = self.group_by
        if columns is None:
            columns = next((names for names in IMAGES if all(name in infos for name in names)), ())
        values = [_column(infos, name, complete=True) for name in columns]
        if not values:
            return [0] * len(infos)
        return values[0] if len(values) == 1 else list(zip(*values, strict=True))

    def _scores(self, infos: Any, rows: Sequence[int]) -> Tensor:
        name = self.score or next((name for name in SCORES if name in infos), None)
        if name is None:
            return torch.zeros(len(rows), dtype=torch.float64)
        values = _column(infos, name)
        try:
            scores = torch.tensor([float(values[i]) for i in rows], dtype=torch.float64)
        except (TypeError, ValueError):
            scores = torch.full((len(rows),), torch.nan)
        if not bool(scores.isfinite().all()):
            raise InvalidInputError(
                f"infos[{name!r}] has gaps or what is no finite number; fill them, or name another column by score="
            )
        return scores


def _same_object(poses: Tensor, scene: Scene, scores: Tensor, groups: Sequence[Hashable], duplicates: bool) -> Tensor:
    """Numbers (N,) for ``Scene(same_object=...)``: the best-scored row of each group, and where such rows overlap deeply,
    the best of these. Only the best are compared, so that a stray hypothesis does not make one object of two."""
    best: dict[Hashable, int] = {}
    leader = list(range(len(scene)))
    for i in torch.argsort(scores, descending=True, stable=True).tolist():
        leader[i] = best.setdefault(groups[i], i)
    leaders = sorted(best.values())
    if duplicates and leaders:
        objects = Scene([scene.objects[i] for i in leaders], image=scene.image[leaders], n_images=scene.n_images)
        found = find_alternatives(poses[leaders], objects, scores[leaders]).tolist()
        better = {i: leaders[j] for i, j in zip(leaders, found, strict=True)}
        leader = [better[i] for i in leader]
    return torch.tensor(leader, dtype=torch.long)


def _column(infos: Any, name: str, *, complete: bool = False) -> list:
    """A column's values as Python's own, by position."""
    if name not in infos:
        columns = ", ".join(map(repr, infos.columns)) or "none"
        raise InvalidInputError(f"predictions.infos has no column {name!r}; there are {columns}")
    values = infos[name].tolist()
    if complete and any(map(_missing, values)):
        row = next(i for i, value in enumerate(values) if _missing(value))
        raise InvalidInputError(
            f"infos[{name!r}] is missing in row {row}, so its image is unknown; fill it, or name other columns by group_by="
        )
    return values


def _missing(value: Any) -> bool:
    """None, NaN, NaT or pandas.NA."""
    try:
        return value is None or bool(value != value)
    except TypeError:  # pandas.NA compared with anything is neither true nor false
        return True
