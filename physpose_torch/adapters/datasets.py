"""Bodies of the objects that an estimator knows: ``RigidObjectDataset`` of happypose and MegaPose, or a folder of meshes."""

from collections.abc import Container, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.bop.dataset import MESH_SCALE, symmetry_transforms
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body

__all__ = ["bodies_from_folder", "bodies_from_rigid_objects"]

UNITS = {"m": 1.0, "mm": 0.001}
FORMATS = (".obj", ".ply")
CENTER_SHIFT = 0.05
"""A symmetry may move the centre of the hull by this fraction of the body's size; approximate ones do, by less."""


def bodies_from_rigid_objects(
    objects: Any,
    *,
    labels: Container[str] | None = None,
    symmetries: bool = True,
    max_symmetry_step: float = 0.01,
    **coacd_options,
) -> dict[str, Body]:
    """Bodies, in metres, of a dataset of rigid objects; decomposed into convex parts, which are cached on disk.

    ``ypr_offset_deg`` is not applied: it is how one renderer's loader turns a mesh, and poses refer to the file as it is.

    Args:
        objects: a ``RigidObjectDataset``, or an iterable of objects with ``label``, ``mesh_path``, and ``scale`` (factor to
            metres) or ``mesh_units`` ("m" or "mm"); where they have ``symmetries_discrete`` (each with a ``pose`` (4, 4)) and
            ``symmetries_continuous`` (``axis`` and ``offset``), in units of the mesh, the bodies get them.
        labels: the objects to make; None: all.
        symmetries: hand on the symmetries.
        max_symmetry_step: how finely continuous ones are sampled, see
            :func:`~physpose_torch.bop.dataset.symmetry_transforms`.
        **coacd_options: see :meth:`Body.from_mesh`.

    Returns:
        label → body.

    Raises:
        InvalidInputError: an object lacks an attribute, has unknown units, or shares its label with another.
        DataError: a mesh that cannot be read; symmetries that are broken, or not in the units of the mesh.
    """
    found: dict[str, Body] = {}
    for number, thing in enumerate(_listed(objects)):
        label, path = _attribute(thing, "label", number), _attribute(thing, "mesh_path", number)
        if labels is not None and label not in labels:
            continue
        if label in found:
            raise InvalidInputError(f"two objects are called {label!r}; labels must differ")
        scale = _scale(thing, label)
        transforms = _symmetries(thing, label, scale, max_symmetry_step) if symmetries else None
        body = Body.from_mesh(path, label=label, scale=_believed(scale), symmetries=transforms, **coacd_options)
        if transforms is not None:
            _check_symmetries(body)
        found[label] = body
    return found


def bodies_from_folder(
    folder: str | Path, *, mesh_units: str = "mm", labels: Container[str] | None = None, **coacd_options
) -> dict[str, Body]:
    """Bodies of a folder ``<label>/*.ply`` or ``*.obj`` (MegaPose's examples), or ``<label>.ply`` (happypose's).

    Args:
        folder: an example's ``meshes``.
        mesh_units: "mm", as in MegaPose's examples, or "m".
        labels: the objects to make; None: all.
        **coacd_options: see :meth:`Body.from_mesh`.

    Returns:
        label → body, sorted by label.

    Raises:
        InvalidInputError: unknown units.
        DataError: no such folder or no mesh in it, two meshes for one label, or a mesh that cannot be read or that is of
            other units.
    """
    folder, scale = Path(folder), _unit(mesh_units, "bodies_from_folder")
    if not folder.is_dir():
        raise DataError(
            f"{folder}: no such folder; expected meshes <label>/*.ply, <label>/*.obj, <label>.ply or <label>.obj"
        )
    meshes: dict[str, Path] = {}
    for path in sorted(path for path in (*folder.glob("*"), *folder.glob("*/*")) if path.suffix.lower() in FORMATS):
        label = path.stem if path.parent == folder else path.parent.name
        if label in meshes:
            raise DataError(f"{folder}: two meshes for {label!r}, {meshes[label]} and {path}; keep one of them")
        meshes[label] = path
    if not meshes:
        raise DataError(f"{folder}: no mesh in it; expected <label>/*.ply, <label>/*.obj, <label>.ply or <label>.obj")
    wanted = sorted(label for label in meshes if labels is None or label in labels)
    scale = _believed(scale)
    return {label: Body.from_mesh(meshes[label], label=label, scale=scale, **coacd_options) for label in wanted}


def _listed(objects: Any) -> Iterable:
    listed = getattr(objects, "list_objects", objects)
    try:
        return iter(listed)  # also what has only a length and __getitem__
    except TypeError as error:
        kind = type(objects).__name__
        raise InvalidInputError(
            f"objects is a {kind}, expected a RigidObjectDataset or an iterable of objects"
        ) from error


def _attribute(thing: Any, name: str, number: int) -> Any:
    if not hasattr(thing, name):
        raise InvalidInputError(
            f"objects[{number}] is a {type(thing).__name__} without {name!r}; expected a RigidObject"
        )
    return getattr(thing, name)


def _believed(scale: float) -> float | None:
    """Metres are what happypose takes meshes to be in if nobody says; so a mesh of a hundred of them is in millimetres."""
    return None if scale == 1.0 else scale


def _scale(thing: Any, label: str) -> float:
    if hasattr(thing, "scale"):
        return float(thing.scale)
    if hasattr(thing, "mesh_units"):
        return _unit(thing.mesh_units, label)
    raise InvalidInputError(f"{label}: neither 'scale' nor 'mesh_units' says what unit the mesh is in")


def _unit(name: str, label: str) -> float:
    if name not in UNITS:
        raise InvalidInputError(f"{label}: mesh_units = {name!r}, expected 'm' or 'mm'")
    return UNITS[name]


def _symmetries(thing: Any, label: str, scale: float, max_step: float) -> Tensor | None:
    """(S, 4, 4) [m] with the identity, or None. Made from the lists: ``make_symmetry_poses`` rescales them in place."""
    discrete = list(getattr(thing, "symmetries_discrete", None) or ())
    continuous = list(getattr(thing, "symmetries_continuous", None) or ())
    if not discrete and not continuous:
        return None
    mm = scale / MESH_SCALE  # what reads BOP's symmetries asks for millimetres
    try:
        poses = [torch.as_tensor(symmetry.pose, dtype=torch.float64).reshape(4, 4).clone() for symmetry in discrete]
        for pose in poses:
            pose[:3, 3] *= mm
        axes = [
            {"axis": list(symmetry.axis), "offset": [float(x) * mm for x in symmetry.offset]} for symmetry in continuous
        ]
        info = {"symmetries_discrete": [pose.tolist() for pose in poses], "symmetries_continuous": axes}
        return symmetry_transforms(info, max_step)
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise DataError(
            f"{label}: broken symmetry ({error}); expected pose (4, 4), or axis (3,) and offset (3,)"
        ) from error


def _check_symmetries(body: Body) -> None:
    """Symmetries leave the centre where it is; those that happypose has rescaled in place (each
    ``MeshDataBase.batched()`` does) turn the body about a wrong point."""
    center = torch.tensor(body.mesh.convex_hull.center_mass, dtype=torch.float64)
    shift = torch.linalg.vector_norm(se3.apply(body.symmetries, center[None])[:, 0] - center, dim=1)
    if bool((shift > CENTER_SHIFT * 2 * body.radius).any()):
        raise DataError(
            f"{body.label}: symmetry {int(shift.argmax())} moves the centre of the mesh by {1000 * float(shift.max()):.0f} mm; "
            "its translation should be in the units of the mesh. happypose rescales it in place in MeshDataBase.batched(): "
            "make the bodies before that, or leave symmetries out by symmetries=False"
        )
