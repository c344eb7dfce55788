"""Where the links are for given joint values: pytorch-kinematics behind checks, in float64 and float32."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError, MissingExtraError
from physpose_torch.robot.urdf import Joint, RobotModel

__all__ = ["Kinematics", "listed"]

SLACK = {"revolute": 0.05, "prismatic": 0.005}
"""[rad], [m]; encoders may be off by this much beyond a limit."""


class Kinematics:
    """Forward kinematics of a robot; joints that mimic another follow it, fixed ones are not in q.

    Args:
        model: a URDF that has been read.
    """

    def __init__(self, model: RobotModel) -> None:
        self.model = model
        self._moving = [j for j in _depth_first(model) if j.kind != "fixed"]
        self._own = [j for j in self._moving if j.mimic is None]
        self._follow = _followers(self._moving, self._own)
        self._chains: dict[tuple, Any] = {}

    @property
    def joint_names(self) -> list[str]:
        """Order of q: depth first as in pytorch-kinematics."""
        return [j.name for j in self._own]

    @property
    def limits(self) -> Tensor:
        """(dof, 2) lower and upper limits [rad] or [m], float64; infinite for continuous joints."""
        return torch.tensor([[j.lower, j.upper] for j in self._own], dtype=torch.float64).reshape(-1, 2)

    def link_poses(self, q: Tensor) -> dict[str, Tensor]:
        """T_base_link (I, 4, 4) of every link [m], for checked q (I, dof); differentiable."""
        factor, offset = (x.to(q) for x in self._follow)
        if not self._moving:
            q = q.new_zeros(len(q), 0)
        else:
            q = q @ factor.mT + offset
        found = self._chain(q.dtype, q.device).forward_kinematics(q)
        return {name: found[name].get_matrix().expand(len(q), 4, 4) for name in self.model.links}

    def _chain(self, dtype: torch.dtype, device: torch.device):
        key = dtype, device
        if key not in self._chains:
            self._chains[key] = _make_chain(self.model, dtype, device)
        return self._chains[key]

    def checked(self, q) -> tuple[Tensor, bool]:
        """Joint values as (I, dof), and whether they were a batch.

        Args:
            q: (dof,) or (I, dof) in the order of :attr:`joint_names`, or a dict of all of them, of numbers or (I,).

        Raises:
            InvalidInputError: names, shapes, NaN, or values beyond a joint's limits (degrees, say).
        """
        names, n = self.joint_names, len(self._own)
        if isinstance(q, Mapping):
            unknown, missing = [x for x in q if x not in names], [x for x in names if x not in q]
            if unknown or missing:
                what = f"unknown: {listed(unknown)}" if unknown else f"missing: {listed(missing)}"
                raise InvalidInputError(f"q names joints; {what}. This robot moves by {listed(names)}")
            q = _stacked(q, names)
        elif not isinstance(q, Tensor):
            q = torch.as_tensor(q, dtype=torch.float64)
        if q.dtype not in (torch.float32, torch.float64):
            q = q.to(torch.float32 if q.is_floating_point() else torch.float64)
        if q.ndim not in (1, 2) or q.shape[-1] != n:
            raise InvalidInputError(f"q has shape {tuple(q.shape)}, expected ({n},) or (I, {n}) for {listed(names)}")
        batched = q.ndim == 2
        q = q if batched else q[None]
        values = q.detach().double().cpu()
        if not bool(values.isfinite().all()):
            raise InvalidInputError(f"q = {values.tolist()} has NaN or infinity in it")
        slack = torch.tensor([SLACK.get(j.kind, math.inf) for j in self._own], dtype=torch.float64)
        lower, upper = self.limits.unbind(1)
        beyond = (values < lower - slack) | (values > upper + slack)
        if bool(beyond.any()):
            i, j = beyond.nonzero()[0].tolist()
            raise InvalidInputError(
                f"q: joint {names[j]!r} at {float(values[i, j]):.4g} is beyond its limits {float(lower[j]):.4g} to "
                f"{float(upper[j]):.4g}; angles are in radians, lengths in metres"
            )
        return q, batched


def _stacked(q: Mapping[str, Any], names: Sequence[str]) -> Tensor:
    """The values of a dict, in the order of the names."""
    like = next((v for v in q.values() if isinstance(v, Tensor) and v.is_floating_point()), None)
    like = torch.zeros((), dtype=torch.float64) if like is None else like
    values = [torch.as_tensor(q[x]).to(like) for x in names]
    try:
        return torch.stack(torch.broadcast_tensors(*values), -1) if values else like.new_zeros(0)
    except RuntimeError as error:
        shapes = {x: tuple(v.shape) for x, v in zip(names, values, strict=True)}
        raise InvalidInputError(f"q has values of shapes {shapes}, expected numbers or (I,)") from error


def _depth_first(model: RobotModel) -> list[Joint]:
    """Joints in the order in which pytorch-kinematics numbers them."""
    out: list[Joint] = []
    front = model.children(model.root)[::-1]
    while front:
        joint = front.pop()
        out.append(joint)
        front += model.children(joint.child)[::-1]
    return out


def _followers(moving: Sequence[Joint], own: Sequence[Joint]) -> tuple[Tensor, Tensor]:
    """All moving joints are ``factor`` (M, dof) times q, plus ``offset`` (M,): those that mimic follow theirs."""
    column = {j.name: i for i, j in enumerate(own)}
    factor = torch.zeros(len(moving), len(own), dtype=torch.float64)
    offset = torch.zeros(len(moving), dtype=torch.float64)
    for i, joint in enumerate(moving):
        if joint.mimic is None:
            factor[i, column[joint.name]] = 1.0
        else:
            factor[i, column[joint.mimic.joint]] = joint.mimic.multiplier
            offset[i] = joint.mimic.offset
    return factor, offset


def _make_chain(model: RobotModel, dtype: torch.dtype, device: torch.device):
    """The kinematic tree for pytorch-kinematics, which takes two seconds to import."""
    try:
        from pytorch_kinematics import Transform3d
        from pytorch_kinematics.chain import Chain
        from pytorch_kinematics.frame import Frame, Link
        from pytorch_kinematics.frame import Joint as ChainJoint
    except ImportError as error:
        raise MissingExtraError("robots need pytorch-kinematics; pip install pytorch-kinematics") from error

    def frame(link: str, joint: Joint | None) -> Any:
        out = Frame(link, link=Link(link))
        if joint is not None:
            out.joint = ChainJoint(
                joint.name,
                offset=Transform3d(matrix=joint.T_parent_joint.to(dtype)[None]),
                joint_type="revolute" if joint.kind == "continuous" else joint.kind,
                axis=torch.tensor(joint.axis, dtype=dtype),
                dtype=dtype,
            )
        out.children = [frame(j.child, j) for j in model.children(link)]
        return out

    return Chain(frame(model.root, None), dtype=dtype).to(dtype=dtype, device=device)


def listed(names) -> str:
    """Names for a message."""
    return ", ".join(map(repr, names)) or "none"
