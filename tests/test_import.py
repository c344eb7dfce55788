"""What importing costs: the package itself nothing, its public names no picture, network or GPU library."""

import json
import subprocess
import sys

import pytest

import physpose_torch

# PIL, embreex and tqdm come with trimesh and torch
HEAVY = {"coacd", "cv2", "matplotlib", "mujoco", "onnx", "onnxruntime", "ray", "tyro", "viser", "warp"}
HEAVY |= {"pytorch_kinematics", "urdf_parser_py"}


def loaded_after(code: str) -> set[str]:
    program = f"{code}\nimport json, sys; print(json.dumps(sorted({{m.split('.')[0] for m in sys.modules}})))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    return set(json.loads(run.stdout.splitlines()[-1]))


def test_importing_the_package_loads_nothing_but_python():
    assert not loaded_after("import physpose_torch; physpose_torch.__version__; dir(physpose_torch)") & (
        HEAVY | {"torch", "numpy", "scipy", "trimesh", "kornia", "fcl"}
    )


def test_the_public_names_pull_no_heavy_library():
    names = [name for name in physpose_torch.__all__ if name != "__version__"]
    assert not loaded_after(f"from physpose_torch import {', '.join(names)}") & HEAVY


@pytest.mark.parametrize("name", physpose_torch.__all__)
def test_every_public_name_is_where_it_says(name):
    value = getattr(physpose_torch, name)
    if hasattr(value, "__module__"):
        assert value.__module__.startswith("physpose_torch.")
        assert value.__name__ == name


def test_the_names_of_the_design_are_public():
    promised = (
        "Body Plane Static Scene ConvexParts signed_distance plane_distance drop_distance PhysicsConfig RefinerConfig "
        "Smoothing PhysicsLoss PhysicsTerms PhysPoseRefiner Refinement PhysicsReport physics_report PhysPoseError"
    )
    assert set(promised.split()) <= set(physpose_torch.__all__) <= set(dir(physpose_torch))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="Refinerr"):
        physpose_torch.Refinerr  # noqa: B018


@pytest.mark.parametrize(
    ("error", "builtin"),
    [
        ("InvalidInputError", ValueError),
        ("DataError", ValueError),
        ("UnknownLabelError", KeyError),
        ("MissingExtraError", ImportError),
        ("BackendError", RuntimeError),
    ],
)
def test_every_error_is_also_the_builtin_one_expects(error, builtin):
    kind = getattr(physpose_torch, error)
    assert issubclass(kind, builtin)
    assert issubclass(kind, physpose_torch.PhysPoseError)
    assert str(kind("plain words")) == "plain words"
