"""Pictures and a viewer of poses: everything is drawn by `physpose_torch.render`, without GL and without a display.

Names are loaded on first use; matplotlib, pillow, OpenCV and viser only where something is drawn with them.
"""

from importlib import import_module

_HOME = {
    "before_after_picture": "before_after",
    "overlay_picture": "overlay",
    "Animation": "animation",
    "trajectory_animation": "animation",
    "Ellipsoids": "ellipsoids",
    "pose_ellipsoids": "ellipsoids",
    "PoseViewer": "viewer",
    "ViewedImage": "viewed",
    "serve": "viewer",
}

__all__ = [*_HOME]


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'physpose_torch.viz' has no attribute {name!r}")
    value = getattr(import_module(f"physpose_torch.viz.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
