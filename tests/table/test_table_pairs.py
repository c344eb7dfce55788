"""Six rendered scenes that were made by others, with the estimates that came with them."""

import json
import os
from pathlib import Path

import pytest
import torch

from physpose_torch import TableConfig, TableEstimator, View
from physpose_torch.bop.table import load_models, read_image, read_scene

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def pairs() -> Path:
    root = Path(os.environ.get("PHYSPOSE_DATA", ""))
    if not (root / "table_pairs").is_dir() or not (root / "ycbv" / "models").is_dir():
        pytest.skip("PHYSPOSE_DATA does not point to a folder with table_pairs/ and ycbv/")
    return root / "table_pairs"


@pytest.mark.parametrize("number", range(6))
def test_the_table_is_found_to_half_a_degree_and_four_millimetres(pairs, number):
    folder = pairs / f"scene_{number:02d}"
    content = read_scene(folder / "scene.json")
    views = [View(read_image(folder / f"view{k}.png"), content.K, content.poses[k]) for k in (0, 1)]
    bodies = load_models(pairs.parent / "ycbv" / "models", content.obj_ids)
    estimate = TableEstimator(TableConfig(features="sift"))(views, bodies)
    truth = json.loads((folder / "scene.json").read_text())
    normal = torch.tensor(truth["plane_cam0"]["normal"], dtype=torch.float64)
    middle = torch.tensor([o["T_cam0_obj"] for o in truth["objects"]], dtype=torch.float64)[:, :3, 3].mean(0) / 1000
    foot = middle - (middle @ normal - truth["plane_cam0"]["offset_mm"] / 1000) * normal
    assert torch.rad2deg(torch.arccos((normal @ estimate.plane.normal).clamp(-1, 1))) < 0.5
    assert abs(float(foot @ estimate.plane.normal - estimate.plane.offset)) < 4e-3
    assert bool(estimate.standing.all())
    assert not estimate.warnings
