"""Signed and drop distances of part pairs, differentiable with respect to both poses, over any backend."""

import importlib.util
from collections.abc import Callable

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.smoothing import smoothed_points
from physpose_torch.distance.support import DistanceResult
from physpose_torch.errors import InvalidInputError, MissingExtraError
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["backends", "chosen_backend", "drop_distance", "signed_distance"]

Backend = Callable[[ConvexParts, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]

CONTACT = 1e-9
"""[m]; a falling part has arrived when it is this near."""
DROP_STEPS = 30
GRAZING = 1e-3
"""Least n·g that the gradient of a drop is divided by."""


def backends() -> list[str]:
    """Names of the distance backends that this installation can run, best first.

    ``warp``: NVIDIA Warp, CPU and CUDA. ``fcl``: python-fcl, CPU. ``fcl-isolated``: the same in a process of its own; should
    it crash or hang, it is started anew, and at worst torch answers: the result is the same to 1e-9 m.
    """
    homes = (("warp", "warp"), ("fcl", "fcl"), ("fcl-isolated", "fcl"))
    return [name for name, module in homes if importlib.util.find_spec(module)]


def signed_distance(
    T_a: Tensor,
    T_b: Tensor,
    parts: ConvexParts,
    pairs: Tensor,
    *,
    backend: str = "auto",
    smoothing: Smoothing | None = None,
) -> DistanceResult:
    """Signed distances of pairs of convex parts.

    The gradient is Danskin's: with witness points a, b (body frames) and the normal n from a to b,
    ∂d/∂T_a = -n ⊗ [a; 1] and ∂d/∂T_b = n ⊗ [b; 1]. With ``smoothing`` the witness points in it are smoothed
    (paper Sec. 2 and appendix).

    Only how the bodies lie to each other is computed with, so how far both are from the camera does not enter. The error of a
    distance is at most 16 eps (that of the poses' dtype) of how far the bodies' origins are apart plus their extents, and
    1e-12 m (Warp), 2e-6 m (Warp in float32) or 1e-10 m (fcl). The poses are taken as they are: in float32 two places that are
    1e9 m away are the same or 64 m apart. Witness points of bodies far from each other are known to √eps of that distance.

    Args:
        T_a, T_b: (E, 4, 4) poses of the bodies that the parts belong to, in one frame [m].
        parts: convex parts of all bodies.
        pairs: (E, 2) long, indices of parts a and b.
        backend: ``auto``, or one of :func:`backends`.
        smoothing: smoothing of the gradient; None for the exact one.

    Raises:
        InvalidInputError: shapes do not match, or the backend is unknown.
        MissingExtraError: no distance backend is installed.
    """
    T_a, T_b, pairs = _checked(T_a, T_b, parts, pairs)
    with torch.autocast(T_a.device.type, enabled=False):  # a micrometre is lost in half precision
        if chosen_backend(backend) == "warp" and _fused(smoothing):
            from physpose_torch.distance.warp import warp_distance

            return warp_distance(T_a, T_b, parts, pairs, smoothing)
        T_a, T_b, origin = _from_a(T_a, T_b)
        distance, normal, point_a, point_b = _SignedDistance.apply(
            T_a, T_b, parts, pairs, _backend(backend), smoothing
        )
        return DistanceResult(distance, normal, point_a + origin, point_b + origin)


def drop_distance(
    T_a: Tensor,
    T_b: Tensor,
    parts: ConvexParts,
    pairs: Tensor,
    gravity: Tensor,
    *,
    limit: float,
    backend: str = "auto",
    smoothing: Smoothing | None = None,
) -> DistanceResult:
    """How far parts a can fall along gravity before they meet parts b.

    Conservative advancement: the distance along the fall is convex, so stepping by d / (n·g) never overshoots. The
    gradient is that of the distance at the meeting point divided by n·g, because h = max over n·g > 0 of the
    gap / (n·g); it is zero where the parts overlap. Errors are those of :func:`signed_distance` over n·g.

    Args:
        T_a, T_b, parts, pairs, backend, smoothing: as in :func:`signed_distance`.
        gravity: (E, 3) unit vectors, pointing down.
        limit: falls longer than this [m] count as never meeting.

    Returns:
        distance: (E,) [m], 0 where they already touch or overlap, infinite where they never meet; normal and witness
        points are those at the meeting point, a's before the fall.
    """
    T_a, T_b, pairs = _checked(T_a, T_b, parts, pairs)
    if gravity.shape != (len(pairs), 3):
        raise InvalidInputError(
            f"gravity has shape {tuple(gravity.shape)}, expected ({len(pairs)}, 3): one for each pair"
        )
    if chosen_backend(backend) == "warp" and _fused(smoothing):
        from physpose_torch.distance.warp import warp_drop

        with torch.autocast(T_a.device.type, enabled=False):
            return warp_drop(T_a, T_b, parts, pairs, gravity, limit, smoothing)
    T_a, T_b, origin = _from_a(T_a, T_b)
    with torch.no_grad():
        run = _backend(backend)
        fall = T_a.new_zeros(len(pairs))
        active = torch.arange(len(pairs), device=T_a.device)
        for _ in range(DROP_STEPS):
            if len(active) == 0:
                break
            T_fallen = _moved(T_a[active], fall[active, None] * gravity[active])
            distance, normal, _, _ = _query(run, T_fallen, T_b[active], parts, pairs[active])
            rate = (normal * gravity[active]).sum(-1)
            falling = distance > CONTACT
            step = torch.where(rate > 0, distance / rate.clamp_min(1e-300), torch.inf)
            fall[active] = fall[active] + torch.where(falling, step, 0.0)
            active = active[falling & (fall[active] <= limit)]
        fall = torch.where(fall <= limit, fall, torch.inf)
        meets = fall.isfinite().nonzero()[:, 0]
    gravity_at, T_a_at = gravity[meets], T_a[meets]
    shifted = _moved(T_a_at, fall[meets, None] * gravity_at)
    at = signed_distance(shifted, T_b[meets], parts, pairs[meets], backend=backend, smoothing=smoothing)
    rate = (at.normal * gravity_at).sum(-1)
    # what is inside already, or slides along, cannot fall any less; the rest is bounded where it only grazes
    lands = (rate > 0) & (at.distance.detach() >= -CONTACT)
    slope = torch.where(lands, 1.0 / rate.clamp_min(GRAZING), 0.0)
    value = fall[meets] + (at.distance - at.distance.detach()) * slope
    out = DistanceResult(fall, torch.zeros_like(gravity), torch.zeros_like(gravity), torch.zeros_like(gravity))
    return DistanceResult(
        out.distance.index_put((meets,), value),
        out.normal.index_put((meets,), at.normal),
        out.point_a.index_put((meets,), at.point_a - fall[meets, None] * gravity_at + origin[meets]),
        out.point_b.index_put((meets,), at.point_b + origin[meets]),
    )


class _SignedDistance(torch.autograd.Function):
    """Distances by a backend; the gradient from normal and (smoothed) witness points."""

    @staticmethod
    def forward(ctx, T_a, T_b, parts, pairs, run, smoothing):
        distance, normal, point_a, point_b = _query(run, T_a, T_b, parts, pairs)
        if smoothing is not None and smoothing.kind == "pose":
            gradient_a, gradient_b = _pose_gradient(run, T_a, T_b, parts, pairs, smoothing)
        else:
            n, a, b = normal, point_a, point_b
            if smoothing is not None:
                n, a, b = _smoothed(T_a, T_b, parts, pairs, normal, smoothing)
            gradient_a, gradient_b = -_outer(n, T_a, a), _outer(n, T_b, b)
        ctx.save_for_backward(gradient_a, gradient_b)
        ctx.mark_non_differentiable(normal, point_a, point_b)
        return distance, normal, point_a, point_b

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_distance, *_):
        gradient_a, gradient_b = ctx.saved_tensors
        weight = grad_distance[:, None, None]
        return weight * gradient_a, weight * gradient_b, None, None, None, None


def chosen_backend(name: str) -> str:
    """The backend that ``auto`` or a name stands for.

    Raises:
        InvalidInputError: the backend is unknown.
        MissingExtraError: no distance backend is installed.
    """
    installed = backends()
    if name == "auto":
        if not installed:
            raise MissingExtraError("no distance backend is installed; pip install warp-lang or python-fcl")
        return installed[0]
    if name not in installed:
        raise InvalidInputError(f"distance backend {name!r} is not available; installed here: {', '.join(installed)}")
    return name


def _fused(smoothing: Smoothing | None) -> bool:
    """Whether the Warp kernel smooths this way itself."""
    return smoothing is None or smoothing.kind in ("ring", "gaussian", "none")


def _backend(name: str) -> Backend:
    name = chosen_backend(name)
    if name == "fcl":
        from physpose_torch.distance.fcl import fcl_distance

        return fcl_distance
    if name == "fcl-isolated":
        from physpose_torch.distance.fcl_isolated import isolated_distance

        return isolated_distance
    from physpose_torch.distance.warp import warp_query

    return warp_query


def _checked(T_a: Tensor, T_b: Tensor, parts: ConvexParts, pairs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Poses in one dtype that distances are computed in, and pairs as long; kernels check nothing."""
    if pairs.ndim != 2 or pairs.shape[1] != 2 or T_a.shape != (len(pairs), 4, 4) or T_b.shape != T_a.shape:
        raise InvalidInputError(
            f"T_a {tuple(T_a.shape)}, T_b {tuple(T_b.shape)}, pairs {tuple(pairs.shape)}: "
            "expected (E, 4, 4), (E, 4, 4) and (E, 2)"
        )
    if pairs.is_floating_point() or pairs.dtype == torch.bool:
        raise InvalidInputError(f"pairs have dtype {pairs.dtype}, expected long: indices of parts")
    # a device is not asked: it would have to be waited for
    if pairs.device.type == "cpu" and not torch.compiler.is_compiling() and len(pairs):
        least, most = int(pairs.min()), int(pairs.max())
        if least < 0 or most >= parts.n_parts:
            raise InvalidInputError(
                f"pairs name part {least if least < 0 else most}, but there are {parts.n_parts} parts"
            )
    dtype = torch.promote_types(torch.promote_types(T_a.dtype, T_b.dtype), torch.float32)
    return T_a.to(dtype), T_b.to(dtype), pairs.long()


def _query(run: Backend, T_a: Tensor, T_b: Tensor, parts: ConvexParts, pairs: Tensor) -> tuple[Tensor, ...]:
    """One backend call, results in the frame of the poses and in their dtype and device."""
    T_a64, T_b64 = T_a.detach().double().cpu(), T_b.detach().double().cpu()
    R_a, R_b = (_orthonormal(T[:, :3, :3]) for T in (T_a64, T_b64))
    R = R_a.mT @ R_b
    t = (R_a.mT @ (T_b64 - T_a64)[:, :3, 3:])[:, :, 0]
    if len(pairs) == 0:
        empty = t.to(T_a)
        return empty[:, 0], empty, empty, empty
    distance, normal, point_a, point_b = run(parts.reference, pairs.cpu(), R, t)
    normal, point_a, point_b = ((R_a @ x[:, :, None])[:, :, 0] for x in (normal, point_a, point_b))
    origin = T_a64[:, :3, 3]
    return distance.to(T_a), normal.to(T_a), (point_a + origin).to(T_a), (point_b + origin).to(T_a)


def _smoothed(T_a, T_b, parts, pairs, normal, smoothing: Smoothing) -> tuple[Tensor, Tensor, Tensor]:
    """Normal and smoothed witness points, found in the frame of body a: a turning camera changes no draw.

    In float64: what thin contacts spread across their length is lost in float32.
    """
    dtype, T_a, T_b, normal = T_a.dtype, T_a.double(), T_b.double(), normal.double()
    T_a_b = se3.inverse(T_a) @ T_b
    vertices_a, vertices_b = (parts.padded.to(T_a)[i] for i in pairs.unbind(1))
    mask_a, mask_b = (parts.padded_mask[i].to(T_a.device) for i in pairs.unbind(1))
    local = (normal[:, None] @ T_a[:, :3, :3])[:, 0]
    n, a, b = smoothed_points(vertices_a, mask_a, se3.apply(T_a_b, vertices_b), mask_b, local, smoothing)
    found = (n[:, None] @ T_a[:, :3, :3].mT)[:, 0], *(se3.apply(T_a, x[:, None])[:, 0] for x in (a, b))
    return tuple(x.to(dtype) for x in found)


def _pose_gradient(run, T_a, T_b, parts, pairs, smoothing: Smoothing) -> tuple[Tensor, Tensor]:
    """E[∂d(T exp ξ)/∂T] over antithetic rotations ξ of both bodies: unbiased, all samples in one backend call.

    ``noise`` is that of the one body against the other, so each body gets its share of the variance.
    """
    generator = torch.Generator().manual_seed(smoothing.seed)
    n_pairs, shape = len(pairs), ((smoothing.samples + 1) // 2, 2, len(pairs), 3)
    half = torch.randn(shape, generator=generator, dtype=torch.float64).to(T_a) * (smoothing.noise * 0.5**0.5)
    turn = se3.exp_so3(torch.cat([half, -half]))
    turn = se3.from_rotation_translation(turn, turn.new_zeros(turn.shape[:-1]))
    turned_a, turned_b = (T_a @ turn[:, 0]).flatten(0, 1), (T_b @ turn[:, 1]).flatten(0, 1)
    _, n, a, b = _query(run, turned_a, turned_b, parts, pairs.repeat(len(turn), 1))
    outer_a, outer_b = (_outer(n, T, x).unflatten(0, (len(turn), n_pairs)) for T, x in ((turned_a, a), (turned_b, b)))
    return -(outer_a @ turn[:, 0].mT).mean(0), (outer_b @ turn[:, 1].mT).mean(0)


def _outer(normal: Tensor, T: Tensor, point: Tensor) -> Tensor:
    """n ⊗ [T⁻¹ point; 1] as (E, 4, 4) with a zero bottom row."""
    local = ((point - T[:, :3, 3])[:, None] @ T[:, :3, :3])[:, 0]
    top = normal[:, :, None] * torch.cat([local, torch.ones_like(local[:, :1])], dim=-1)[:, None]
    return torch.cat([top, torch.zeros_like(top[:, :1])], dim=1)


def _orthonormal(R: Tensor) -> Tensor:
    """Rotations (E, 3, 3) nearest to almost-rotations, float32 ones say: distances are as exact as rotations are."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    for _ in range(4):
        excess = R.mT @ R - eye
        if not bool((excess.abs() > 1e-15).any()):
            break
        R = R - 0.5 * R @ excess
    return R


def _from_a(T_a: Tensor, T_b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both poses as seen from where a's origin is, (E, 3): nothing is lost far from the camera then."""
    origin = T_a[:, :3, 3].detach()
    return _moved(T_a, -origin), _moved(T_b, -origin), origin


def _moved(T: Tensor, shift: Tensor) -> Tensor:
    out = T.clone()
    out[:, :3, 3] = out[:, :3, 3] + shift
    return out
