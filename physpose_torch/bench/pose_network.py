"""A small render-and-compare pose network, and how it is trained with and without the physics term."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from physpose_torch import se3
from physpose_torch.bench.training_scenes import AXIAL, LABELS, PoseSamples
from physpose_torch.config import PhysicsConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.losses import PhysicsLoss

__all__ = ["PoseNet", "PoseTrainer", "point_loss", "predict", "surface_points", "symmetric_truth"]

UNIT = 0.01
"""[m]; the supervised loss is in this unit, so that it is about one at the start."""
POINTS = 64
"""Surface points of an object in the supervised loss."""


class PoseNet(nn.Module):
    """A convolutional network that moves a coarse pose so that its rendering fits the photograph.

    It starts as the identity.

    Args:
        crop: pixels of a crop's side, a multiple of 8.
        width: channels of the first layer.
    """

    def __init__(self, *, crop: int = 32, width: int = 24) -> None:
        super().__init__()
        if crop < 8 or crop % 8:
            raise InvalidInputError(f"crop = {crop}, expected a multiple of 8")
        layers, channels = [], 5
        for out, stride in ((width, 2), (2 * width, 2), (3 * width, 2), (3 * width, 1)):
            layers += [nn.Conv2d(channels, out, 3, stride, 1), nn.GroupNorm(4, out), nn.SiLU()]
            channels = out
        self.features = nn.Sequential(*layers, nn.Flatten())
        self.head = nn.Sequential(
            nn.Linear(channels * (crop // 8) ** 2 + len(LABELS), 128), nn.SiLU(), nn.Linear(128, 6)
        )
        nn.init.zeros_(self.head[-1].weight)
        nn.init.zeros_(self.head[-1].bias)

    def forward(self, images: Tensor, label: Tensor, coarse: Tensor, side: Tensor) -> Tensor:
        """Better poses.

        Args:
            images, label, coarse, side: of M objects, see :class:`~physpose_torch.bench.training_scenes.PoseSamples`.

        Returns:
            T_camera_object (M, 4, 4) [m], in the dtype of ``coarse``.
        """
        who = nn.functional.one_hot(label, len(LABELS)).to(images)
        step = self.head(torch.cat([self.features(images), who], dim=1)).to(coarse)
        with torch.autocast(images.device.type, enabled=False):  # a rotation in half precision is none
            depth = coarse[:, 2, 3] * torch.exp(0.1 * step[:, 2])
            across = coarse[:, :2, 3] / coarse[:, 2:3, 3] + 0.1 * step[:, :2] * side[:, None]
            t = torch.cat([across * depth[:, None], depth[:, None]], dim=1)
            return se3.from_rotation_translation(se3.exp_so3(0.2 * step[:, 3:]) @ coarse[:, :3, :3], t)


def symmetric_truth(poses: Tensor, truth: Tensor, label: Tensor) -> Tensor:
    """The truth (M, 4, 4), turned about the axis of solids of revolution so that it is nearest to the poses (M, 4, 4)."""
    axial = torch.tensor([name in AXIAL for name in LABELS], device=label.device)[label]
    R = truth[:, :3, :3].mT @ poses.detach()[:, :3, :3]
    # of all turns by φ the one with the largest trace of Rz(φ)ᵀ R
    angle = torch.where(axial, torch.atan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]), 0.0)
    turn = torch.stack([0 * angle, 0 * angle, angle], dim=1)
    return se3.from_rotation_translation(truth[:, :3, :3] @ se3.exp_so3(turn), truth[:, :3, 3])


def point_loss(poses: Tensor, truth: Tensor, label: Tensor, points: Tensor) -> Tensor:
    """Mean distance (M,) of surface points at poses from where they should be [m]; blind to turns about an axis.

    Args:
        poses, truth: T_camera_object (M, 4, 4) [m].
        label: (M,) long.
        points: (L, P, 3) of each label, object frame [m].
    """
    target = symmetric_truth(poses, truth, label)
    apart = se3.apply(poses, points[label]) - se3.apply(target, points[label])
    # the square root has no slope at zero
    return (apart.square().sum(-1) + 1e-12).sqrt().mean(-1)


def surface_points(bodies: Mapping[str, Body], count: int = POINTS) -> Tensor:
    """(L, count, 3) vertices of each label's mesh, float32 [m]."""
    generator = torch.Generator().manual_seed(0)
    points = []
    for name in LABELS:
        vertices = torch.tensor(bodies[name].mesh.vertices, dtype=torch.float32)
        points.append(vertices[torch.randint(len(vertices), (count,), generator=generator)])
    return torch.stack(points)


@dataclass(frozen=True)
class PoseTrainer:
    """How a network is trained; called with the data, it returns the network."""

    steps: int = 600
    """Of Adam."""
    batch: int = 8
    """Samples (whole scenes) in a batch, and as many without labels where there are some."""
    learning_rate: float = 1e-3
    """First one; it decays to zero by a cosine."""
    noise: float = 0.03
    """Standard deviation of the photograph's noise, grey from 0 to 1."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """Weights of collision and gravity against each other, and their options. There is no pose cost."""

    def __call__(
        self,
        data: PoseSamples,
        points: Tensor,
        labelled: Sequence[int],
        *,
        unlabelled: Sequence[int] = (),
        weight: float = 0.0,
        seed: int = 0,
    ) -> PoseNet:
        """Train on the labelled samples with point loss + weight · physics, on the unlabelled ones with weight · physics.

        Args:
            data: the samples.
            points: (L, P, 3), see :func:`surface_points`.
            labelled, unlabelled: rows of the samples.
            weight: of the physics term, mean total of an object, against a supervised loss in units of 1 cm.
            seed: of the initial weights, the order and the noise.
        """
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            network = PoseNet(crop=data.images.shape[-1])
        optimizer = torch.optim.Adam(network.parameters(), lr=self.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.steps)
        physics = PhysicsLoss(self.physics)
        # one stream each: what is trained with labels is the same whether there is more without or not
        draw, more = (torch.Generator().manual_seed(seed + k) for k in (1, 2))
        for _ in range(self.steps):
            chosen, rows = self._choose(data, labelled, draw)
            poses = network(_noisy(data.images[rows], self.noise, draw), *_given(data, rows))
            loss = point_loss(poses, data.truth[rows], data.label[rows], points).mean() / UNIT
            if weight and unlabelled:
                extra, extra_rows = self._choose(data, unlabelled, more)
                images = _noisy(data.images[extra_rows], self.noise, more)
                poses = torch.cat([poses, network(images, *_given(data, extra_rows))])
                chosen = chosen + extra
            if weight:
                loss = loss + weight * physics(poses, data.scene(chosen)).total.mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        return network

    def _choose(self, data: PoseSamples, among: Sequence[int], draw: torch.Generator) -> tuple[list[int], Tensor]:
        chosen = [among[i] for i in torch.randint(len(among), (self.batch,), generator=draw).tolist()]
        return chosen, data.rows(chosen)


def _noisy(images: Tensor, sigma: float, draw: torch.Generator) -> Tensor:
    """The same with noise on the photograph; what is rendered has none."""
    noise = torch.zeros_like(images)
    noise[:, 0] = sigma * torch.randn(images[:, 0].shape, generator=draw)
    return images + noise


def _given(data: PoseSamples, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return data.label[rows], data.coarse[rows], data.side[rows]


@torch.no_grad()
def predict(network: PoseNet, data: PoseSamples, *, noise: float = 0.03, seed: int = 0) -> Tensor:
    """Poses (M, 4, 4) of all samples, their photographs under one draw of noise."""
    images = _noisy(data.images, noise, torch.Generator().manual_seed(seed))
    return torch.cat([network(images[rows], *_given(data, rows)) for rows in torch.arange(len(data.label)).split(512)])
