"""The embedded scene: household objects on a table, estimates as an RGB estimator would give them, refined."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from physpose_torch.config import RefinerConfig
from physpose_torch.geometry.body import Body, Plane, load_mesh
from physpose_torch.geometry.decompose import decompose_many
from physpose_torch.household import HouseholdScene, household_meshes, household_scene, perturb_like_estimator
from physpose_torch.refiner import PhysPoseRefiner, Refinement
from physpose_torch.report import PhysicsReport, physics_report
from physpose_torch.scene import Scene

__all__ = ["Demo", "household_bodies", "run_demo"]


@dataclass(frozen=True, eq=False)
class Demo:
    """What the demo saw and did."""

    truth: HouseholdScene
    scene: Scene
    estimates: Tensor
    """(N, 4, 4) perturbed poses."""
    refinement: Refinement
    before: PhysicsReport
    seconds: float
    """Of the refinement alone."""

    @property
    def after(self) -> PhysicsReport:
        return self.refinement.report

    def errors(self, poses: Tensor) -> Tensor:
        """(N,) distance of each object's centre from the truth [m]."""
        return torch.linalg.vector_norm((poses - self.truth.T_camera_object)[:, :3, 3], dim=1)

    def picture(self, path: Path | str | None = None):
        """Before and after, from the camera and from the side (a PIL image)."""
        from physpose_torch.viz import before_after_picture

        captions = [
            f"deepest penetration {1e3 * float(r.penetration.max()):.1f} mm, largest gap {1e3 * _largest(r.gap):.1f} mm"
            for r in (self.before, self.after)
        ]
        meshes = household_meshes()
        return before_after_picture(
            [meshes[n] for n in self.truth.names],
            self.estimates,
            self.refinement.poses,
            plane=(self.truth.normal, self.truth.offset),
            K=self.truth.K,
            height=self.truth.height,
            width=self.truth.width,
            titles=("estimated poses", "refined"),
            captions=captions,
            path=path,
        )


def household_bodies(*, on_body: Callable[[str], None] = lambda name: None) -> dict[str, Body]:
    """Bodies of the generated household meshes; decomposed once, on all cores, then from the cache."""
    meshes = household_meshes()
    for name, _ in decompose_many({k: load_mesh(m, label=k) for k, m in meshes.items()}):
        on_body(name)
    return {name: Body.from_mesh(mesh, label=name) for name, mesh in meshes.items()}


def run_demo(
    *, seed: int = 1, config: RefinerConfig | None = None, on_body: Callable[[str], None] = lambda name: None
) -> Demo:
    """Build the scene, perturb it, refine it.

    Args:
        seed: of the arrangement and of the perturbation.
        config: refiner options; None: the default preset.
        on_body: called with the name of each body that is ready.
    """
    import time

    bodies = household_bodies(on_body=on_body)
    truth = household_scene(seed)
    scene = Scene.tabletop(
        [bodies[n] for n in truth.names], Plane(truth.normal, torch.tensor(truth.offset, dtype=torch.float64))
    )
    estimates = perturb_like_estimator(truth.T_camera_object, seed=seed)
    before = physics_report(estimates, scene)
    start = time.perf_counter()
    refinement = PhysPoseRefiner(config)(estimates, scene)
    return Demo(truth, scene, estimates, refinement, before, time.perf_counter() - start)


def _largest(gap: Tensor) -> float:
    finite = gap[gap.isfinite()]
    return float(finite.max()) if len(finite) else 0.0
