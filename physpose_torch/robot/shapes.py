"""A link's collision shapes as one body of convex parts, in the link frame."""

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal
from urllib.parse import unquote, urlsplit

import numpy as np
import trimesh

from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body, load_mesh
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.reading import shown
from physpose_torch.robot.urdf import Collision, RobotModel

__all__ = ["Meshes", "find_mesh", "link_body"]

Meshes = Literal["decompose", "hull"]
"""What becomes of a collision mesh: convex parts by CoACD (cached on disk), or its convex hull."""

SIDES = 32
"""Of the prism around a cylinder: its corners stand out by 0.5 % of the radius."""
SUBDIVISIONS = 2
"""Of the icosahedron around a sphere: 320 triangles, whose corners stand out by 1.8 % of the radius."""
LARGEST = 10.0
"""[m]; a link larger than this is in other units."""


def link_body(
    model: RobotModel, link: str, *, packages: Mapping[str, str | Path] | None = None, meshes: Meshes = "decompose"
) -> Body | None:
    """All collision shapes of a link as one body in the link frame [m]; None if there are none.

    Boxes are exact. Round shapes become polyhedra that contain them, so that a robot is never thinner than it is: what is
    kept clear of the polyhedron is clear of the shape, and stays up to 0.5 % of a cylinder's radius and 1.8 % of a sphere's
    farther away than it must.

    Raises:
        DataError: a mesh is missing or cannot be read, or a link is larger than 10 m.
        InvalidInputError: ``meshes`` is neither of the two.
    """
    if meshes not in ("decompose", "hull"):
        raise InvalidInputError(f"meshes = {meshes!r}, expected 'decompose' or 'hull'")
    hulls: list[np.ndarray] = []
    surfaces: list[trimesh.Trimesh] = []
    for i, collision in enumerate(model.links[link]):
        where = f"{model.path}: link {link!r}, collision {i}"
        surface, parts = _shape(collision, where, model.path, packages, meshes)
        T = collision.T_link_shape.numpy()
        surface.apply_transform(T)
        surfaces.append(surface)
        hulls += [trimesh.transform_points(p, T) for p in parts]
    if not surfaces:
        return None
    whole = surfaces[0] if len(surfaces) == 1 else trimesh.util.concatenate(surfaces)
    if max(whole.extents) > LARGEST:
        raise DataError(
            f"{model.path}: link {link!r} is {max(whole.extents):.4g} m large; URDF lengths are metres, "
            'meshes in millimetres need scale="0.001 0.001 0.001"'
        )
    return Body(link, ConvexParts.from_hulls(hulls), whole)


def _shape(
    collision: Collision, where: str, urdf: Path, packages: Mapping[str, str | Path] | None, meshes: Meshes
) -> tuple[trimesh.Trimesh, list[np.ndarray]]:
    """Surface and the vertices of its convex parts, in the shape's own frame."""
    if collision.kind == "mesh":
        mesh = load_mesh(find_mesh(collision.filename, urdf, packages, where), label=where)
        mesh.vertices = mesh.vertices * collision.size
        if math.prod(collision.size) < 0:  # a mirror turns the surface inside out
            mesh.invert()
        if max(mesh.extents) > LARGEST:
            raise DataError(
                f'{where}: the mesh is {max(mesh.extents):.4g} m large; for millimetres add scale="0.001 0.001 0.001"'
            )
        make = Body.from_mesh if meshes == "decompose" else Body.from_hull
        body = make(mesh, label=where)
        return mesh, [p.vertices for p in body.parts.to_trimesh()]
    if collision.kind == "box":
        mesh = trimesh.creation.box(extents=collision.size)
    elif collision.kind == "cylinder":
        radius, length = collision.size
        mesh = trimesh.creation.cylinder(radius=radius / math.cos(math.pi / SIDES), height=length, sections=SIDES)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
        nearest = np.einsum("fi,fi->f", mesh.face_normals, mesh.triangles[:, 0]).min()
        mesh.apply_scale(collision.size[0] / nearest)
    return mesh, [np.asarray(mesh.vertices)]


def find_mesh(filename: str, urdf: Path, packages: Mapping[str, str | Path] | None = None, where: str = "") -> Path:
    """The file that a mesh's ``filename`` names.

    A relative path starts at the URDF's folder. ``package://name/rest`` is looked for where ``packages`` says that the
    package is, else in a folder ``name`` beside or around the URDF, else beside or around the URDF itself.

    Raises:
        DataError: there is no such file; the message lists where it was looked for. Or it lies on the web.
    """
    prefix = f"{where}: " if where else ""
    folder = urdf.resolve().parent
    if filename.startswith("package://"):
        package, _, rest = filename.removeprefix("package://").partition("/")
        if packages is not None and package in packages:
            tried = [Path(packages[package]) / rest]
        else:
            around = [folder, *folder.parents][:4]
            tried = [x / rest for x in around if x.name == package]
            tried += [x / package / rest for x in around] + [x / rest for x in around]
    elif filename.startswith("file://"):
        tried = [Path(unquote(urlsplit(filename).path))]
    elif "://" in filename:
        raise DataError(f"{prefix}{filename} is not a local file; download it and name its path")
    else:
        tried = [folder / filename]
    for path in tried:
        with contextlib.suppress(OSError):  # a name that is too long
            if path.is_file():
                return path
    hint = "; packages={'name': folder} tells where a package is" if filename.startswith("package://") else ""
    raise DataError(f"{prefix}no mesh {shown(filename)}, looked for {', '.join(shown(str(p)) for p in tried)}{hint}")
