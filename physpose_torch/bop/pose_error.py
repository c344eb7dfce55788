"""Pose errors by the model's points: MSSD in space and MSPD in the image, exact and fast over many symmetries.

Source: Hodaň et al., BOP Challenge 2020 on 6D Object Localization, section 2.2; BOP toolkit, `pose_error.py`.
"""

import torch

from physpose_torch.errors import InvalidInputError

__all__ = ["mspd", "mssd", "over_symmetries"]

_CHUNK = 30_000  # points in work at once: stays in the cache, and too few for torch to wake up other threads


def mssd(T_est: torch.Tensor, T_gt: torch.Tensor, vertices: torch.Tensor, symmetries: torch.Tensor) -> torch.Tensor:
    """Maximum symmetry-aware surface distance: min over symmetries S of max over x of ‖T_est x − T_gt S x‖.

    Exact to 32 eps of how far the poses are apart plus the points' extent, however far both are from the camera (with
    symmetries that shift, plus eps of that).

    Args:
        T_est: T_camera_object, shape (..., 4, 4) [m].
        T_gt: T_camera_object, shape (..., 4, 4) [m].
        vertices: Model points x, object frame, shape (V, 3) [m]. The distance is convex in x, so the vertices of the
            convex hull are enough.
        symmetries: S, shape (S, 4, 4) [m].

    Returns:
        Shape (...) [m].
    """
    return over_symmetries(T_est, T_gt, None, vertices, symmetries)[0]


def mspd(
    T_est: torch.Tensor, T_gt: torch.Tensor, K: torch.Tensor, vertices: torch.Tensor, symmetries: torch.Tensor
) -> torch.Tensor:
    """Maximum symmetry-aware projection distance: min over S of max over x of ‖proj(T_est x) − proj(T_gt S x)‖.

    Unlike for `mssd`, points inside the convex hull matter: the distance is not convex in x.

    Args:
        T_est: T_camera_object, shape (..., 4, 4) [m].
        T_gt: T_camera_object, shape (..., 4, 4) [m].
        K: Cameras, shape (..., 3, 3) [px].
        vertices: Model points x, object frame, shape (V, 3) [m].
        symmetries: S, shape (S, 4, 4) [m].

    Returns:
        Shape (...) [px]; infinite where a point lies in the plane of the camera's centre.
    """
    return over_symmetries(T_est, T_gt, K, vertices, symmetries)[0]


def over_symmetries(
    T_est: torch.Tensor, T_gt: torch.Tensor, K: torch.Tensor | None, vertices: torch.Tensor, symmetries: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Least over symmetries of the greatest distance over vertices, in space or (with K) in the image, and its symmetry.

    Exact, but with hundreds of symmetries not by brute force: a few outlying vertices bound the maximum from below,
    and a symmetry is worked out in full only while its bound is lower than the least maximum found.
    """
    given = {"T_est": T_est.shape[-2:], "T_gt": T_gt.shape[-2:], "symmetries": symmetries.shape[1:]}
    if any(tuple(size) != (4, 4) for size in given.values()) or vertices.shape[1:] != (3,) or not len(vertices):
        sizes = ", ".join(f"{name} {tuple(size)}" for name, size in given.items())
        raise InvalidInputError(f"got {sizes}, vertices {tuple(vertices.shape)}; expected 4×4 transforms and (V, 3)")
    T_est, T_gt = torch.broadcast_tensors(T_est, T_gt)  # torch.broadcast_shapes would import sympy: 0.8 s
    shape = T_est.shape[:-2]
    T_est, T_gt = T_est.reshape(-1, 4, 4), T_gt.reshape(-1, 4, 4)
    if K is not None:
        K = K.expand(*shape, 3, 3).reshape(-1, 3, 3)
    count, index = len(T_est), torch.zeros(len(T_est), dtype=torch.long, device=T_est.device)
    everyone = torch.arange(count, device=T_est.device)
    if len(symmetries) == 1:
        return _farthest(T_est, T_gt @ symmetries[0], K, vertices).reshape(shape), index.reshape(shape)
    bound = torch.empty(count, len(symmetries), dtype=T_est.dtype, device=T_est.device)
    probe = vertices[_outlying(vertices)]
    for part in everyone.split(max(1, 100_000 // len(symmetries))):
        pair = part.repeat_interleave(len(symmetries))
        T_sym = (T_gt[part, None] @ symmetries).flatten(0, 1)
        far = _farthest(T_est[pair], T_sym, None if K is None else K[pair], probe)
        bound[part] = far.reshape(len(part), len(symmetries))
    best = torch.full_like(bound[:, 0], torch.inf)
    active = everyone
    while len(active):
        lower, candidate = bound[active].min(1)
        promising = lower < best[active]
        active, candidate = active[promising], candidate[promising]
        far = _farthest(T_est[active], T_gt[active] @ symmetries[candidate], None if K is None else K[active], vertices)
        bound[active, candidate] = torch.inf
        better = far < best[active]
        best[active[better]], index[active[better]] = far[better], candidate[better]
    return best.reshape(shape), index.reshape(shape)


def _farthest(T_a: torch.Tensor, T_b: torch.Tensor, K: torch.Tensor | None, points: torch.Tensor) -> torch.Tensor:
    """Greatest distance between a point under T_a and under T_b, in space or (with K) in the image, shape (P,)."""
    out = torch.empty(len(T_a), dtype=T_a.dtype, device=T_a.device)
    axes = points.mT.contiguous()
    for part in torch.arange(len(T_a), device=T_a.device).split(max(1, _CHUNK // len(points))):
        if K is None:
            shift = _transformed((T_a[part] - T_b[part])[:, :3], axes)
        else:
            pixels = []
            for T in (T_a[part], T_b[part]):
                x, y, z = _transformed(K[part] @ T[:, :3], axes)
                pixels.append((x / z, y / z))
            shift = [a - b for a, b in zip(*pixels, strict=True)]
        out[part] = sum(s.square() for s in shift).amax(1).sqrt()
    return torch.nan_to_num(out, nan=torch.inf, posinf=torch.inf)


def _transformed(P: torch.Tensor, axes: torch.Tensor) -> list[torch.Tensor]:
    """The three coordinates, (B, V) each, of points `axes` (3, V) under P (B, 3, 4)."""
    # No matmul: its threads wait for each other, eight times longer than the work takes where the machine is busy.
    rows = []
    for k in range(3):
        row = torch.addcmul(P[:, k, 3:], P[:, k, :1], axes[0])
        rows.append(row.addcmul_(P[:, k, 1:2], axes[1]).addcmul_(P[:, k, 2:3], axes[2]))
    return rows


def _outlying(points: torch.Tensor, *, count: int = 128) -> torch.Tensor:
    """Indices of the points that are farthest in evenly spread directions."""
    k = torch.arange(count, dtype=points.dtype, device=points.device) + 0.5
    z, angle = 1 - 2 * k / count, k * (torch.pi * (1 + 5**0.5))
    radius = (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)
    return (directions @ points.mT).argmax(1).unique()
