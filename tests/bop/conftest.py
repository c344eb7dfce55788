"""A small BOP folder, a writer of result files, and the real data if it is there."""

import json

import numpy as np
import pytest
from bop_files import HEADER, random_pose, write_models, write_scene


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def bop_folder(tmp_path, rng):
    """Scenes 2 and 11, images with gaps, up to three instances of one object; targets listed."""
    root = tmp_path / "toy"
    write_models(root / "models")
    targets = []
    for scene_id in (2, 11):
        images = {}
        for im_id in (3, 40):
            images[im_id] = [
                (obj, random_pose(rng), float(rng.uniform(0.2, 1))) for obj in (1, 1, 4, 9, 9, 9)[: 6 - (im_id == 40)]
            ]
            counts = {1: 2, 4: 1, 9: 2}
            targets += [{"scene_id": scene_id, "im_id": im_id, "obj_id": o, "inst_count": c} for o, c in counts.items()]
        write_scene(root / "test", scene_id, images, width=720)
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    return root


@pytest.fixture
def write_csv(tmp_path):
    def write(*rows, name="est.csv", header=True):
        path = tmp_path / name
        path.write_text("\n".join(([HEADER] if header else []) + list(rows)) + "\n")
        return path

    return write
