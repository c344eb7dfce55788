"""Slow exact signed distance of two convex polytopes: brute force over all features, the reference of every backend.

Penetrating: the separating-axis theorem says d = max over the facet normals of the Minkowski difference, and these are
the faces of A, the faces of B, and the cross products of their edges. Apart: the least of all vertex-triangle and
edge-edge distances.
"""

import numpy as np


def _support_gap(normals, A, B):
    return (B @ normals.T).min(0) - (A @ normals.T).max(0)


def _unique_directions(D):
    length = np.linalg.norm(D, axis=1)
    return D[length > 1e-14] / length[length > 1e-14, None]


def _edges(V, F):
    pairs = np.unique(np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1), axis=0)
    return V[pairs[:, 0]], V[pairs[:, 1]]


def _face_normals(V, F):
    return _unique_directions(np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]))


def _point_triangle(P, V, F):
    """Least distance of points to triangles, all against all, with the two witness points."""
    a, b, c = (V[F[:, i]][None] for i in range(3))
    p = P[:, None]
    n = np.cross(b - a, c - a)
    area = np.linalg.norm(n, axis=-1)
    n = n / np.maximum(area, 1e-300)[..., None]
    height = ((p - a) * n).sum(-1, keepdims=True)
    q = p - height * n
    inside = np.broadcast_to(area > 1e-300, q.shape[:2]).copy()  # one without area is left to its edges
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(v - u, q - u) * n).sum(-1) >= 0
    best = np.where(inside, np.abs(height[..., 0]), np.inf)
    k = np.unravel_index(best.argmin(), best.shape)
    return best[k], P[k[0]], q[k]


def _segment_segment(P0, P1, Q0, Q1):
    """Least distance of segments, all against all: interior optimum clamped, and all four end points."""
    d1, d2 = (P1 - P0)[:, None], (Q1 - Q0)[None]
    r = P0[:, None] - Q0[None]
    a, e, b = (d1 * d1).sum(-1), (d2 * d2).sum(-1), (d1 * d2).sum(-1)
    c, f = (d1 * r).sum(-1), (d2 * r).sum(-1)
    det = a * e - b * b
    s = np.clip(np.where(det > 1e-12 * a * e, (b * f - c * e) / np.where(det == 0, 1, det), 0.0), 0, 1)
    best = (np.inf, None, None)
    zero, one = np.zeros_like(s), np.ones_like(s)
    for s_ in (s, zero, one):
        t = np.clip((b * s_ + f) / np.maximum(e, 1e-300), 0, 1)  # edges may have no length
        s2 = np.clip((b * t - c) / np.maximum(a, 1e-300), 0, 1)
        for ss, tt in ((s2, t), (s_, t)):
            x, y = P0[:, None] + ss[..., None] * d1, Q0[None] + tt[..., None] * d2
            gap = np.linalg.norm(x - y, axis=-1)
            k = np.unravel_index(gap.argmin(), gap.shape)
            if gap[k] < best[0]:
                best = (gap[k], x[k], y[k])
    return best


def oracle_distance(VA, FA, VB, FB):
    """Exact signed distance and unit normal from A to B of two polytopes in one frame."""
    (A0, A1), (B0, B1) = _edges(VA, FA), _edges(VB, FB)
    cross = _unique_directions(np.cross((A1 - A0)[:, None], (B1 - B0)[None]).reshape(-1, 3))
    normals = np.concatenate([_face_normals(VA, FA), -_face_normals(VB, FB), cross, -cross])
    gap = _support_gap(normals, VA, VB)
    best = gap.argmax()
    if gap[best] <= 0:
        return gap[best], normals[best]
    d1, a1, b1 = _point_triangle(VA, VB, FB)
    d2, b2, a2 = _point_triangle(VB, VA, FA)
    candidates = [(d1, a1, b1), (d2, a2, b2), _segment_segment(A0, A1, B0, B1)]
    d, a, b = min(candidates, key=lambda x: x[0])
    return d, (b - a) / d if d > 1e-12 else normals[best]


def oracle_drop(VA, FA, VB, FB, gravity, *, limit=10.0):
    """How far A can move along gravity until it touches B (infinite: it never does), by bisection on the oracle.

    The distance along the line is convex, so the first touching point is where it first reaches zero; the least value
    is found by golden-section search.
    """
    from scipy.optimize import minimize_scalar

    def distance(h):
        return oracle_distance(VA + h * gravity, FA, VB, FB)[0]

    low = minimize_scalar(distance, bounds=(0.0, limit), method="bounded", options={"xatol": 1e-9})
    if distance(0.0) <= 0:
        return 0.0
    if low.fun > 0:
        return np.inf
    lo, hi = 0.0, low.x
    for _ in range(60):
        mid = 0.5 * (lo + hi)
        lo, hi = (mid, hi) if distance(mid) > 0 else (lo, mid)
    return 0.5 * (lo + hi)
