"""Generated image pairs with known tables, made once: they take seconds each."""

import math

import pytest

from physpose_torch.geometry.body import Body
from physpose_torch.household import perturb_like_estimator
from physpose_torch.photograph import household_pair
from physpose_torch.table.view import View


class Photographed:
    """A generated pair, bodies for it, and estimates as an estimator without bias would give them."""

    def __init__(self, seed: int, **options) -> None:
        self.pair = household_pair(seed, **options)
        self.bodies = [Body.from_hull(self.pair.meshes[name], label=name) for name in self.pair.names]
        self.estimates = [
            perturb_like_estimator(T, seed=100 * seed + view, depth_bias=0.0, depth_sigma=0.015)
            for view, T in enumerate(self.pair.T_camera_object)
        ]

    def view(self, index: int, **instead) -> View:
        given = {"image": self.pair.images[index], "K": self.pair.K, "poses": self.estimates[index], **instead}
        return View(**given)

    @property
    def views(self) -> list[View]:
        return [self.view(0), self.view(1)]

    def errors(self, plane) -> tuple[float, float]:
        """Angle [deg], and height at the middle of the objects [mm], of a plane against the table."""
        normal, offset = plane.normal.double(), plane.offset.double()
        cosine = float((normal @ self.pair.normal).clamp(-1, 1))
        middle = self.pair.T_camera_object[0][:, :3, 3].mean(0)
        foot = middle - (middle @ self.pair.normal - self.pair.offset) * self.pair.normal
        return math.degrees(math.acos(cosine)), 1e3 * float(foot @ normal - offset)


@pytest.fixture(scope="session")
def wood() -> Photographed:
    """Seven objects, two of them on others, on a table with grain."""
    return Photographed(0, table="wood")


@pytest.fixture(scope="session")
def plain() -> Photographed:
    """Four objects on a table without any texture."""
    return Photographed(1, table="plain", objects=4, stacked=False)
