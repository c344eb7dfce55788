"""Damped Gauss-Newton (Levenberg-Marquardt) on the physics cost: a few steps do what takes a descent many."""

from collections.abc import Callable

from torch import Tensor

from physpose_torch.config import RefinerConfig
from physpose_torch.losses import PhysicsTerms
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene
from physpose_torch.solvers.descent import Descent, iterate, start

__all__ = ["levenberg_marquardt"]


def levenberg_marquardt(
    prior: PosePrior,
    scene: Scene,
    acts: Tensor,
    config: RefinerConfig,
    callback: Callable[[int, Tensor, PhysicsTerms], None] | None = None,
) -> Descent:
    """Minimise the cost from the measured poses; arguments as in :func:`physpose_torch.solvers.descent.descend`.

    Each object's curvature is a block of its own: robust costs and hinges count with the quadratics that touch them from
    above (iteratively reweighted least squares), and where both bodies of a contact move, (x + y)² ≤ 2x² + 2y² keeps
    their blocks apart. The depth factor that the estimates of an image share joins the blocks, and is solved for with
    them. A fixed damping, and a fraction of each step, keep what the blocks do not know in check: contacts that come and
    go, and the turning of smoothed contact points.
    """
    cost = start(prior, scene, acts, config)
    return iterate(cost, lambda: cost.newton(config.learning_rate), prior, scene, config, callback)
