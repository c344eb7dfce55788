"""Rigid transforms: group laws, derivatives, and messages for what is not rigid."""

import math

import numpy as np
import pytest
import roma
import torch
from scipy.spatial.transform import Rotation

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError

BATCHES = [(), (1,), (3, 1, 2)]
ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-7, 3e-4, 1e-3, 1.0, 2.0, 3.0, *(math.pi - x for x in (1e-3, 1e-6, 1e-9, 0.0))]


def rotation_vectors(angle, n=50, seed=0):
    axis = np.random.default_rng(seed).normal(size=(n, 3))
    axis[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    return torch.as_tensor(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True))


def transforms(batch, seed=0, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    w, t = (torch.randn(*batch, 3, generator=g, dtype=torch.float64) for _ in range(2))
    return se3.from_rotation_translation(se3.exp_so3(w), t).to(dtype)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_agrees_with_scipy(angle):
    w = rotation_vectors(angle)
    np.testing.assert_allclose(se3.exp_so3(w).numpy(), Rotation.from_rotvec(w.numpy()).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle):
    w = rotation_vectors(angle)
    R = torch.as_tensor(Rotation.from_rotvec(w.numpy()).as_matrix())
    back = se3.log_so3(R)
    assert back.norm(dim=-1).max() <= math.pi + 1e-12
    np.testing.assert_allclose(Rotation.from_rotvec(back.numpy()).as_matrix(), R.numpy(), atol=1e-14)
    if angle < math.pi - 1e-8:
        torch.testing.assert_close(back, w, atol=1e-12 if angle < 3.1 else 1e-8, rtol=0.0)


@pytest.mark.parametrize("seed", range(3))
def test_log_agrees_with_scipy_and_roma_on_any_rotation(seed):
    R = torch.as_tensor(Rotation.random(200, random_state=seed).as_matrix())
    expected = Rotation.from_matrix(R.numpy()).as_rotvec()
    np.testing.assert_allclose(se3.log_so3(R).numpy(), expected, atol=1e-12)
    torch.testing.assert_close(se3.log_so3(R), roma.rotmat_to_rotvec(R), atol=1e-12, rtol=0.0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 3.0, math.pi - 1e-4])
def test_log_and_exp_have_finite_exact_derivatives(angle):
    w = rotation_vectors(angle, n=8).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp_so3, w, eps=1e-6, atol=1e-6)
    if 0 < angle < 3.1:
        assert torch.autograd.gradcheck(lambda x: se3.log_so3(se3.exp_so3(x)), w, eps=1e-7, atol=1e-5)
    gradient, = torch.autograd.grad(se3.log_so3(se3.exp_so3(w)).sum(), w)
    assert gradient.isfinite().all()
    if angle < 3.1:
        torch.testing.assert_close(gradient, torch.ones_like(w), atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 9e-4, 1.1e-3, 0.3, 1.5, 3.0, math.pi - 1e-3])
def test_right_jacobian_inverse_is_the_derivative_of_log(angle):
    """d log(exp(ω) exp(δ)) / dδ at zero."""
    for w in rotation_vectors(angle, n=10):
        R = se3.exp_so3(w)
        columns = []
        for axis in torch.eye(3, dtype=torch.float64):
            h = 1e-5 if angle < 3.1 else 1e-6
            forward, backward = (se3.log_so3(R @ se3.exp_so3(s * h * axis)) for s in (1, -1))
            columns.append((forward - backward) / (2 * h))
        J = se3.right_jacobian_inverse(w)
        torch.testing.assert_close(J, torch.stack(columns, dim=1), atol=1e-6 if angle < 3.1 else 1e-4, rtol=1e-6)


def test_right_jacobian_inverse_is_finite_at_a_half_turn():
    w = rotation_vectors(math.pi, n=8).requires_grad_()
    J = se3.right_jacobian_inverse(w)
    assert J.isfinite().all()
    assert torch.autograd.grad(J.sum(), w)[0].isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", BATCHES)
def test_group_axioms(batch, dtype):
    A, B, eye = transforms(batch, 0, dtype), transforms(batch, 1, dtype), torch.eye(4, dtype=dtype)
    atol = 1e-5 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(A @ se3.inverse(A), eye.expand(*batch, 4, 4), atol=atol, rtol=0.0)
    torch.testing.assert_close(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=atol, rtol=0.0)
    x = torch.randn(*batch, 5, 3, dtype=dtype)
    torch.testing.assert_close(se3.apply(A @ B, x), se3.apply(A, se3.apply(B, x)), atol=10 * atol, rtol=0.0)
    torch.testing.assert_close(se3.apply(se3.inverse(A), se3.apply(A, x)), x, atol=10 * atol, rtol=0.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", BATCHES)
def test_residual_undoes_retract(batch, dtype):
    T = transforms(batch, dtype=dtype)
    xi = torch.randn(*batch, 6, dtype=dtype, generator=torch.Generator().manual_seed(2))
    moved = se3.retract(T, xi)
    assert moved.dtype == dtype
    torch.testing.assert_close(se3.residual(moved, T), xi, atol=1e-4 if dtype == torch.float32 else 1e-12, rtol=0.0)
    torch.testing.assert_close(moved[..., :3, 3], T[..., :3, 3] + xi[..., :3])  # translation in the camera frame
    expected = T[..., :3, :3] @ se3.exp_so3(xi[..., 3:])  # rotation in the object frame
    torch.testing.assert_close(moved[..., :3, :3], expected)


@pytest.mark.parametrize("batch", BATCHES)
def test_tangent_gradient_is_the_derivative_along_retract(batch):
    T = transforms(batch)
    weight = torch.randn(*batch, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))

    def value(T):
        return (weight * T.sin()).sum((-1, -2))

    expected = []
    for axis in torch.eye(6, dtype=torch.float64):
        steps = (value(se3.retract(T, s * 1e-5 * axis.expand(*batch, 6))) for s in (1, -1))
        forward, backward = steps
        expected.append((forward - backward) / 2e-5)
    out = se3.tangent_gradient(T, weight * T.cos())
    assert out.shape == (*batch, 6)
    torch.testing.assert_close(out, torch.stack(expected, dim=-1), atol=1e-8, rtol=0.0)


def test_hat_is_the_cross_product():
    a, b = torch.randn(2, 7, 3, dtype=torch.float64)
    torch.testing.assert_close((se3.hat(a) @ b[:, :, None])[:, :, 0], torch.linalg.cross(a, b))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [*BATCHES, (0,), (2, 0)])
def test_rigid_transforms_pass(batch, dtype):
    T = transforms(batch, dtype=dtype)
    se3.check_rigid(T, "poses")
    far = T.clone()
    far[..., :3, 3] *= 1000.0  # millimetres are rigid too: only the lengths are off, and those cannot be told
    se3.check_rigid(far, "poses")


def broken(how, index=(2, 0, 1), batch=(3, 1, 2)):
    T = transforms(batch)
    if how == "nan":
        T[index][0, 1] = math.nan
    elif how == "infinite":
        T[index][1, 3] = math.inf
    elif how == "transposed":
        T[index] = T[index].T.clone()
    elif how == "scaled":
        T[index][:3, :3] *= 1.01
    elif how == "mirrored":
        T[index][:3, 0] *= -1
    elif how == "sheared":
        T[index][0, 1] += 0.01
    return T


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("nan", "NaN or infinity"), ("infinite", "NaN or infinity"), ("transposed", "transposed"),
        ("scaled", r"not rigid: det\(R\) = 1.03"), ("mirrored", r"not rigid: det\(R\) = -1"), ("sheared", "not rigid"),
    ],
)
def test_the_first_broken_transform_is_named(how, message):
    with pytest.raises(InvalidInputError, match=message) as error:
        se3.check_rigid(broken(how), "poses")
    assert str(error.value).startswith("poses[2, 0, 1]")
    with pytest.raises(InvalidInputError, match=r"^T_camera_table (contains|has|is)"):
        se3.check_rigid(broken(how)[2, 0, 1], "T_camera_table")
    with pytest.raises(InvalidInputError, match=r"poses\[1\] \(mug\)"):
        se3.check_rigid(broken(how)[2, 0], "poses", names=["bowl", "mug"])


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(4), "ndarray, expected a torch.Tensor"),
        (torch.eye(4, dtype=torch.long), "dtype torch.int64"),
        (torch.eye(3), r"shape \(3, 3\), expected \(..., 4, 4\)"),
        (torch.zeros(4), r"shape \(4,\)"),
        (torch.zeros(5, 3, 4), r"shape \(5, 3, 4\)"),
    ],
)
def test_what_is_no_transform_is_refused(T, message):
    with pytest.raises(InvalidInputError, match=f"poses (is|has).*{message}"):
        se3.check_rigid(T, "poses")
