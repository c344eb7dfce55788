"""Rigid transforms on (..., 4, 4) tensors; the SO(3) mathematics is kornia's.

Tangent vectors are ordered [translation, rotation] as in the paper's residual (Sec. 3.1): the translation lives in the
camera frame, the rotation in the object frame, ``retract(T, [dt, dw]) = [R exp(dw), t + dt]``.
"""

from collections.abc import Sequence

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor

from physpose_torch.errors import InvalidInputError

__all__ = [
    "apply",
    "check_rigid",
    "exp_so3",
    "from_rotation_translation",
    "hat",
    "inverse",
    "log_so3",
    "residual",
    "retract",
    "right_jacobian_inverse",
    "tangent_gradient",
]

RIGID_TOLERANCE = 1e-3
"""Largest entry of RᵀR - I that still counts as a rotation; float32 networks stay well below, scales do not."""


def hat(omega: Tensor) -> Tensor:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*omega.shape[:-1], 3, 3)


def exp_so3(omega: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return So3.exp(omega).matrix()


def log_so3(R: Tensor) -> Tensor:
    """Rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3), with angles in [0, π]."""
    q = So3.from_matrix(R).q.data
    # the shorter way round: q and -q are one rotation, and kornia's log takes the angle from q as it is
    q = torch.where(q[..., :1] < 0, -q, q)
    vector, real = q[..., 1:], q[..., :1]
    norm = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    small = norm < 1e-7
    angle = 2.0 * torch.atan2(norm, real)
    factor = torch.where(small, 2.0 / real.clamp_min(0.5), angle / torch.where(small, torch.ones_like(norm), norm))
    return factor * vector


def right_jacobian_inverse(omega: Tensor) -> Tensor:
    """Inverse right Jacobian J_r(ω)⁻¹ of SO(3), (..., 3, 3) (Solà et al. 2018, Eq. 144); finite for all |ω| ≤ π."""
    angle2 = (omega * omega).sum(-1)[..., None, None]
    small = angle2 < 1e-6
    safe = torch.where(small, torch.ones_like(angle2), angle2)
    angle = safe.sqrt()
    # (1 + cos θ) / (2 θ sin θ) = 1 / (2 θ tan(θ/2)), which stays finite at π
    factor = torch.where(small, 1.0 / 12.0 + angle2 / 720.0, 1.0 / safe - 0.5 / (angle * torch.tan(0.5 * angle)))
    skew = hat(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return eye + 0.5 * skew + factor * (skew @ skew)


def from_rotation_translation(R: Tensor, t: Tensor) -> Tensor:
    """Transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    top = torch.cat([R, t.unsqueeze(-1)], dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def inverse(T: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    R_inv = T[..., :3, :3].mT
    return from_rotation_translation(R_inv, -(R_inv @ T[..., :3, 3:]).squeeze(-1))


def apply(T_a_b: Tensor, x_b: Tensor) -> Tensor:
    """Points x_a (..., K, 3) of points x_b (..., K, 3): ``x_a = T_a_b x_b``."""
    return x_b @ T_a_b[..., :3, :3].mT + T_a_b[..., None, :3, 3]


def retract(T: Tensor, xi: Tensor) -> Tensor:
    """Move T (..., 4, 4) by xi (..., 6): translation in the camera frame, rotation in the object frame."""
    return from_rotation_translation(T[..., :3, :3] @ exp_so3(xi[..., 3:]), T[..., :3, 3] + xi[..., :3])


def residual(T: Tensor, T_measured: Tensor) -> Tensor:
    """The paper's residual e = [t - t̃, log(R̃ᵀR)] (..., 6) of poses against measured ones (Sec. 3.1)."""
    R_delta = T_measured[..., :3, :3].mT @ T[..., :3, :3]
    return torch.cat([T[..., :3, 3] - T_measured[..., :3, 3], log_so3(R_delta)], dim=-1)


def tangent_gradient(T: Tensor, gradient: Tensor) -> Tensor:
    """Gradient (..., 6) with respect to the step of :func:`retract` at zero, of a 4×4 gradient dL/dT (..., 4, 4)."""
    A = T[..., :3, :3].mT @ gradient[..., :3, :3]
    A = A - A.mT
    return torch.cat([gradient[..., :3, 3], torch.stack([A[..., 2, 1], A[..., 0, 2], A[..., 1, 0]], dim=-1)], dim=-1)


def check_rigid(T: Tensor, name: str, names: Sequence[str] | None = None) -> None:
    """Raise unless T (..., 4, 4) holds finite rigid transforms.

    Args:
        T: transforms to check, translations in metres.
        name: what the caller calls them; the message says ``name[3]``.
        names: labels of the rows, added to the message where given.

    Raises:
        InvalidInputError: wrong shape or dtype, NaN or infinity, a bottom row other than 0 0 0 1, or a non-rotation.
    """
    if not isinstance(T, Tensor):
        raise InvalidInputError(f"{name} is a {type(T).__name__}, expected a torch.Tensor of shape (..., 4, 4)")
    if not T.is_floating_point():
        raise InvalidInputError(f"{name} has dtype {T.dtype}, expected float32 or float64")
    if T.ndim < 2 or T.shape[-2:] != (4, 4):
        raise InvalidInputError(f"{name} has shape {tuple(T.shape)}, expected (..., 4, 4) transforms T_camera_object")
    if T.numel() == 0:
        return
    with torch.no_grad():
        flat = T.detach().reshape(-1, 4, 4).double()
        finite = flat.isfinite().flatten(1).all(1)
        R = flat[:, :3, :3]
        deviation = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs().flatten(1).amax(1)
        det = torch.linalg.det(torch.where(finite[:, None, None], R, torch.zeros_like(R)))
        bottom = (flat[:, 3] - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device)).abs().amax(1)
        good = finite & (deviation < RIGID_TOLERANCE) & (det > 0) & (bottom < RIGID_TOLERANCE)
        if bool(good.all()):
            return
        row = int((~good).nonzero()[0, 0])
    index = torch.unravel_index(torch.tensor(row), T.shape[:-2]) if T.ndim > 2 else ()
    where = f"{name}[{', '.join(str(int(i)) for i in index)}]" if index else name
    if names is not None:
        where += f" ({names[row % len(names)]})"
    if not bool(finite[row]):
        raise InvalidInputError(f"{where} contains NaN or infinity; drop that estimate before refining")
    if float(bottom[row]) >= RIGID_TOLERANCE:
        bottom_row = flat[row, 3].tolist()
        raise InvalidInputError(f"{where} has bottom row {bottom_row}, expected [0, 0, 0, 1]; is it transposed?")
    raise InvalidInputError(
        f"{where} is not rigid: det(R) = {float(det[row]):.3g}, largest entry of RᵀR - I {float(deviation[row]):.2g}; "
        "expected a rotation (det 1). Scales and units belong into Body.from_mesh(scale=...), not into the pose"
    )
