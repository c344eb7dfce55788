"""Convex parts of many bodies, packed into flat tensors that every distance backend reads in place."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
import trimesh
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from physpose_torch.errors import InvalidInputError

__all__ = ["ConvexParts"]


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
        return cls(
            vertices=torch.cat([p.vertices for p in parts]),
            vertex_start=_cat_starts([p.vertex_start for p in parts]),
            faces=torch.cat([p.faces for p in parts]),
            face_start=_cat_starts([p.face_start for p in parts]),
            part_start=_cat_starts([p.part_start for p in parts]),
        )

    def to(self, *args, **kwargs) -> "ConvexParts":
        """The same parts on another device or in another dtype (coordinates only)."""
        vertices = self.vertices.to(*args, **kwargs)
        if vertices is self.vertices:
            return self
        rest = {f.name: getattr(self, f.name).to(vertices.device) for f in fields(self) if f.name != "vertices"}
        return ConvexParts(vertices=vertices, **rest)

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

    @cached_property
    def vertex_count(self) -> Tensor:
        """(P,) long."""
        return self.vertex_start.diff()

    @cached_property
    def padded(self) -> Tensor:
        """(P, K, 3) vertices, the first one repeated up to the largest count K: a maximum needs no mask."""
        if self.n_parts == 0:
            return self.vertices.new_zeros(0, 1, 3)
        k = torch.arange(int(self.vertex_count.max()), device=self.device)
        index = self.vertex_start[:-1, None] + torch.where(k < self.vertex_count[:, None], k, 0)
        return self.vertices[index]

    @cached_property
    def padded_mask(self) -> Tensor:
        """(P, K) bool: which of :attr:`padded` are vertices rather than padding."""
        return torch.arange(self.padded.shape[1], device=self.device) < self.vertex_count[:, None]

    @cached_property
    def lower(self) -> Tensor:
        """(P, 3) least coordinates."""
        return self.padded.amin(1) if self.n_parts else self.vertices.new_zeros(0, 3)

    @cached_property
    def upper(self) -> Tensor:
        """(P, 3) greatest coordinates."""
        return self.padded.amax(1) if self.n_parts else self.vertices.new_zeros(0, 3)

    @cached_property
    def center(self) -> Tensor:
        """(P, 3) centres of the bounds."""
        return 0.5 * (self.lower + self.upper)

    @cached_property
    def radius(self) -> Tensor:
        """(P,) radii of bounding spheres around :attr:`center`."""
        return torch.linalg.vector_norm(self.padded - self.center[:, None], dim=-1).amax(1)

    @cached_property
    def _edge_table(self) -> tuple[Tensor, Tensor, Tensor]:
        normals, ends, sides = [], [], []
        for p in range(self.n_parts):
            vertices, faces = (x.cpu().numpy() for x in self.part(p))
            n, e, s = _edges(vertices, faces)
            normals.append(n), ends.append(e), sides.append(s)

        def pad(rows: list[np.ndarray]) -> np.ndarray:
            size = max((len(r) for r in rows), default=1)
            return np.stack([np.concatenate([r, np.repeat(r[:1], size - len(r), axis=0)]) for r in rows])

        if not normals:
            empty = self.vertices.new_zeros
            return empty(0, 1, 3), empty(0, 1, 2, 3), empty(0, 1, 2, 3)
        return tuple(torch.as_tensor(pad(x), dtype=self.dtype, device=self.device) for x in (normals, ends, sides))

    @property
    def face_normals(self) -> Tensor:
        """(P, F, 3) outward unit normals of the faces, coplanar triangles merged, padded by repetition."""
        return self._edge_table[0]

    @property
    def edge_ends(self) -> Tensor:
        """(P, L, 2, 3) end points of the edges between different faces, padded by repetition [m]."""
        return self._edge_table[1]

    @property
    def edge_normals(self) -> Tensor:
        """(P, L, 2, 3) outward unit normals of the two faces that meet in each edge: its arc on the Gauss sphere."""
        return self._edge_table[2]

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
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
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


def _edges(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face normals (F, 3), edge ends (L, 2, 3) and the two face normals of each edge (L, 2, 3) of a closed hull."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    side = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(np.sort(ends, axis=1).T)  # the two triangles of an edge become neighbours
    first, second = order[0::2], order[1::2]
    bent = np.einsum("li,li->l", normal[side[first]], normal[side[second]]) < 1.0 - 1e-12
    sides = np.stack([normal[side[first]], normal[side[second]]], axis=1)[bent]
    unique = np.unique(normal.round(9), axis=0, return_index=True)[1]
    return normal[unique], vertices[ends[first]][bent], sides
