"""The cost and its gradient for all images as Warp kernels. Importing it imports Warp, so only those who use it do."""

from physpose_torch.fused.cost import FusedCost, FusedMeasure, Measured, remembers

__all__ = ["FusedCost", "FusedMeasure", "Measured", "remembers"]
