"""One 4×4 array an object, as FoundationPose and other estimators return them: refined together, out as they came in."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.adapters.surroundings import OfImage, bodies_by_label, body_of, surroundings_of
from physpose_torch.alternatives import find_alternatives
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene

__all__ = ["refine_numpy"]

Array = np.ndarray | Tensor
Poses = TypeVar("Poses", dict[str, Array], list[tuple[str, Array]])


def refine_numpy(
    poses: Poses,
    bodies: Mapping[str, Body] | Iterable[Body],
    *,
    surroundings: OfImage = None,
    scores: Sequence[float] | Mapping[str, float] | None = None,
    config: RefinerConfig | None = None,
) -> Poses:
    """Refine the poses of the objects of one image together.

    ``estimator.register(K=, rgb=, depth=, ob_mask=, iteration=)`` and ``track_one`` of FoundationPose give such a pose: of the
    mesh as it was handed over, in metres, though the mesh is centred inside. So bodies must be made of that same mesh::

        poses = {name: estimators[name].register(K=K, rgb=rgb, depth=depth, ob_mask=masks[name], iteration=5) for name in masks}
        bodies = [Body.from_mesh(mesh, label=name) for name, mesh in meshes.items()]
        poses = refine_numpy(poses, bodies, surroundings=Plane(normal, offset))

    Args:
        poses: T_camera_object (4, 4) [m] by label, or pairs (label, pose) where a label may come many times; numpy arrays or
            tensors. They are not changed.
        bodies: by label, or an iterable of bodies that bear the labels.
        surroundings: the table, a :class:`~physpose_torch.geometry.body.Plane` in the camera frame, or a pair (statics,
            gravity); None: only collisions act.
        scores: a number for each pose, in order or by label. Rows of one label that overlap deeply are estimates of one
            object, and the best-scored one acts on the scene; None: the first one.
        config: cost and optimizer; None: the tuned default.

    Returns:
        The same labels in the same order and structure, each pose with its type, dtype and device.

    Raises:
        UnknownLabelError: a label without a body.
        InvalidInputError: a pose that is no (4, 4) array, not rigid, not in metres, or the exact identity, which is what
            FoundationPose returns for an empty mask; scores that do not fit.
    """
    pairs = _pairs(poses)
    known = bodies_by_label(bodies)
    objects = [body_of(label, known, "poses") for label, _ in pairs]
    measured = [_tensor(label, pose) for label, pose in pairs]
    T = torch.stack(measured) if measured else torch.zeros(0, 4, 4, dtype=torch.float64)
    se3.check_rigid(T, "poses", [label for label, _ in pairs] or None)
    confidence = _scores(scores, pairs)
    same = find_alternatives(T, Scene(objects), confidence)
    statics, gravity = surroundings_of(surroundings, 0)
    scene = Scene(objects, statics, gravity=gravity, same_object=same, n_images=1)
    refined = PhysPoseRefiner(config)(T, scene, scores=confidence).poses
    out = [(label, _like(T_new, pose)) for T_new, (label, pose) in zip(refined, pairs, strict=True)]
    return dict(out) if isinstance(poses, Mapping) else out


def _pairs(poses) -> list[tuple[str, Array]]:
    if isinstance(poses, Mapping):
        return list(poses.items())
    pairs = list(poses) if isinstance(poses, list | tuple) else [None]
    for i, pair in enumerate(pairs):
        if not (isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], str)):
            what = f"poses[{i}]" if isinstance(poses, list | tuple) else "poses"
            kind = type(pair if isinstance(poses, list | tuple) else poses).__name__
            raise InvalidInputError(
                f"{what} is a {kind}, expected a dict label → (4, 4), or a list of pairs (label, (4, 4))"
            )
    return [(label, pose) for label, pose in pairs]


def _tensor(label: str, pose: Array) -> Tensor:
    """(4, 4) float64 on the CPU."""
    if not isinstance(pose, np.ndarray | Tensor):
        raise InvalidInputError(
            f"poses[{label!r}] is a {type(pose).__name__}, expected a numpy array or a tensor (4, 4)"
        )
    tensor = pose.detach().cpu() if isinstance(pose, Tensor) else torch.from_numpy(np.array(pose))
    if tensor.shape != (4, 4) or not tensor.is_floating_point():
        shape, dtype = tuple(pose.shape), pose.dtype
        raise InvalidInputError(f"poses[{label!r}] has shape {shape} and dtype {dtype}, expected (4, 4) floating point")
    if bool((tensor == torch.eye(4)).all()):
        raise InvalidInputError(
            f"poses[{label!r}] is the identity, an object around the camera: FoundationPose returns it for an empty mask "
            "or a mask without depth; leave that object out"
        )
    return tensor.double()


def _scores(scores: Sequence[float] | Mapping[str, float] | None, pairs: Sequence[tuple[str, Array]]) -> Tensor:
    if scores is None:
        return torch.zeros(len(pairs), dtype=torch.float64)
    if isinstance(scores, Mapping):
        missing = [label for label, _ in pairs if label not in scores]
        if missing:
            raise InvalidInputError(f"scores has none for {missing[0]!r}; give one for each label, or none at all")
        scores = [scores[label] for label, _ in pairs]
    values = torch.as_tensor([float(score) for score in scores], dtype=torch.float64)
    if len(values) != len(pairs) or not bool(values.isfinite().all()):
        raise InvalidInputError(f"scores = {values.tolist()}, expected {len(pairs)} finite numbers, one a pose")
    return values


def _like(T: Tensor, pose: Array) -> Array:
    return T.to(pose) if isinstance(pose, Tensor) else T.numpy().astype(pose.dtype)
