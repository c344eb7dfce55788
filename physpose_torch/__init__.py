"""PhysPose for PyTorch: refine 6D object poses so that objects neither sink, nor overlap, nor float.

Poses are ``T_camera_object`` in an OpenCV camera (x right, y down, z forward), metres and radians.
"""

from importlib import import_module

_HOMES = {
    "errors": [
        "BackendError",
        "DataError",
        "InvalidInputError",
        "MissingExtraError",
        "PhysPoseError",
        "TableNotFoundError",
        "UnknownLabelError",
    ],
    "config": ["Calibration", "Caution", "PhysicsConfig", "RefinerConfig", "Smoothing", "TableConfig"],
    "geometry.convex": ["ConvexParts"],
    "geometry.decompose": ["DecomposeOptions"],
    "geometry.body": ["Body", "Plane"],
    "distance.support": ["DistanceResult"],
    "distance.plane": ["plane_distance"],
    "distance.autograd": ["drop_distance", "signed_distance"],
    "scene": ["Scene", "Static"],
    "alternatives": ["find_alternatives"],
    "losses": ["PhysicsLoss", "PhysicsTerms", "collision_loss", "gravity_loss", "pose_covariance", "pose_loss"],
    "report": ["PhysicsReport", "physics_report"],
    "refiner": ["PhysPoseRefiner", "Refinement"],
    "robot.environment": ["RobotEnvironment", "RobotState"],
    "table.view": ["View"],
    "table.estimator": ["TableEstimate", "TableEstimator"],
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__version__ = "0.1.0"
__all__ = ["__version__", *_HOME]


def __getattr__(name: str):
    """Public names are loaded when they are first used (PEP 562), so that importing the package costs next to nothing."""
    if name not in _HOME:
        raise AttributeError(f"module 'physpose_torch' has no attribute {name!r}")
    value = getattr(import_module(f"physpose_torch.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
