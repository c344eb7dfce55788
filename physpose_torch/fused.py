"""The cost and its gradient for all images in a few kernel launches: what the descent evaluates where Warp is at hand."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from physpose_torch.config import RefinerConfig
from physpose_torch.distance.warp import REAL, fill, load, parts_struct, ready, wobble_struct, wrap
from physpose_torch.fused_kernels import cost_kernels
from physpose_torch.losses import PhysicsTerms
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene

__all__ = ["FusedCost"]

FAR = 1e30


class FusedCost:
    """State of a refinement in flight, in place in torch tensors.

    Finished images cost nothing: every kernel leaves them out, so the batch is never rebuilt and the host need not know.

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
        self.n, self.n_images = len(scene), scene.n_images
        self.device, self.dtype = poses.device, poses.dtype
        ready(self.dtype, self.device)
        self._k = cost_kernels(REAL[self.dtype])
        load(self._k.module, self.device)
        physics = self._physics = config.physics
        smoothing = None if physics.smoothing.kind == "none" else physics.smoothing
        self._parts = parts_struct(scene.parts, self.dtype, self.device)
        self._wobble = wobble_struct(smoothing, self.dtype, self.device)
        self._world = self._make_world(scene, acts)
        self._prior = self._make_prior(prior, scale)
        options = self._k.Options()
        for name in ("pose_weight", "collision_weight", "gravity_weight", "softness"):
            setattr(options, name, getattr(physics, name))
        options.softness = max(options.softness, 1e-30)  # the paper's hinge, without a division by zero
        options.reach, options.tolerance, options.max_step = physics.gravity_reach, config.tolerance, config.max_step
        options.max_gradient = FAR if config.max_gradient is None else config.max_gradient
        options.smooth = int(smoothing is not None)
        self._state = self._make_state(scene, poses)
        self.step = torch.zeros(self.n, 6, dtype=self.dtype, device=self.device)
        self._commands = self._record(options)

    @staticmethod
    def fits(config: RefinerConfig) -> bool:
        """Whether the kernels know this cost."""
        physics = config.physics
        return physics.gravity == "support" and physics.smoothing.kind in ("ring", "gaussian", "none")

    @property
    def poses(self) -> Tensor:
        """(N, 4, 4) now."""
        return self._tensor["poses"][: self.n]

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

    def evaluate(self, step: int) -> None:
        """Costs and gradient at the current poses; images that have come to rest are finished first."""
        if self.n_images:
            self._commands["priors"].set_param_at_index(3, step)
        for name in ("boxes", "priors", "planes", "rows", "objects"):
            if name in self._commands:
                self._commands[name].launch()

    def move(self) -> None:
        """Move the objects by :attr:`step`, which is zero again then."""
        self._commands["move"].launch()

    def _record(self, options: Any) -> dict[str, Any]:
        k, state, world, parts, wobble = self._k, self._state, self._world, self._parts, self._wobble
        n_entities, n_rows = len(self._tensor["moved"]), len(self._tensor["clear"])
        launches = {
            "boxes": (k.boxes, n_entities, [parts, world, state]),
            "priors": (k.priors, self.n_images, [world, self._prior, state, 0, options.tolerance]),
            "planes": (k.planes, self.n, [parts, world, state, options, wobble]),
            "rows": (k.rows, n_rows, [parts, world, state, options, wobble]),
            "objects": (k.objects, self.n, [parts, world, self._prior, state, options, wobble]),
            "move": (k.move, self.n, [world, self._prior, state, options, wrap(self.step, k.vec6)]),
        }
        device = wp.device_from_torch(self.device)
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if self.device.type == "cuda" else None
        return {
            name: wp.launch(kernel, dim=count, inputs=inputs, device=device, stream=stream, record_cmd=True)
            for name, (kernel, count, inputs) in launches.items()
            if count
        }

    def _make_world(self, scene: Scene, acts: Tensor) -> Any:
        k, n = self._k, self.n
        count = torch.bincount(scene.image, minlength=scene.n_images)
        first, second = scene.entity_pairs.unbind(1)
        felt = (second >= n) | acts[first] | acts[second.clamp_max(max(n - 1, 0))] if n else second >= n
        first, second = first[felt], second[felt]
        rows = scene.instance_start.diff()[first]
        pair = torch.arange(len(first))
        row_pair = torch.repeat_interleave(pair, rows)
        start = _starts(rows)
        slots = scene.instance_start.diff()[second[row_pair]]
        movable = second < n
        ends, sides = torch.cat([first, second[movable]]), torch.cat([pair, pair[movable]])
        planes = scene.plane_pairs
        length = torch.linalg.vector_norm(scene.parts.padded, dim=-1).amax(1) if scene.parts.n_parts else torch.zeros(0)
        span = torch.zeros(len(scene.entity_image), dtype=torch.float64)
        span = span.scatter_reduce(0, scene.instance_entity, length[scene.instance_part].double(), "amax")
        falls = (scene.gravity != 0).any(-1) & scene.has_static
        world = k.World()
        world.n_objects = n
        return fill(
            world,
            {
                "image": (scene.entity_image, None),
                "instance_start": (scene.instance_start, None),
                "instance_part": (scene.instance_part, None),
                "gravity": (scene.gravity, k.vec3),
                "falls": (falls.long(), None),
                "acts": (acts.long(), None),
                "image_start": (_starts(count), None),
                "image_object": (torch.argsort(scene.image, stable=True), None),
                "pair_first": (first, None),
                "pair_second": (second, None),
                "pair_row": (start, None),
                "row_pair": (row_pair, None),
                "row_instance": (
                    scene.instance_start[first[row_pair]] + torch.arange(len(row_pair)) - start[row_pair],
                    None,
                ),
                "row_slot": (_starts(slots), None),
                "object_pair_start": (_starts(torch.bincount(ends, minlength=n)), None),
                "object_pair": (sides[torch.argsort(ends, stable=True)], None),
                "object_plane_start": (_starts(torch.bincount(planes[:, 0], minlength=n)), None),
                "object_plane": (planes[torch.argsort(planes[:, 0], stable=True), 1], None),
                "plane_normal": (scene.plane_normal, k.vec3),
                "plane_offset": (scene.plane_offset, None),
                "plane_covariance": (scene.plane_covariance, k.mat33),
                "center": (scene.object_center, k.vec3),
                "radius": (scene.object_radius, None),
                "span": (span, None),
            },
            self.dtype,
            self.device,
        )

    def _make_prior(self, prior: PosePrior, scale: Tensor) -> Any:
        k = self._k
        toward = (prior.precision[:, :3] * prior.ray[:, :, None]).sum(1)
        out = k.Prior()
        out.sigma_common = prior.sigma_common
        out.robust = 0.0 if prior.robust == float("inf") else prior.robust
        return fill(
            out,
            {
                "measured": (prior.measured, k.mat44),
                "precision": (prior.precision.reshape(-1, 6), k.vec6),
                "ray": (prior.ray, k.vec3),
                "toward": (toward, k.vec6),
                "curvature": ((toward[:, :3] * prior.ray).sum(1), None),
                "scale": (scale.reshape(-1, 6), k.vec6),
            },
            self.dtype,
            self.device,
        )

    def _make_state(self, scene: Scene, poses: Tensor) -> Any:
        k, n, images = self._k, self.n, scene.n_images
        entities, instances = len(scene.entity_image), len(scene.instance_entity)
        rows, slots = len(self._world._tensors["row_pair"]), int(self._world._tensors["row_slot"][-1])
        real = {"dtype": self.dtype, "device": self.device}
        whole = {"dtype": torch.int32, "device": self.device}
        empty = torch.bincount(scene.image, minlength=images) == 0  # nothing to do
        shapes = {
            **dict.fromkeys(("lower", "upper"), (instances, 3)),
            **dict.fromkeys(("entity_lower", "entity_upper"), (entities, 3)),
            "moved": (entities,),
            "middle": (images, 3),
            **dict.fromkeys(("farthest", "pose", "plane_cost", "plane_height", "collision", "share", "gravity"), (n,)),
            **dict.fromkeys(("pose_gradient", "plane_gradient", "gradient"), (n, 6)),
            **dict.fromkeys(("row_cost", "row_drop_a", "row_drop_b"), (rows,)),
            **dict.fromkeys(("row_force", "row_torque_a", "row_torque_b"), (rows, 3)),
        }
        counters = {
            "still": images,
            **dict.fromkeys(("plane_best", "plane_instance"), n),
            **dict.fromkeys(("row_count", "row_onto_a", "row_onto_b"), rows),
        }
        self._tensor = {name: torch.zeros(shape, **real) for name, shape in shapes.items()}
        self._tensor |= {name: torch.zeros(size, **whole) for name, size in counters.items()}
        self._tensor["poses"] = scene.entity_poses(poses).detach().to(**real).clone().contiguous()
        self._tensor["clear"] = torch.full((rows,), -FAR, **real)
        self._tensor["slot_clear"] = torch.full((slots,), -FAR, **real)
        self._tensor["slot_normal"] = torch.zeros(slots, 3, **real)
        self._tensor["done"] = empty.to(**whole)
        self._tensor["steps"] = torch.zeros(images, **whole)
        kinds = {3: k.vec3, 6: k.vec6}
        state = k.State()
        for name, tensor in self._tensor.items():
            kind = k.mat44 if name == "poses" else kinds[tensor.shape[1]] if tensor.ndim == 2 else None
            setattr(state, name, wrap(tensor, kind))
        return state


def _starts(count: Tensor) -> Tensor:
    return torch.cat([count.new_zeros(1), count.cumsum(0)])
