"""Robust least squares over the second camera, the objects' poses, the table plane and the common depth factor.

What is known enters as terms (see :mod:`physpose_torch.table.evidence`), each a whitened residual of some unknowns. Every row
sees at most one object, so that Jacobians have sixteen columns however many objects there are. Steps are Gauss–Newton's with
Student-t weights, whose scale is brought down from far to one (graduated non-convexity), so that what is far off at first is
not taken for an outlier.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.distance.smoothing import tangent_basis

__all__ = ["FINE", "ROUGH", "Fit", "State", "Term", "Unknowns", "adjust", "unknowns_at"]

ROUGH = (8.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 1.0)
"""Scales of the weights from a rough start, one a step."""
FINE = (3.0, 2.0, 1.5, 1.0, 1.0, 1.0)
"""The same from a good one."""
SHARED = 10
"""Unknowns that all rows may see: second camera (6), plane (3), depth factor (1); then six of the row's own object."""
FACTOR = 9
"""Place of the depth factor among them."""
RIDGE = (1.0, 1e-4, 1.0)
"""Weight that keeps the second camera, objects and plane from running where nothing holds them, in units of 1 m and 1 rad."""
DIFFERENCE = 1e-6
"""Step of the differences that stand for derivatives [m, rad, 1]."""
LARGEST_STEP = 0.3
"""No unknown moves by more than this in a step [m, rad, 1]."""


class State(NamedTuple):
    """Values of the unknowns."""

    T_view1_view0: Tensor
    """(4, 4)."""
    poses: Tensor
    """T_view0_object (N, 4, 4) [m]."""
    normal: Tensor
    """(3,) up, view 0."""
    offset: Tensor
    """() [m]."""
    depth_factor: Tensor
    """() what the estimated translations must be multiplied by."""
    middle: Tensor
    """(3,) the point under which the plane's covariance is given, view 0 [m]."""


class Unknowns(NamedTuple):
    """The same a small step away, for many steps at once; rotations to first order."""

    R10: Tensor
    t10: Tensor
    R: Tensor
    t: Tensor
    normal: Tensor
    offset: Tensor
    depth_factor: Tensor

    def pose(self, view: int) -> tuple[Tensor, Tensor]:
        """Rotations (..., N, 3, 3) and translations (..., N, 3) of the objects in a view."""
        if view == 0:
            return self.R, self.t
        return self.R10[..., None, :, :] @ self.R, self.t @ self.R10.mT + self.t10[..., None, :]


class Term(Protocol):
    """A kind of evidence: G rows of K whitened numbers."""

    owner: Tensor | None
    """(G,) which object each row is about; None: about none."""
    weight: Tensor | float
    """(G,) how much each row counts; less than 1 where many rows err together."""
    nu: float
    """Degrees of freedom of the Student-t distribution; infinite: normal."""
    cap: float | None
    """If given, a row costs this much at the most (Geman and McClure 1985), however far off: what it says need not be true."""

    def residual(self, x: Unknowns) -> Tensor:
        """(G, K)."""
        ...


class Fit(NamedTuple):
    """The minimum."""

    state: State
    covariance: Tensor
    """(3, 3) of the plane: two tilts along ``tangent_basis(normal)`` [rad] and its height at the middle [m]."""
    relative: Tensor
    """(3, 3) the same for a given depth factor: how well the plane is known against poses that share its error."""
    cost: float
    """Negative log-likelihood up to a constant."""
    surprise: tuple[Tensor, ...]
    """(G,) squared length of each term's whitened rows."""


def adjust(state: State, terms: Sequence[Term], schedule: Sequence[float], *, widest: float = 1.0) -> Fit:
    """Minimise the robust cost of the terms, from a start.

    Args:
        state: where to start.
        terms: the evidence.
        schedule: scales of the robust weights, one a step.
        widest: largest of them for terms with a cap. Seen from farther than one, what is truly elsewhere is pulled in and
            stays; where nothing else could tell what is elsewhere, it is found from farther away.
    """
    for scale in schedule:
        matrix, gradient, _, _ = _normal_equations(state, terms, scale, min(scale, widest))
        state = _moved(state, -torch.linalg.solve(matrix, gradient).clamp(-LARGEST_STEP, LARGEST_STEP))
    matrix, _, cost, surprise = _normal_equations(state, terms, 1.0)
    given = [i for i in range(len(matrix)) if i != FACTOR]
    relative = torch.linalg.inv(matrix[given][:, given])
    return Fit(state, torch.linalg.inv(matrix)[6:9, 6:9], relative[6:9, 6:9], cost, surprise)


def unknowns_at(state: State) -> Unknowns:
    """The state as terms take it, with one leading dimension of length 1."""
    return _unknowns(state, state.middle.new_zeros(1, SHARED + 6))


def _unknowns(state: State, step: Tensor) -> Unknowns:
    """The state some steps (B, SHARED + 6) away: all objects move by the same last six numbers, each in its own frame."""
    eye = torch.eye(3, dtype=step.dtype)
    camera, tilt, rise, factor, body = step[:, :6], step[:, 6:8], step[:, 8], step[:, 9], step[:, None, SHARED:]
    lean = tilt @ tangent_basis(state.normal[None])[0]
    return Unknowns(
        state.T_view1_view0[:3, :3] @ (eye + se3.hat(camera[:, 3:])),
        state.T_view1_view0[:3, 3] + camera[:, :3],
        state.poses[:, :3, :3] @ (eye + se3.hat(body[..., 3:])),
        state.poses[:, :3, 3] + body[..., :3],
        state.normal - lean,
        state.offset + rise - lean @ state.middle,
        state.depth_factor * (1.0 + factor),
    )


def _moved(state: State, step: Tensor) -> State:
    """The state after a step (SHARED + 6 N,)."""
    n = len(state.poses)
    lean = step[6:8] @ tangent_basis(state.normal[None])[0]
    normal, offset = state.normal - lean, state.offset + step[8] - lean @ state.middle
    length = torch.linalg.vector_norm(normal)
    return state._replace(
        T_view1_view0=se3.retract(state.T_view1_view0, step[:6]),
        poses=se3.retract(state.poses, step[SHARED:].reshape(n, 6)),
        normal=normal / length,
        offset=offset / length,
        depth_factor=state.depth_factor * (1.0 + step[9]),
    )


def _normal_equations(state: State, terms: Sequence[Term], scale: float, capped: float = 1.0):
    """Gauss–Newton matrix and gradient, the cost at scale one, and every row's squared length."""
    n = len(state.poses)
    columns = SHARED + 6
    # forward differences, all columns in one go: forward-mode differentiation of so many small functions takes far longer
    steps = torch.cat([state.middle.new_zeros(1, columns), DIFFERENCE * torch.eye(columns, dtype=state.middle.dtype)])
    x = _unknowns(state, steps)
    zero = steps[0]
    shared = torch.zeros(SHARED, SHARED, dtype=zero.dtype)
    cross = torch.zeros(n, SHARED, 6, dtype=zero.dtype)
    own = torch.zeros(n, 6, 6, dtype=zero.dtype)
    gradient = torch.zeros(SHARED, dtype=zero.dtype)
    gradient_own = torch.zeros(n, 6, dtype=zero.dtype)
    cost, surprise = 0.0, []
    for term in terms:
        r, *moved = term.residual(x).expand(len(steps), -1, -1)
        J = (torch.stack(moved, -1) - r[..., None]) / DIFFERENCE
        squared = (r**2).sum(1)
        surprise.append(squared)
        weight, loss = _robust(squared, r.shape[1], term, scale, capped)
        cost += float((term.weight * loss).sum()) + getattr(term, "cost", 0.0)
        weight = weight * term.weight
        weighted = weight[:, None, None] * J
        shared += torch.einsum("gki,gkj->ij", weighted[..., :SHARED], J[..., :SHARED])
        pull = torch.einsum("gki,gk->gi", weighted, r)
        gradient += pull[:, :SHARED].sum(0)
        if term.owner is not None:
            block = torch.einsum("gki,gkj->gij", weighted, J[..., SHARED:])
            cross.index_add_(0, term.owner, block[:, :SHARED])
            own.index_add_(0, term.owner, block[:, SHARED:])
            gradient_own.index_add_(0, term.owner, pull[:, SHARED:])
    matrix = torch.zeros(SHARED + 6 * n, SHARED + 6 * n, dtype=zero.dtype)
    matrix[:SHARED, :SHARED] = shared
    matrix[:SHARED, SHARED:] = cross.permute(1, 0, 2).reshape(SHARED, -1)
    matrix[SHARED:, :SHARED] = matrix[:SHARED, SHARED:].mT
    matrix[SHARED:, SHARED:] = torch.block_diag(*own) if n else matrix[SHARED:, SHARED:]
    ridge = torch.full((len(matrix),), RIDGE[1], dtype=zero.dtype)
    ridge[:6], ridge[6:9] = RIDGE[0], RIDGE[2]
    return matrix + torch.diag(ridge), torch.cat([gradient, gradient_own.flatten()]), cost, tuple(surprise)


def _robust(squared: Tensor, dimensions: int, term: Term, scale: float, capped: float) -> tuple[Tensor, Tensor]:
    """Weights at a scale (``capped`` for terms with a cap), and losses at scale one, of rows with these squared lengths."""
    if term.cap is not None:
        limit = 2.0 * term.cap
        return (limit / (limit + squared / capped**2)) ** 2, 0.5 * squared * limit / (limit + squared)
    if term.nu == float("inf"):
        return torch.ones_like(squared), 0.5 * squared
    weight = (term.nu + dimensions) / (term.nu + squared / scale**2)
    return weight, 0.5 * (term.nu + dimensions) * torch.log1p(squared / term.nu)
