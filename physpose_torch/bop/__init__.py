"""BOP datasets, result files and scores: the only place with millimetres."""

from physpose_torch.bop.dataset import MESH_SCALE, BopDataset, Camera, GroundTruth, symmetry_transforms
from physpose_torch.bop.formats import (
    Estimates,
    PlaneRecord,
    RowProblem,
    StaticRecord,
    Target,
    read_estimates,
    read_planes,
    read_statics,
    read_targets,
    write_estimates,
)
from physpose_torch.bop.metrics import Recall, Scores, VsdScore, evaluate
from physpose_torch.bop.pose_error import mspd, mssd
from physpose_torch.bop.residuals import Distribution, GroundTruthErrors, distribution, errors_against_gt

__all__ = [
    "MESH_SCALE",
    "BopDataset",
    "Camera",
    "Distribution",
    "Estimates",
    "GroundTruth",
    "GroundTruthErrors",
    "PlaneRecord",
    "Recall",
    "RowProblem",
    "Scores",
    "StaticRecord",
    "Target",
    "VsdScore",
    "distribution",
    "errors_against_gt",
    "evaluate",
    "mspd",
    "mssd",
    "read_estimates",
    "read_planes",
    "read_statics",
    "read_targets",
    "symmetry_transforms",
    "write_estimates",
]
