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
from physpose_torch.bop.metrics import GroundTruthErrors, Recall, Scores, errors_against_gt, evaluate, mspd, mssd

__all__ = [
    "MESH_SCALE",
    "BopDataset",
    "Camera",
    "Estimates",
    "GroundTruth",
    "GroundTruthErrors",
    "PlaneRecord",
    "Recall",
    "RowProblem",
    "Scores",
    "StaticRecord",
    "Target",
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
