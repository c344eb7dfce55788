"""Makes a small BOP folder on the spot: a plain box (1), one declared round (4), one of twofold symmetry (9)."""

import json

import numpy as np
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

OBJECTS = {
    1: ([60.0, 40.0, 100.0], {}),
    4: ([80.0, 80.0, 30.0], {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}),
    9: ([50.0, 90.0, 70.0], {"symmetries_discrete": [[-1, 0, 0, 4.0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}),
}
K = [600.0, 0, 330.0, 0, 610.0, 236.0, 0, 0, 1]
TILT = np.deg2rad(40)
UP = np.array([0.0, -np.cos(TILT), -np.sin(TILT)])
OFFSET_MM = -400.0


def standing(x, y, height):
    """T_camera_object [mm] of an object at (x, y) on the table, its origin at a height."""
    X = np.array([1.0, 0, 0])
    T = np.eye(4)
    T[:3, :3] = np.stack([X, np.cross(UP, X), UP], axis=1)
    T[:3, 3] = T[:3, :3] @ [x, y, height] + UP * OFFSET_MM + [0, 0, 600]
    T[:3, 3] += UP * (OFFSET_MM + height - T[:3, 3] @ UP)
    return T


def random_pose(rng):
    """T_camera_object (4, 4) in millimetres."""
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    T[:3, 3] = rng.uniform([-200, -150, 600], [200, 150, 1200])
    return T


def write_mesh(path, extents):
    mesh = trimesh.creation.box(extents=extents).subdivide().subdivide()
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)


def write_scene(split, scene_id, images, *, visib=True, width=None):
    """`images`: {im_id: [(obj_id, T in mm, visib_fract), ...]}."""
    folder = split / f"{scene_id:06d}"
    folder.mkdir(parents=True)
    camera = {str(im): {"cam_K": K, "depth_scale": 0.1} for im in images}
    gt = {
        str(im): [
            {"obj_id": obj, "cam_R_m2c": T[:3, :3].flatten().tolist(), "cam_t_m2c": T[:3, 3].tolist()}
            for obj, T, _ in instances
        ]
        for im, instances in images.items()
    }
    info = {str(im): [{"visib_fract": fraction} for *_, fraction in instances] for im, instances in images.items()}
    (folder / "scene_camera.json").write_text(json.dumps(camera))
    (folder / "scene_gt.json").write_text(json.dumps(gt))
    if visib:
        (folder / "scene_gt_info.json").write_text(json.dumps(info))
    if width:
        (split.parent / "camera.json").write_text(json.dumps({"width": width, "height": 480}))
    return folder


def write_depth(folder, im_id, depth, *, scale=0.1):
    """`depth`: (H, W) [m], 0 where unknown; to the next `scale` mm. `folder`: the scene's."""
    path = folder / "depth" / f"{im_id:06d}.png"
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.round(np.asarray(depth) * 1000 / scale).astype(np.uint16)).save(path)
    return path


def write_models(folder, *, info=True):
    for obj_id, (extents, _) in OBJECTS.items():
        write_mesh(folder / f"obj_{obj_id:06d}.ply", extents)
    if info:
        content = {str(i): {"diameter": float(np.linalg.norm(e)), **symmetry} for i, (e, symmetry) in OBJECTS.items()}
        (folder / "models_info.json").write_text(json.dumps(content))


def csv_row(scene, im, obj, score, T, time=0.5):
    R = " ".join(map(repr, T[:3, :3].flatten().tolist()))
    t = " ".join(map(repr, T[:3, 3].tolist()))
    return f"{scene},{im},{obj},{score},{R},{t},{time}"


HEADER = "scene_id,im_id,obj_id,score,R,t,time"


def metres(T):
    T = torch.tensor(np.asarray(T), dtype=torch.float64).clone()
    T[..., :3, 3] /= 1000
    return T
