"""Randomized smoothing of the distance gradient: where, on average, two parts touch when the contact direction wobbles.

The translation part of the distance gradient is always informative; the torque jumps when the witness point moves from
vertex to vertex, and a face that rests on a face gets none that is usable. So the witness point is smoothed, never the
value (paper Sec. 2; Montaut et al. 2023, "Differentiable collision detection: a randomized smoothing approach").

The truth that the fast kinds approximate is E[∇d] over random rotations of the two bodies against each other, by
``noise`` [rad] per axis, about their contact; the kind ``pose`` turns them about the origins of their frames, which
also slides the contact (levers differ by up to 0.03 of the body's radius, of two balls by 0.05).

Measured at a noise of 0.1, error of the lever over the body's radius, ``ring`` and ``gaussian`` with many draws:
edge-edge, vertex-face, ball on slab 0.01; face, rim, edge or ball that rests on something of its size or on its
middle 0.035; lying can 0.055; cube off the middle of a slab five times its size 0.08; half over that slab's border
0.14; corner on corner, whose normal turns too, 0.2; over random contacts 0.05 on average, 0.27 at worst. The hard
gradient is off by 0.5 on faces. ``gumbel`` blurs a length, not an angle: on upright contacts it is as near, on cubes
tilted by 2° to 6° it is off by 0.3 at a temperature of 1 mm.
"""

import functools

import numpy as np
import torch
from torch import Tensor

from physpose_torch.config import Smoothing

__all__ = ["smoothed_points", "smoothing_nodes", "tangent_basis", "vertex_weights"]

NEWTON_STEPS = 30
RING_RADII = 6
RING_SHARE = 1e-3
"""The outer rings, which together weigh less than this, are left out."""
GOLDEN = 0.6180339887498949
CONTACT_BLUR = 1e-5
"""[m]; spread that every contact point has at least, so that two vertices meet half-way."""


def vertex_weights(vertices: Tensor, mask: Tensor, normal: Tensor, smoothing: Smoothing) -> Tensor:
    """How often each vertex is the farthest along a wobbling direction.

    Args:
        vertices: (E, K, 3) vertices, padded by the first one [m].
        mask: (E, K) bool, False on padding.
        normal: (E, 3) unit directions.
        smoothing: ``gumbel``: softmax(s·n / temperature), closed form. ``gaussian``: share of the draws of
            argmax s·(n + noise z), z ~ N(0, I) (DiffCol, first order), in antithetic pairs. ``ring``: the same
            expectation by fixed quadrature on rings around n, free of sampling noise.

    Returns:
        (E, K) weights that sum to one.
    """
    if smoothing.kind == "gumbel":
        height = torch.einsum("eki,ei->ek", vertices, normal)
        return torch.softmax((height / smoothing.temperature).masked_fill(~mask, -torch.inf), dim=1)
    nodes, share = (x.to(normal) for x in smoothing_nodes(smoothing))
    if smoothing.kind != "gaussian":
        nodes = nodes[:, :2] @ tangent_basis(normal)
    directions = normal[:, None] + smoothing.noise * nodes
    farthest = (directions @ vertices.mT).argmax(2)
    farthest = torch.where(mask.gather(1, farthest), farthest, 0)  # padding repeats the first vertex
    return torch.zeros_like(mask, dtype=normal.dtype).scatter_add(1, farthest, share.expand(len(normal), -1))


def smoothed_points(
    vertices_a: Tensor, mask_a: Tensor, vertices_b: Tensor, mask_b: Tensor, normal: Tensor, smoothing: Smoothing
) -> tuple[Tensor, Tensor, Tensor]:
    """Smoothed witness points of two parts that face each other along the normal.

    The contact of two smoothed shapes lies where both think it likely: the points of each alone, the middle of a table
    and the middle of a cup on its rim say, do not face each other, and forces through them would be a torque out of
    nothing. So the two are fused by their spreads in the tangent plane, which is one Newton step of the direction n
    towards the optimum of the smoothed distance; for ``gumbel``, whose smoothed distance is
    d_ε(n) = -ε LSE(V_A n / ε) - ε LSE(-V_B n / ε), Newton is run to convergence and n moves as well.

    Args:
        vertices_a, vertices_b: (E, K, 3) padded vertices in one frame [m]; mask_a, mask_b: (E, K).
        normal: (E, 3) unit vectors from a to b in that frame.
        smoothing: see :func:`vertex_weights`.

    Returns:
        normal (E, 3), point on a (E, 3), point on b (E, 3), in that frame [m].
    """
    basis = tangent_basis(normal)
    for step in range(NEWTON_STEPS if smoothing.kind == "gumbel" else 1):
        mean_a, cov_a = _moments(vertices_a, vertex_weights(vertices_a, mask_a, normal, smoothing))
        mean_b, cov_b = _moments(vertices_b, vertex_weights(vertices_b, mask_b, -normal, smoothing))
        apart = torch.einsum("eti,ei->et", basis, mean_b - mean_a)
        spread_a, spread_b = basis @ cov_a @ basis.mT, basis @ cov_b @ basis.mT
        blur = CONTACT_BLUR**2 * torch.eye(2, dtype=normal.dtype, device=normal.device)
        if smoothing.kind != "gumbel":
            total = torch.linalg.solve(spread_a + spread_b + 2 * blur, apart)
            lever = torch.einsum("eti,etu,eu->ei", basis, spread_a + blur, total)
            lever_b = torch.einsum("eti,etu,eu->ei", basis, spread_b + blur, total)
            return normal, mean_a + lever, mean_b - lever_b
        if step == NEWTON_STEPS - 1 or bool((apart.abs().amax(1) < 1e-12).all()):
            break
        # Riemannian Newton on the sphere: -Hess d_ε = (C_a + C_b) / ε + (n · ∇d_ε) I, kept positive
        distance = torch.einsum("ei,ei->e", normal, mean_b - mean_a)
        eigenvalue, eigenvector = torch.linalg.eigh((spread_a + spread_b) / smoothing.temperature)
        eigenvalue = (eigenvalue + distance[:, None]).clamp_min(1e-2 * smoothing.temperature)
        move = torch.einsum("etu,eu,evu,ev->et", eigenvector, 1.0 / eigenvalue, eigenvector, apart)
        size = torch.linalg.vector_norm(move, dim=-1, keepdim=True)
        move = move * (0.1 / size.clamp_min(0.1))
        normal = torch.nn.functional.normalize(normal + torch.einsum("eti,et->ei", basis, move), dim=-1)
        basis = tangent_basis(normal)
    return normal, mean_a, mean_b


def tangent_basis(normal: Tensor) -> Tensor:
    """(E, 2, 3) orthonormal vectors across unit normals (E, 3) (Duff et al. 2017)."""
    x, y, z = normal.unbind(-1)
    # the basis jumps somewhere: not at z = 0, where the faces of upright boxes are and rounding would decide
    sign = torch.where(z < -0.3, -torch.ones_like(z), torch.ones_like(z))
    a = -1.0 / (sign + z)
    b = x * y * a
    u = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    v = torch.stack([b, sign + y * y * a, -y], dim=-1)
    return torch.stack([u, v], dim=-2)


def smoothing_nodes(smoothing: Smoothing) -> tuple[Tensor, Tensor]:
    """Nodes (M, 3) and weights (M,): draws in space for ``gaussian``, else rings across the normal, third entries 0."""
    if smoothing.kind != "gaussian":
        return _rings(smoothing.samples)
    generator = torch.Generator().manual_seed(smoothing.seed)
    half = torch.randn((smoothing.samples + 1) // 2, 3, generator=generator, dtype=torch.float64)
    return torch.cat([half, -half]), torch.full((2 * len(half),), 0.5 / len(half), dtype=torch.float64)


@functools.cache
def _rings(samples: int) -> tuple[Tensor, Tensor]:
    """Nodes (M, 3), third entries 0, and weights (M,) of a standard normal in the plane.

    Trapezoid rule round the angle, and Gauss-Laguerre for ½|z|², which is exponentially distributed. The rings are
    turned against each other, so that the straight borders between vertices do not meet the nodes of all rings at once.
    """
    half_square, weight = np.polynomial.laguerre.laggauss(RING_RADII)
    kept = np.flip(np.cumsum(np.flip(weight))) > RING_SHARE
    half_square, weight = half_square[kept], weight[kept] / weight[kept].sum()
    angle = 2 * np.pi * (np.arange(samples) + 0.5 + GOLDEN * np.arange(len(weight))[:, None]) / samples
    radius = np.sqrt(2 * half_square)[:, None]
    nodes = np.stack([(radius * f(angle)).ravel() for f in (np.cos, np.sin, np.zeros_like)], axis=1)
    return torch.from_numpy(nodes), torch.from_numpy(np.repeat(weight / samples, samples))


def _moments(vertices: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    mean = torch.einsum("ek,eki->ei", weights, vertices)
    centred = vertices - mean[:, None]
    return mean, (weights[:, :, None] * centred).mT @ centred
