"""The cost of losses.py and its gradient as Warp kernels: a few launches a step for all images, nothing on the host.

``boxes`` → ``priors`` → ``planes`` → ``rows`` → ``objects``, then ``move``. A row is a part of the first body of a pair of
bodies against all parts of the second: rows are fixed with the scene, so nothing is allocated, and every sum has its order.
"""

import functools
from types import SimpleNamespace

from physpose_torch.fused.boxes import boxes
from physpose_torch.fused.contact import contact
from physpose_torch.fused.objects import objects
from physpose_torch.fused.planes import planes
from physpose_torch.fused.prior import prior
from physpose_torch.fused.step import step
from physpose_torch.fused.world import world

__all__ = ["cost_kernels"]


@functools.cache
def cost_kernels(real: type) -> SimpleNamespace:
    """Structs and kernels in ``wp.float32`` or ``wp.float64``."""
    out = SimpleNamespace()
    for factory in (world, boxes, prior, planes, contact, step, objects):
        vars(out).update(vars(factory(real)))
    return out
