"""Estimates that cannot all be true, for their bodies lie deep in one another: who of them pushes nobody."""

import math

import torch
from torch import Tensor

from physpose_torch.agreement import Heights, weights
from physpose_torch.contacts import find_contacts
from physpose_torch.distance.autograd import chosen_backend
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene
from physpose_torch.solvers.descent import out_of_planes

__all__ = ["find_dubious", "find_overlaps"]

ASKEW = (math.radians(12), math.radians(23))
"""Tilt against the nearest stable pose at which an estimate begins to be dubious, and at which it is so altogether."""
UNSTABLE = 4.0
"""What that counts, in units of the pose cost."""
UNSURE = 3.0
"""What a score of nothing counts beside the best one of the image."""
MOST = 4.0
"""A single overlap counts as its depth over the limit, and at most this."""
SIGMAS = 3.0
"""Where nothing static tells depths, an overlap may be so many σ deeper along the rays."""


def find_dubious(
    heights: Heights, depth: Tensor, prior: PosePrior, scene: Scene, scores: Tensor, *, limit: float, backend: str
) -> Tensor:
    """Objects (N,) that must not push others: of bodies deep in one another the less likely ones.

    The estimates are looked at where their images' depth factors and planes put them. While any two lie deeper in each other
    than ``limit``, that with the most against it is taken out: its overlaps, how far the planes moved it, whether it could
    stand as it is, and its score. A false detection overlaps several others, each of which overlaps only it.

    Args:
        heights: of the estimates.
        depth: (I,) depth factor less one that each image asks for.
        prior: of the flat estimates.
        scene: the flat scene.
        scores: (N,).
        limit: [m]; true poses of real data overlap by up to 14 mm. Infinite: nobody is dubious.
        backend: distance backend.
    """
    dubious = torch.zeros(len(scene), dtype=torch.bool)
    if limit == math.inf:
        return dubious
    placed = prior.measured.clone()
    placed[:, :3, 3] += depth[prior.image, None] * prior.ray
    slid = out_of_planes(prior._replace(measured=placed), scene)
    pairs, overlap = find_overlaps(slid, scene, prior.acts.cpu(), backend)
    if not len(pairs):
        return dubious
    center = scene.centers(prior.measured)
    distance2 = (center**2).sum(-1).clamp_min(torch.finfo(center.dtype).tiny)
    covariance = torch.linalg.inv(prior.precision)[:, :3, :3]
    along = torch.einsum("ni,nij,nj->n", center, covariance, center) / distance2
    along_both = along.cpu()[pairs].sum(1)
    slack = torch.where(scene.has_static[scene.image[pairs[:, 0]]], 0.0, SIGMAS * along_both.sqrt())
    overlap = overlap.cpu()
    deep = overlap > limit + slack
    if not bool(deep.any()):
        return dubious

    moved2 = ((slid - placed)[:, :3, 3] ** 2).sum(-1) / along
    unstable = ((heights.rest.tilt - ASKEW[0]) / (ASKEW[1] - ASKEW[0])).clamp(0.0, 1.0)
    unstable = torch.where((heights.up != 0).any(-1), unstable, 0.0)
    robust = prior.robust if prior.robust != math.inf else 4.0
    against = 0.5 * robust * torch.log1p(moved2 / robust) + UNSTABLE * unstable + UNSURE * (1 - weights(scores, prior))
    against = against.tolist()
    left = [(*pair, min(d / limit, MOST)) for pair, d in zip(pairs[deep].tolist(), overlap[deep].tolist(), strict=True)]
    images = scene.image.tolist()
    for image in {images[a] for a, _, _ in left}:
        here = [edge for edge in left if images[edge[0]] == image]
        while here:
            charge: dict[int, float] = {}
            for a, b, weight in here:
                charge[a] = charge.get(a, against[a]) + weight
                charge[b] = charge.get(b, against[b]) + weight
            worst = max(charge, key=charge.__getitem__)
            dubious[worst] = True
            here = [edge for edge in here if worst not in edge[:2]]
    return dubious


def find_overlaps(poses: Tensor, scene: Scene, acts: Tensor, backend: str) -> tuple[Tensor, Tensor]:
    """Pairs of objects (E, 2) that act, and how deep the parts of each are in one another at most (E,) [m], 0: not at all."""
    n = len(scene)
    if chosen_backend(backend) == "warp":
        from physpose_torch import fused  # which imports Warp

        if fused.remembers(scene, poses, 0.0):
            pairs, depth = fused.FusedMeasure(scene, acts, poses, 0.0).overlaps()
            pairs = pairs.cpu()
            both = _both_act(pairs, acts, n)
            return pairs[both], depth[both.to(depth.device)]
    contacts = find_contacts(poses, scene, acts=acts, backend=backend)
    pairs = torch.stack([contacts.pair_first, contacts.pair_second], dim=1).cpu()
    depth = poses.new_zeros(len(pairs))
    depth = depth.scatter_reduce(0, contacts.pair, (-contacts.distance).clamp_min(0.0), "amax")
    both = _both_act(pairs, acts, n)
    return pairs[both], depth[both.to(depth.device)]


def _both_act(pairs: Tensor, acts: Tensor, n: int) -> Tensor:
    """Which of the pairs of entities are two objects that act."""
    if not n:
        return torch.zeros(len(pairs), dtype=torch.bool)
    return (pairs[:, 1] < n) & acts[pairs[:, 0]] & acts[pairs[:, 1].clamp_max(n - 1)]
