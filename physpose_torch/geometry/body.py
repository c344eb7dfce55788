"""What a scene is made of: rigid bodies with convex parts, and planes."""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor
from trimesh.resolvers import FilePathResolver

from physpose_torch import se3
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.geometry.decompose import DecomposeOptions, DecomposeReport, decompose
from physpose_torch.lasting import lasting_property
from physpose_torch.reading import inside

__all__ = ["FARTHEST", "Body", "Plane", "is_flat", "load_mesh", "read_mesh"]

CYLINDER_SIDES = 32
LARGEST = 10.0
"""[m]; a mesh larger than this is in other units, unless its scale is given."""
HOUSEHOLD = 0.25
"""[m]; what is larger than ``LARGEST`` is cut into parts as finely as an object of this size."""
FARTHEST = 1e6
"""[m]; no mesh has vertices beyond this."""
ARCHIVES = (".zip", ".gz", ".bz2", ".zae", ".3mf", ".3dxml")
LARGEST_FILE = 2_000_000_000
"""[bytes]; of a mesh file."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body: its surface mesh and its convex parts, both in the body frame [m]."""

    label: str
    """Name of the object; error messages and reports use it."""
    parts: ConvexParts
    """Convex parts of this one body."""
    mesh: trimesh.Trimesh
    """Surface mesh, for pictures, metrics and reports."""
    symmetries: Tensor | None = None
    """(S, 4, 4) transforms of the body frame that leave the body as it is, identity included; None: no symmetry."""
    decomposition: DecomposeReport | None = None
    """How well the parts cover the mesh; None where the shape is exact."""
    appearance: trimesh.Trimesh | None = None
    """The surface mesh with its colours (texture, vertices or faces), body frame [m]; None: no colours are known."""

    @classmethod
    def from_mesh(
        cls,
        mesh: trimesh.Trimesh | str | Path,
        *,
        label: str,
        scale: float | None = None,
        symmetries: Tensor | None = None,
        cache: bool = True,
        **coacd_options,
    ) -> "Body":
        """Decompose a mesh into convex parts (cached on disk by content and options).

        Args:
            mesh: a trimesh, or the path of any file that trimesh reads. Need not be watertight.
            label: name of the object.
            scale: factor to metres: 0.001 for the millimetre meshes of BOP. None: the mesh is in metres, and is refused if it
                is larger than 10 m, as one in millimetres would be; with ``scale=1.0`` it is believed to be that large.
                What is larger than 10 m is cut to 0.4 % of its size, unless ``tolerance`` is given.
            symmetries: (S, 4, 4) symmetry transforms [m] with the identity, if any.
            cache: keep the decomposition in the user's cache folder (``PHYSPOSE_CACHE`` moves it).
            **coacd_options: fields of :class:`~physpose_torch.geometry.decompose.DecomposeOptions`.

        Raises:
            DataError: the file is missing or cannot be read, or the mesh has no faces, NaN, or no volume.
            InvalidInputError: it is smaller than 1 mm, or larger than 10 m without a scale; an option is unknown.
        """
        raw = read_mesh(mesh, label)
        believed, scale = scale is not None, 1.0 if scale is None else scale
        mesh = load_mesh(raw, label=label, scale=scale)
        try:
            options = DecomposeOptions(**coacd_options)
        except TypeError as error:
            known = ", ".join(DecomposeOptions.__dataclass_fields__)
            raise InvalidInputError(f"{label}: {error}; decomposition options are {known}") from error
        size = float(max(mesh.extents)) if len(mesh.faces) else 0.0
        if believed and size > LARGEST:
            hulls, report = _decompose_large(mesh, size, options, "tolerance" in coacd_options, cache=cache, name=label)
        else:
            hulls, report = decompose(mesh, options, cache=cache, name=label)
        symmetries, appearance = _checked_symmetries(symmetries, label), _appearance(raw, scale)
        return cls(label, ConvexParts.from_hulls(hulls), mesh, symmetries, report, appearance)

    @classmethod
    def from_hull(
        cls, mesh: trimesh.Trimesh | str | Path, *, label: str, scale: float = 1.0, symmetries: Tensor | None = None
    ) -> "Body":
        """The same with its convex hull as the only part: no decomposition to wait for. What asks for nothing but the surface
        and what the body can stand on, as the table estimator, needs no more.

        Raises:
            DataError: the file is missing or cannot be read, or the mesh has no faces, NaN, or no volume.
        """
        raw = read_mesh(mesh, label)
        mesh = load_mesh(raw, label=label, scale=scale)
        if is_flat(mesh):
            raise DataError(f"{label}: the mesh is flat; a body needs a volume")
        parts = ConvexParts.from_hulls([np.asarray(mesh.convex_hull.vertices)])
        return cls(label, parts, mesh, _checked_symmetries(symmetries, label), None, _appearance(raw, scale))

    @classmethod
    def box(cls, extents, *, label: str) -> "Body":
        """A box centred at the origin with the full side lengths ``extents`` (3,) [m]."""
        size = torch.as_tensor(extents, dtype=torch.float64)
        if size.shape != (3,) or not bool((size > 0).all()) or not bool(size.isfinite().all()):
            raise InvalidInputError(f"{label}: extents = {extents}, expected three positive lengths [m]")
        mesh = trimesh.creation.box(extents=size.numpy())
        return cls(label, ConvexParts.from_hulls([mesh.vertices]), mesh)

    @classmethod
    def cylinder(cls, radius: float, height: float, *, label: str) -> "Body":
        """A cylinder along z, centred at the origin; one part, a prism of 32 sides with the same radius [m]."""
        if not (np.isfinite([radius, height]).all() and radius > 0 and height > 0):
            raise InvalidInputError(f"{label}: radius = {radius}, height = {height}, expected positive lengths [m]")
        mesh = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=CYLINDER_SIDES)  # trimesh drops small triangles
        mesh.vertices = mesh.vertices * [radius, radius, height]
        rim = mesh.vertices[np.linalg.norm(mesh.vertices[:, :2], axis=1) > 0.5 * radius]
        return cls(label, ConvexParts.from_hulls([rim]), mesh)

    @lasting_property
    def lower(self) -> Tensor:
        """(3,) least coordinates of the mesh [m]."""
        return torch.tensor(self.mesh.bounds[0], dtype=torch.float64)

    @lasting_property
    def upper(self) -> Tensor:
        """(3,) greatest coordinates of the mesh [m]."""
        return torch.tensor(self.mesh.bounds[1], dtype=torch.float64)

    @lasting_property
    def center(self) -> Tensor:
        """(3,) centre of the bounds; viewing rays go there [m]."""
        return 0.5 * (self.lower + self.upper)

    @lasting_property
    def radius(self) -> float:
        """Largest distance of a surface point from :attr:`center` [m]."""
        return float(np.linalg.norm(self.mesh.vertices - self.center.numpy(), axis=1).max())

    @lasting_property
    def center_of_mass(self) -> Tensor:
        """(3,) centre of mass at uniform density [m].

        Of the volume that the mesh encloses; of the convex parts, which overlap a little, if the mesh has holes.
        """
        if self.mesh.is_volume:  # watertight, consistently wound and not inside out
            return torch.tensor(self.mesh.center_mass, dtype=torch.float64)
        solids = self.parts.to_trimesh()
        volume = [solid.volume for solid in solids]
        return torch.tensor(np.average([solid.center_mass for solid in solids], axis=0, weights=volume))

    def __repr__(self) -> str:
        size = " × ".join(f"{1000 * e:.0f}" for e in self.upper - self.lower)
        return f"Body({self.label!r}, {self.parts.n_parts} parts, {size} mm)"


@dataclass(frozen=True, eq=False)
class Plane:
    """The half-space below ``normal · x = offset`` in the camera frame [m]; the normal points up, out of the table."""

    normal: Tensor
    """(3,) unit vector."""
    offset: Tensor
    """() [m]."""
    covariance: Tensor | None = None
    """(3, 3) of (two tilts [rad], offset [m]) at the point under the objects' centre; None: exact."""

    def __post_init__(self) -> None:
        like = next((x for x in (self.normal, self.offset) if isinstance(x, Tensor) and x.is_floating_point()), None)
        dtype, device = (like.dtype, like.device) if like is not None else (torch.float64, None)
        for name, shape in (("normal", (3,)), ("offset", ()), ("covariance", (3, 3))):
            value = getattr(self, name)
            if value is None and name == "covariance":
                continue
            value = torch.as_tensor(value, dtype=dtype, device=device)
            if value.shape != shape or not bool(value.detach().isfinite().all()):
                raise InvalidInputError(f"Plane {name} = {value.tolist()}, expected finite numbers of shape {shape}")
            object.__setattr__(self, name, value)
        length = float(torch.linalg.vector_norm(self.normal.detach()))
        if abs(length - 1.0) > 1e-3:
            raise InvalidInputError(f"Plane normal has length {length:.4g}, expected a unit vector pointing up")
        if self.covariance is not None and not _is_covariance(self.covariance.detach().double()):
            raise InvalidInputError(f"Plane covariance = {self.covariance.tolist()} is not positive semi-definite")
        object.__setattr__(self, "normal", self.normal / torch.linalg.vector_norm(self.normal))

    @classmethod
    def from_pose(cls, T_camera_table: Tensor) -> "Plane":
        """The plane z = 0 of a table frame whose z axis points up."""
        se3.check_rigid(T_camera_table, "T_camera_table")
        normal = T_camera_table[:3, 2]
        return cls(normal, normal @ T_camera_table[:3, 3])


def load_mesh(mesh: trimesh.Trimesh | str | Path, *, label: str, scale: float = 1.0) -> trimesh.Trimesh:
    """A copy of the mesh in metres, with equal vertices merged.

    Raises:
        DataError: the file is missing, cannot be read, or holds no surface.
        InvalidInputError: the scale is not positive.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise InvalidInputError(f"{label}: scale = {scale}, expected a positive factor to metres (0.001 for mm)")
    mesh = read_mesh(mesh, label)
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64) * scale, np.asarray(mesh.faces)
    if not np.isfinite(vertices).all():
        raise DataError(f"{label}: the mesh has NaN or infinite vertices")
    farthest = np.abs(vertices).max()
    if farthest > FARTHEST:
        raise DataError(f"{label}: the mesh has coordinates up to {farthest:.3g} m; it is damaged, or its scale is wrong")
    # only geometry is kept: texture seams would split vertices
    out = trimesh.Trimesh(vertices, faces, process=False)
    out.merge_vertices(merge_tex=True, merge_norm=True)
    return out


def read_mesh(mesh: trimesh.Trimesh | str | Path, label: str) -> trimesh.Trimesh:
    """The mesh as it is in the file, or as it was given. What a file refers to (materials, textures, buffers) is looked for in
    its folder only.

    Raises:
        DataError: the file is missing, an archive, larger than 2 GB or cannot be read, or holds no triangles.
    """
    if isinstance(mesh, str | Path):
        path = Path(mesh)
        if not path.is_file():
            raise DataError(f"{label}: no mesh file {path}")
        if path.suffix.lower() in ARCHIVES:  # a few bytes can become gigabytes
            raise DataError(f"{label}: {path} is an archive; unpack it, and name the mesh in it")
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise DataError(f"{label}: {path} has {size / 1e9:.1f} GB; simplify the mesh, or is it the right file?")
        try:
            mesh = trimesh.load_mesh(path, process=False, resolver=_Beside(str(path)))
        except Exception as error:  # whatever the many file readers raise
            raise DataError(f"{label}: cannot read {path} as a mesh ({type(error).__name__}: {error})") from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh):
        raise InvalidInputError(
            f"{label}: got a {type(mesh).__name__}, expected a trimesh.Trimesh or the path of a mesh"
        )
    if len(mesh.faces) == 0:
        raise DataError(f"{label}: the mesh has no faces; convex parts need a surface")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        shapes = f"vertices {vertices.shape} and faces {faces.shape}"
        raise DataError(f"{label}: the mesh has {shapes}, expected (V, 3) and (F, 3); export it as triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = int(faces.min()) if faces.min() < 0 else int(faces.max())
        raise DataError(f"{label}: a face names vertex {wrong}, but the mesh has {len(vertices)}; the file is damaged")
    return mesh


class _Beside(FilePathResolver):
    """What a mesh file refers to: files in its folder, and no pipes; a path that is not there may be so by its last name."""

    def get(self, name: str) -> bytes:
        for candidate in (name.strip(), Path(name).name):
            with contextlib.suppress(ValueError):
                path = inside(Path(self.parent), candidate)
                if path.is_file():
                    return path.read_bytes()
        raise FileNotFoundError(f"{name} is not in {self.parent}")


def _appearance(mesh: trimesh.Trimesh, scale: float) -> trimesh.Trimesh | None:
    """The mesh with its colours, in metres; None if it has none."""
    visual = mesh.visual
    if visual is None or not visual.defined:
        return None
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if visual.uv is None or image is None or len(visual.uv) != len(mesh.vertices):
            return None
    return trimesh.Trimesh(np.asarray(mesh.vertices) * scale, mesh.faces, visual=visual.copy(), process=False)


def _decompose_large(
    mesh: trimesh.Trimesh, size: float, options: DecomposeOptions, own_tolerance: bool, **keywords
) -> tuple[list[np.ndarray], DecomposeReport]:
    """A mesh of ``size`` [m] decomposed as if it were an object on a table: errors are a share of its size."""
    factor, least = size / HOUSEHOLD, 1e-5 * size / HOUSEHOLD
    if own_tolerance:
        if options.tolerance < least:
            raise InvalidInputError(
                f"{keywords['name']} is {size:.4g} m large: tolerance {options.tolerance} m, expected {least:.2g} or more"
            )
        options = replace(options, tolerance=options.tolerance / factor)
    hulls, report = decompose(mesh.copy().apply_scale(1 / factor), options, **keywords)
    errors = {name: factor * getattr(report, name) for name in ("outward_p95", "outward_max", "inward_p95", "inward_max")}
    return [factor * hull for hull in hulls], report._replace(**errors)


def is_flat(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh has no extent in some direction; trimesh would joggle its points into a hull."""
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(0), compute_uv=False)
    return not spread[-1] > 1e-6 * spread[0]


def _is_covariance(matrix: Tensor) -> bool:
    variance = torch.linalg.eigvalsh(matrix)
    return bool(variance.min() >= -1e-6 * variance.abs().max())


def _checked_symmetries(symmetries: Tensor | None, label: str) -> Tensor | None:
    if symmetries is None:
        return None
    symmetries = torch.as_tensor(symmetries, dtype=torch.float64)
    se3.check_rigid(symmetries, f"{label}: symmetries")
    return symmetries
