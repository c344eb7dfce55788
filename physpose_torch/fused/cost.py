"""The cost and its gradient for all images in a few kernel launches: what the descent evaluates where Warp is at hand."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from physpose_torch.config import STILL_STEPS, RefinerConfig, Smoothing
from physpose_torch.distance.warp import parts_struct, ready, wobble_struct, wrap
from physpose_torch.fused.buffers import FAR, make_prior, make_state, make_world, renew_rows
from physpose_torch.fused.kernels import cost_kernels
from physpose_torch.losses import PhysicsTerms
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene

__all__ = ["FusedCost", "FusedMeasure", "Measured", "remembers"]

MOST_PAIRS = 50_000_000
"""Pairs of parts that a scene may have; each takes 40 bytes."""
LEAST_ROWS = 2000
"""Fewer rows than this, some milliseconds of work, are not worth waiting for another thread."""
LOOK_AROUND = 10
"""Steps after which it is asked anew which bodies of a crowd are near each other."""
LM_STILL_STEPS = 2
"""A Gauss-Newton step that moves nothing is nearly proof enough."""


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(os.cpu_count() or 1, 2) - 1, "physpose_torch")


def remembers(scene: Scene, poses: Tensor, margin: float) -> bool:
    """Whether every pair of parts of bodies within ``margin`` [m] can be remembered; a heap of thousands has too many."""
    count = scene.instance_start.diff()[scene.near_pairs(scene.entity_poses(poses), margin)]
    return int((count[:, 0] * count[:, 1]).sum()) <= MOST_PAIRS


class Measured(NamedTuple):
    """Penetrations, heights and supports of posed objects, see :class:`physpose_torch.report.PhysicsReport`; (N,) each."""

    depth_static: Tensor
    depth_object: Tensor
    height: Tensor
    """Infinite where nothing is within reach."""
    support: Tensor
    """Entity, planes last; -1: none."""


class _Fused:
    """A scene and its poses as the kernels see them, in place in torch tensors.

    Finished images cost nothing: every kernel leaves them out, so the batch is never rebuilt and the host need not know. Of a
    crowd, only bodies within ``margin`` [m] of each other are held against each other.
    """

    def __init__(
        self, scene: Scene, acts: Tensor, poses: Tensor, smoothing: Smoothing | None, margin: float, *, lm: bool = False
    ) -> None:
        self._scene, self._acts, self._lm = scene, acts, lm
        self.n, self.n_images = len(scene), scene.n_images
        self.device, self.dtype = poses.device, poses.dtype
        self._on_cpu = self.device.type == "cpu"
        self._k = ready(cost_kernels, self.dtype, self.device)
        self._parts = parts_struct(scene.parts, self.dtype, self.device)
        self._wobble = wobble_struct(smoothing, self.dtype, self.device)
        self._world = self._near(scene.entity_poses(poses), margin)
        self._state, self._tensor = make_state(self._k, self._world, scene, poses, lm=lm)

    def _near(self, T: Tensor, margin: float) -> Any:
        pairs = self._scene.near_pairs(T, margin)
        return make_world(self._k, self._scene, self._acts, pairs, self.dtype, self.device)

    def _look_around(self, margin: float) -> None:
        """Ask anew which bodies of a crowd are near each other; launches must be recorded anew."""
        self._world = self._near(self._tensor["poses"], margin)
        renew_rows(self._k, self._state, self._tensor, self._world, lm=self._lm)

    @property
    def poses(self) -> Tensor:
        """(N, 4, 4) now."""
        return self._tensor["poses"][: self.n]

    def _record(self, launches: dict[str, tuple[Any, int, list]]) -> dict[str, Any]:
        """The launches, with their arguments worked out once."""
        device = wp.device_from_torch(self.device)
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if self.device.type == "cuda" else None
        return {
            name: wp.launch(kernel, dim=count, inputs=inputs, device=device, stream=stream, record_cmd=True)
            for name, (kernel, count, inputs) in launches.items()
            if count
        }

    def _launches(self, options: Any) -> dict[str, tuple[Any, int, list]]:
        k, state, world, parts, wobble = self._k, self._state, self._world, self._parts, self._wobble
        rows = len(self._tensor["clear"])
        # a launch on the CPU is one thread; every second row is about half of the work
        stride = self._threads = max(min(torch.get_num_threads(), rows // LEAST_ROWS), 1) if self._on_cpu else 1
        shares = [len(range(i, rows, stride)) for i in range(stride)]
        return {
            "boxes": (k.boxes, len(self._tensor["moved"]), [parts, world, state]),
            "planes": (k.planes, self.n, [parts, world, state, options, wobble]),
            **{
                f"rows {i}": (k.rows, n, [parts, world, state, options, wobble, i, stride])
                for i, n in enumerate(shares)
            },
            "measure": (k.measure, self.n, [world, state, options]),
        }

    def measure(self, *, reach: float) -> Measured:
        """Look at the poses as they are, for supports down to ``reach`` [m]."""
        options = self._k.Options()
        options.collision_weight = options.gravity_weight = options.softness = 1.0
        options.smooth = -1
        own_reach = self._tensor["reach"].clone()
        self._tensor["reach"].fill_(reach)
        self._tensor["done"].zero_()
        self._commands = self._record(_Fused._launches(self, options))
        self._launch("boxes", "planes")
        self._launch_rows()
        self._launch("measure")
        depth_static, depth_object, height, support = (
            self._tensor[k].clone() for k in ("depth_static", "depth_object", "height", "support")
        )
        self._tensor["reach"].copy_(own_reach)
        return Measured(depth_static, depth_object, torch.where(height <= reach, height, torch.inf), support.long())

    def overlaps(self) -> tuple[Tensor, Tensor]:
        """Pairs of entities (E, 2), and how deep the parts of each are in one another at most (E,) [m]."""
        options = self._k.Options()
        options.collision_weight = options.softness = 1.0
        options.smooth = -1
        self._tensor["done"].zero_()
        self._commands = self._record(_Fused._launches(self, options))
        self._launch("boxes")
        self._launch_rows()
        pairs = torch.stack([self._world._tensors[name].long() for name in ("pair_first", "pair_second")], dim=1)
        depth = self._tensor["row_depth"]
        row_pair = self._world._tensors["row_pair"].long()
        return pairs, depth.new_zeros(len(pairs)).scatter_reduce(0, row_pair, depth, "amax")

    def _launch(self, *names: str) -> None:
        for name in names:
            if name in self._commands:
                self._commands[name].launch()

    def _launch_rows(self) -> None:
        if self._threads > 1:
            others = [_pool().submit(self._launch, f"rows {i}") for i in range(1, self._threads)]
            self._launch("rows 0")
            for other in others:
                other.result()
        else:
            self._launch("rows 0")


class FusedMeasure(_Fused):
    """Measures poses without a cost.

    Args:
        scene: the flat scene.
        acts: (N,) bool, see :func:`physpose_torch.losses.acting`.
        poses: (N, 4, 4).
        margin: [m]; supports and contacts farther away than this are not looked for.
    """

    def __init__(self, scene: Scene, acts: Tensor, poses: Tensor, margin: float) -> None:
        super().__init__(scene, acts, poses, None, margin)


class FusedCost(_Fused):
    """State of a refinement in flight.

    Args:
        prior: the flat estimates.
        scene: the flat scene.
        acts: (N,) bool, see :func:`physpose_torch.losses.acting`.
        config: options.
        poses: (N, 4, 4) where to start.
        scale: (N, 6, 6) L, steps are in units of it.
    """

    def __init__(
        self, prior: PosePrior, scene: Scene, acts: Tensor, config: RefinerConfig, poses: Tensor, scale: Tensor
    ) -> None:
        physics = self._physics = config.physics
        smoothing = None if physics.smoothing.kind == "none" else physics.smoothing
        lm = config.solver == "lm"
        super().__init__(scene, acts, poses, smoothing, self.margin(config, prior), lm=lm)
        self._margin, self._moves = self.margin(config, prior), 0
        self._prior = make_prior(self._k, prior, scale, self.dtype, self.device)
        options = self._k.Options()
        for name in ("pose_weight", "collision_weight", "gravity_weight", "softness"):
            setattr(options, name, getattr(physics, name))
        options.contact_variance = physics.sigma_contact**2
        options.softness = max(options.softness, 1e-30)  # the paper's hinge, without a division by zero
        options.tolerance, options.max_step = config.tolerance, config.max_step
        if physics.gravity == "paper":
            options.paper, options.margin = 1, physics.contact_tolerance
        options.max_gradient = FAR if config.max_gradient is None else config.max_gradient
        options.smooth, options.newton, options.damping = int(smoothing is not None), int(lm), config.damping
        options.still_steps = LM_STILL_STEPS if lm else STILL_STEPS
        # the paper's gravity pulls from any height, but not towards nothing
        reach = torch.full_like(prior.reach, FAR / 2) if physics.gravity == "paper" else prior.reach
        self._tensor["reach"].copy_(reach)
        self.step = torch.zeros(self.n, 6, dtype=self.dtype, device=self.device)
        self._options = options
        self._commands = self._record(self._launches(options))

    @staticmethod
    def margin(config: RefinerConfig, prior: PosePrior) -> float:
        """Bodies farther apart than this [m] have nothing to do with each other for some steps."""
        reach = float(prior.reach.max()) if len(prior.reach) and config.physics.gravity != "paper" else 0.0
        return max(reach, config.physics.contact_tolerance) + 2.01 * LOOK_AROUND * config.max_step

    @staticmethod
    def fits(config: RefinerConfig, scene: Scene) -> bool:
        """Whether the kernels know this cost.

        They know the paper's gravity above planes only, not above static bodies, and not its curvature.
        """
        physics = config.physics
        known = physics.smoothing.kind in ("ring", "gaussian", "none")
        if physics.gravity == "paper":
            known = known and config.solver == "descent" and len(scene.entity_image) == len(scene)
        return known

    @property
    def gradient(self) -> Tensor:
        """(N, 6) of the total cost with respect to steps in units of the scale; 0 for finished images."""
        return self._tensor["gradient"]

    @property
    def done(self) -> Tensor:
        """(I,) bool."""
        return self._tensor["done"].bool()

    @property
    def steps(self) -> Tensor:
        """(I,) long."""
        return self._tensor["steps"].long()

    def terms(self, rows: Tensor) -> PhysicsTerms:
        """Costs of the objects ``rows`` at the poses of the last evaluation."""
        pose, collision, share, gravity = (self._tensor[k][rows] for k in ("pose", "collision", "share", "gravity"))
        w = self._physics
        total = w.pose_weight * pose + w.collision_weight * share + w.gravity_weight * gravity
        return PhysicsTerms(pose, collision, gravity, total)

    def all_terms(self) -> PhysicsTerms:
        """Costs of all objects at the current poses; nothing is left to do then."""
        self._tensor["done"].zero_()
        self._tensor["still"].fill_(-1)
        self.evaluate(0)
        return self.terms(torch.arange(self.n, device=self.device))

    def settle(self, step: int) -> None:
        """Finish the images that have come to rest."""
        if self.n_images:
            self._commands["priors"].set_param_at_index(3, step)
        self._launch("priors")

    def evaluate(self, step: int) -> None:
        """Costs and gradient at the current poses; images that have come to rest are finished first."""
        if self._scene.crowded and self._moves >= LOOK_AROUND:
            self._look_around(self._margin)
            self._commands, self._moves = self._record(self._launches(self._options)), 0
        self.settle(step)
        self._launch("boxes", "planes")
        self._launch_rows()
        self._launch("objects")

    def newton(self, fraction: float = 1.0) -> None:
        """Set :attr:`step` to a fraction of the damped Gauss-Newton step."""
        if "newton" in self._commands:
            self._commands["newton"].set_param_at_index(4, fraction)
            self._commands["newton"].launch()

    def move(self) -> None:
        """Move the objects by :attr:`step`, which is zero again then."""
        self._launch("move")
        self._moves += 1

    def measure(self, *, reach: float) -> Measured:
        """Look at the poses as they are, for supports down to ``reach`` [m]. Nothing is left to do then."""
        if self._scene.crowded:
            self._look_around(reach)
        return super().measure(reach=reach)

    def _launches(self, options: Any) -> dict[str, tuple[Any, int, list]]:
        k, state, world, parts, wobble = self._k, self._state, self._world, self._parts, self._wobble
        prior, step = self._prior, wrap(self.step, k.vec6)
        return super()._launches(options) | {
            "priors": (k.priors, self.n_images, [world, prior, state, 0, options]),
            "objects": (k.objects, self.n, [parts, world, prior, state, options, wobble]),
            "newton": (k.newton, self.n, [world, prior, state, options, 1.0, step]),
            "move": (k.move, self.n, [world, prior, state, options, step]),
        }
