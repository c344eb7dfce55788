"""Convex parts of many bodies, packed into flat tensors that every distance backend reads in place."""

import itertools
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.lasting import lasting_property

__all__ = ["ConvexParts", "Facets"]

COPLANAR = 1e-10
"""Triangles whose unit normals differ by less than this are one face; on a body of 1 m that is less than 0.1 nm."""


_sets: "weakref.WeakValueDictionary[int, ConvexParts]" = weakref.WeakValueDictionary()


class Facets(NamedTuple):
    """Faces and edges of all parts, packed one part after another; coplanar triangles are one face."""

    normals: Tensor
    """(G, 3) outward unit normals."""
    offsets: Tensor
    """(G,): face g lies in the plane ``normals[g] · x = offsets[g]`` [m]."""
    start: Tensor
    """(P + 1,) long: part p has the faces ``start[p]:start[p + 1]``."""
    edges: Tensor
    """(L, 4) long: the two vertices of each edge between different faces and the two faces that meet there (its arc on the
    Gauss sphere), numbered within the part."""
    edge_start: Tensor
    """(P + 1,) long."""


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """Convex hulls of B bodies, P parts in all, packed one after another; coordinates in the body frames [m].

    Part ``p`` has the vertices ``vertices[vertex_start[p]:vertex_start[p + 1]]`` and the triangles
    ``faces[face_start[p]:face_start[p + 1]]`` (indices into its own vertices, counter-clockwise from outside);
    body ``b`` has the parts ``part_start[b]:part_start[b + 1]``.
    """

    vertices: Tensor
    """(V, 3) [m]."""
    vertex_start: Tensor
    """(P + 1,) long."""
    faces: Tensor
    """(F, 3) long."""
    face_start: Tensor
    """(P + 1,) long."""
    part_start: Tensor
    """(B + 1,) long."""
    handle: int = field(init=False, repr=False, default_factory=itertools.count().__next__)
    """Number of this set in this process; operators, which take no objects, find it by :meth:`by_handle`."""

    def __post_init__(self) -> None:
        _sets[self.handle] = self

    def __reduce__(self) -> tuple:
        """A copy is another set, with a number of its own, in another process, too."""
        return ConvexParts, tuple(getattr(self, f.name) for f in fields(self) if f.init)

    @staticmethod
    def by_handle(handle: int) -> "ConvexParts":
        """The living set with this :attr:`handle`."""
        return _sets[handle]

    @classmethod
    def from_hulls(cls, hulls: Sequence[np.ndarray], *, dtype: torch.dtype = torch.float64) -> "ConvexParts":
        """Parts of one body from the vertex sets (V_k, 3) [m] of its convex hulls; interior points are dropped.

        Raises:
            InvalidInputError: no hull at all, or one that is flat, needle-like, or not finite.
        """
        if len(hulls) == 0:
            raise InvalidInputError("a body needs at least one convex part, got none")
        vertices, faces = zip(*(_hull(np.asarray(h, dtype=np.float64), i) for i, h in enumerate(hulls)), strict=True)
        return cls(
            vertices=torch.as_tensor(np.concatenate(vertices), dtype=dtype),
            vertex_start=_starts([len(v) for v in vertices]),
            faces=torch.as_tensor(np.concatenate(faces), dtype=torch.long),
            face_start=_starts([len(f) for f in faces]),
            part_start=torch.tensor([0, len(vertices)]),
        )

    @classmethod
    def cat(cls, parts: Sequence["ConvexParts"]) -> "ConvexParts":
        """All bodies of several sets, in order. An empty sequence gives an empty set."""
        if len(parts) == 0:
            start, empty = torch.zeros(1, dtype=torch.long), torch.zeros(0, 3, dtype=torch.float64)
            return cls(empty, start, empty.long(), start, start)
        out = cls(
            vertices=torch.cat([p.vertices for p in parts]),
            vertex_start=_cat_starts([p.vertex_start for p in parts]),
            faces=torch.cat([p.faces for p in parts]),
            face_start=_cat_starts([p.face_start for p in parts]),
            part_start=_cat_starts([p.part_start for p in parts]),
        )
        if all(p.dtype == out.dtype and p.device == out.device for p in parts):
            object.__setattr__(out, "_members", tuple(parts))  # what they have worked out already is not done again
        return out

    def to(self, *args, **kwargs) -> "ConvexParts":
        """The same parts on another device or in another dtype (coordinates only)."""
        vertices = self.vertices.to(*args, **kwargs)
        if vertices is self.vertices:
            return self
        rest = {
            f.name: getattr(self, f.name).to(vertices.device) for f in fields(self) if f.init and f.name != "vertices"
        }
        return ConvexParts(vertices=vertices, **rest)

    @lasting_property
    def reference(self) -> "ConvexParts":
        """The same parts in float64 on the CPU, converted once: what exact distances are computed with."""
        return self.to(device="cpu", dtype=torch.float64)

    @property
    def n_parts(self) -> int:
        return len(self.vertex_start) - 1

    @property
    def n_bodies(self) -> int:
        return len(self.part_start) - 1

    @property
    def dtype(self) -> torch.dtype:
        return self.vertices.dtype

    @property
    def device(self) -> torch.device:
        return self.vertices.device

    @lasting_property
    def vertex_count(self) -> Tensor:
        """(P,) long."""
        return self.vertex_start.diff()

    @lasting_property
    def padded(self) -> Tensor:
        """(P, K, 3) vertices, the first one repeated up to the largest count K: a maximum needs no mask."""
        if self.n_parts == 0:
            return self.vertices.new_zeros(0, 1, 3)
        return self.vertices[_padding(self.vertex_start)[0]]

    @lasting_property
    def padded_mask(self) -> Tensor:
        """(P, K) bool: which of :attr:`padded` are vertices rather than padding."""
        return torch.arange(self.padded.shape[1], device=self.device) < self.vertex_count[:, None]

    @lasting_property
    def lower(self) -> Tensor:
        """(P, 3) least coordinates."""
        return self.padded.amin(1) if self.n_parts else self.vertices.new_zeros(0, 3)

    @lasting_property
    def upper(self) -> Tensor:
        """(P, 3) greatest coordinates."""
        return self.padded.amax(1) if self.n_parts else self.vertices.new_zeros(0, 3)

    @lasting_property
    def center(self) -> Tensor:
        """(P, 3) centres of the bounds."""
        return 0.5 * (self.lower + self.upper)

    @lasting_property
    def radius(self) -> Tensor:
        """(P,) radii of bounding spheres around :attr:`center`."""
        return torch.linalg.vector_norm(self.padded - self.center[:, None], dim=-1).amax(1)

    @lasting_property
    def facets(self) -> Facets:
        """Faces and edges of all parts."""
        members = self.__dict__.get("_members", ())
        if members:
            columns = list(zip(*(p.facets for p in members), strict=True))
            starts = (_cat_starts(columns[i]) for i in (2, 4))
            normals, offsets, edges = (torch.cat(columns[i]) for i in (0, 1, 3))
            start, edge_start = starts
            return Facets(normals, offsets, start, edges, edge_start)
        rows = [_faces_and_edges(*(x.cpu().numpy() for x in self.part(p))) for p in range(self.n_parts)]
        normals, edges = (
            (np.concatenate(column) for column in zip(*rows, strict=True))
            if rows
            else (np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))
        )
        start, edge_start = (_starts([len(row[i]) for row in rows]).to(self.device) for i in range(2))
        normals, edges = torch.as_tensor(normals).to(self.vertices), torch.as_tensor(edges).to(self.device)
        part = torch.repeat_interleave(torch.arange(self.n_parts, device=self.device), start.diff())
        offsets = (self.padded[part] @ normals[:, :, None])[:, :, 0].amax(1) if len(normals) else normals[:, 0]
        return Facets(normals, offsets, start, edges, edge_start)

    @lasting_property
    def _padded_facets(self) -> tuple[Tensor, Tensor, Tensor]:
        f = self.facets
        face, _ = _padding(f.start)
        edge, is_edge = _padding(f.edge_start)
        if self.n_parts == 0:
            empty = self.vertices.new_zeros(0, 1)
            return empty[:, :, None].expand(0, 1, 3), empty, empty[:, :, None].expand(0, 1, 4).long()
        edges = (
            torch.where(is_edge[:, :, None], f.edges[edge], 0) if len(f.edges) else f.edges.new_zeros(*edge.shape, 4)
        )
        return f.normals[face], f.offsets[face], edges

    @property
    def face_normals(self) -> Tensor:
        """(P, F, 3) outward unit normals of the faces, coplanar triangles merged, padded by repetition."""
        return self._padded_facets[0]

    @property
    def face_offsets(self) -> Tensor:
        """(P, F): face f lies in the plane ``face_normals[p, f] · x = face_offsets[p, f]`` [m]."""
        return self._padded_facets[1]

    @property
    def edge_vertices(self) -> Tensor:
        """(P, L, 2) long: the two vertices of each edge between different faces, padded by zeros."""
        return self._padded_facets[2][:, :, :2]

    @property
    def edge_faces(self) -> Tensor:
        """(P, L, 2) long: the two faces that meet in each edge (its arc on the Gauss sphere), padded by zeros."""
        return self._padded_facets[2][:, :, 2:]

    def part(self, p: int) -> tuple[Tensor, Tensor]:
        """Vertices (V_p, 3) and triangles (F_p, 3) of one part."""
        return (
            self.vertices[int(self.vertex_start[p]) : int(self.vertex_start[p + 1])],
            self.faces[int(self.face_start[p]) : int(self.face_start[p + 1])],
        )

    def to_trimesh(self) -> list[trimesh.Trimesh]:
        """One mesh a part, in the body frame [m]."""
        parts = (self.part(p) for p in range(self.n_parts))
        return [trimesh.Trimesh(v.cpu().numpy(), f.cpu().numpy(), process=False) for v, f in parts]


def _hull(points: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in convex position and outward triangles of the hull of points (V, 3)."""
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise InvalidInputError(f"convex part {index}: expected finite vertices of shape (V, 3), got {points.shape}")
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise InvalidInputError(
            f"convex part {index} has no volume ({len(points)} points, extents {np.ptp(points, axis=0).tolist()} m); "
            "give it a thickness"
        ) from error
    renumber = np.full(len(points), -1)
    renumber[hull.vertices] = np.arange(len(hull.vertices))
    faces, vertices = renumber[hull.simplices], points[hull.vertices]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces


def _starts(counts: Sequence[int]) -> Tensor:
    return torch.tensor([0, *np.cumsum(counts)], dtype=torch.long)


def _cat_starts(starts: Sequence[Tensor]) -> Tensor:
    counts = torch.cat([s.diff() for s in starts])
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def _padding(start: Tensor) -> tuple[Tensor, Tensor]:
    """Indices (P, K) of packed rows, each part's first one repeated up to the largest count K ≥ 1, and which are real."""
    count = start.diff()
    k = torch.arange(max(int(count.max()), 1) if len(count) else 1, device=start.device)
    real = k < count[:, None]
    return start[:-1, None] + torch.where(real, k, 0), real


def _faces_and_edges(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face normals (F, 3), and of each edge (L, 4) its vertices and its two faces; coplanar triangles are one face."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    normal[area == 0] = 0.0, 0.0, 1.0  # no triangle at all; any direction will do
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ends = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    order = np.lexsort(ends.T)  # the two triangles of an edge become neighbours
    ends, sides = ends[order[::2]], (order % len(triangles)).reshape(-1, 2)
    bend = np.linalg.norm(normal[sides[:, 0]] - normal[sides[:, 1]], axis=1)
    flat = sides[bend < COPLANAR]
    joined = coo_matrix((np.ones(len(flat)), (flat[:, 0], flat[:, 1])), shape=(len(triangles),) * 2)
    n_faces, face = connected_components(joined, directed=False)
    # the largest triangle of a face knows its normal best: slivers lose digits
    largest = np.zeros(n_faces, dtype=int)
    by_area = np.argsort(area, kind="stable")
    largest[face[by_area]] = by_area
    edge = face[sides[:, 0]] != face[sides[:, 1]]
    return normal[largest], np.concatenate([ends[edge], face[sides[edge]]], axis=1)
