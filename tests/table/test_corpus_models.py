"""Models and manifests of a user, broken: refused, or what they say is finite; weights come from the manifest's folder only.

The slow variant prints what came of how many: ``pytest -m slow -s tests/table/test_corpus_models.py``.
"""

import collections
import json
import os
import random

import numpy as np
import pytest
import torch
from corpus import HUGE, mutated, mutated_json

from physpose_torch.errors import DataError, PhysPoseError
from physpose_torch.table.manifest import ROLES
from physpose_torch.table.onnx import load_models
from physpose_torch.table.roles import Features

onnx = pytest.importorskip("onnx", reason="the test's graphs are made with onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

FEW = pytest.param(40, id="few")
MANY = pytest.param(3000, id="many", marks=pytest.mark.slow)
IMAGE = torch.randint(0, 256, (32, 40, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
FEATURES = Features(torch.rand(5, 2).double(), torch.rand(5, 4), torch.ones(5), torch.ones(5))
ASKED = {
    "extractor": lambda model: model(IMAGE),
    "matcher": lambda model: model(FEATURES, FEATURES),
    "pair_matcher": lambda model: model(IMAGE, IMAGE),
    "reconstructor": lambda model: model(IMAGE, IMAGE),
    "detector": lambda model: model(IMAGE, "table"),
}
SAYS = {
    "keypoints": np.ones((5, 2)),
    "descriptors": np.ones((5, 4)),
    "matches": np.zeros((3, 2)),
    "points_0": np.ones((5, 2)),
    "points_1": np.ones((5, 2)),
    "boxes": np.ones((5, 4)),
    "scores": np.ones(5),
}


def says(role, **changed):
    """A graph that reads its inputs and says the same whatever they are, and its entry in a manifest."""
    inputs, outputs = ({name: f"{name}_" for name in sorted(names)} for names in ROLES[role])
    if role == "extractor":
        outputs["scores"] = "scores_"
    values = {name: changed.get(name, SAYS[name].astype(np.float32)) for name in outputs}
    if role == "matcher":
        values["scores"] = changed.get("scores", np.ones(3, np.float32))
    nodes = [helper.make_node("Shape", [x], [f"{x}s"]) for x in inputs.values()]
    constants = [numpy_helper.from_array(v, f"{name}c") for name, v in values.items()]
    nodes += [helper.make_node("Identity", [f"{name}c"], [f"{name}_"]) for name in values]
    tensors = [helper.make_tensor_value_info(x, TensorProto.FLOAT, None) for x in inputs.values()]
    results = [
        helper.make_tensor_value_info(f"{n}_", helper.np_dtype_to_tensor_dtype(v.dtype), None) for n, v in values.items()
    ]
    graph = helper.make_graph(nodes, "says", tensors, results, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    entry = {"name": role, "role": role, "file": "m.onnx", "inputs": inputs, "outputs": outputs, "channels": 1}
    return model, entry | ({"prompt": "table"} if role == "detector" else {})


def write(folder, model, entry):
    """The manifest's path."""
    (folder / "m.onnx").write_bytes(model if isinstance(model, bytes) else model.SerializeToString())
    path = folder / "manifest.json"
    path.write_text(json.dumps({"models": [entry]}))
    return path


def numbers(answer):
    return [value for value in answer if isinstance(value, torch.Tensor)]


ROLES_OF_ROWS = ["extractor", "matcher", "pair_matcher", "detector"]


@pytest.mark.parametrize("role", ROLES_OF_ROWS)
def test_the_model_is_good_before_it_is_broken(tmp_path, role):
    model = load_models(write(tmp_path, *says(role)))[role]
    assert all(len(value) in (3, 5) and value.isfinite().all() for value in numbers(ASKED[role](model)))


@pytest.mark.parametrize("role", ROLES_OF_ROWS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_rows_that_are_no_numbers_are_left_out(tmp_path, role, value):
    """Of each output in turn; a pair of keypoints that is none is refused."""
    for name in sorted(ROLES[role][1]):
        count = 3 if role == "matcher" else 5
        broken = np.resize(SAYS[name], (count, *SAYS[name].shape[1:])).astype(np.float32)
        broken[1] = value
        path = write(tmp_path, *says(role, **{name: broken}))
        if name == "matches":
            with pytest.raises(DataError, match="beyond the keypoints"):
                ASKED[role](load_models(path)[role])
            continue
        answer = numbers(ASKED[role](load_models(path)[role]))
        assert all(v.isfinite().all() for v in answer), name
        assert {len(v) for v in answer} <= {count - 1, count}


@pytest.mark.parametrize("role", ROLES_OF_ROWS)
@pytest.mark.parametrize("dtype", [np.int64, np.int8, np.uint8, np.float64, np.float16, bool])
def test_outputs_of_other_types_are_read_or_refused(tmp_path, role, dtype):
    values = {name: value.astype(dtype) for name, value in SAYS.items()}
    path = write(tmp_path, *says(role, **values | ({"scores": np.ones(3, dtype)} if role == "matcher" else {})))
    answer = numbers(ASKED[role](load_models(path)[role]))
    assert all(v.isfinite().all() for v in answer)


@pytest.mark.parametrize("role", ROLES_OF_ROWS)
@pytest.mark.parametrize("shape", [(), (0,), (5,), (0, 2), (5, 3), (1, 1, 1), (2, 5, 2)])
def test_outputs_of_other_shapes_are_read_or_refused(tmp_path, role, shape):
    for name in ROLES[role][1]:
        path = write(tmp_path, *says(role, **{name: np.zeros(shape, np.float32)}))
        try:
            answer = numbers(ASKED[role](load_models(path)[role]))
        except DataError as error:
            assert "m.onnx" in str(error)  # noqa: PT017
        else:
            assert all(v.isfinite().all() for v in answer)


def broken_graph(model, seed):
    """Well-formed, but with other sizes, types, operators or names in a few places."""
    rng = random.Random(seed)
    model = type(model).FromString(model.SerializeToString())
    graph = model.graph
    for _ in range(rng.choice([1, 1, 2, 4])):
        tensor, node = rng.choice(graph.initializer), rng.choice(graph.node)
        change = rng.randrange(9)
        if change == 0:
            del tensor.dims[:]
            tensor.dims.extend(rng.choice([[], [-1], [0], [2**40], [2**62, 2**62], [3, -3], [10] * 9]))
        elif change == 1:
            tensor.data_type = rng.randrange(25)
        elif change == 2:
            tensor.raw_data = rng.choice([b"", tensor.raw_data[:-1], tensor.raw_data * 3])
        elif change == 3:
            node.op_type = rng.choice(["Loop", "If", "ConstantOfShape", "Reshape", "Conv", "NoSuch", "Add", "Softmax"])
        elif change == 4:
            node.input[0] = rng.choice(["", "none", *(n.output[0] for n in graph.node), *(t.name for t in graph.initializer)])
        elif change == 5:
            node.output[0] = rng.choice(["", "none", *(n.output[0] for n in graph.node)])
        elif change == 6:
            node.domain = rng.choice(["com.microsoft", "nowhere", "\0"])
        elif change == 7:
            graph.output[0].type.tensor_type.elem_type = rng.randrange(25)
        else:
            model.opset_import[0].version = rng.choice([-1, 0, 1, 99, 2**62])
    return model.SerializeToString()


@pytest.mark.parametrize("count", [FEW, MANY])
@pytest.mark.parametrize("kind", ["bytes", "graph"])
@pytest.mark.parametrize("role", ["pair_matcher", "extractor"])
def test_broken_models_are_refused_or_finite(tmp_path, role, kind, count, capsys):
    model, entry = says(role)
    whole, outcomes = model.SerializeToString(), collections.Counter()
    for seed in range(count):
        broken = mutated(whole, seed) if kind == "bytes" else broken_graph(model, seed)
        try:
            answer = numbers(ASKED[role](load_models(write(tmp_path, broken, entry))[role]))
            assert all(v.isfinite().all() for v in answer), f"seed {seed}"
            outcomes["ran"] += 1
        except PhysPoseError:
            outcomes["refused"] += 1
    with capsys.disabled():
        if count > 100:
            print(f"\n{role}, {kind}: {count} broken models: {dict(outcomes)}")


@pytest.mark.parametrize("count", [FEW, MANY])
def test_broken_manifests_are_refused_or_read(tmp_path, count, capsys):
    model, entry = says("pair_matcher")
    path = write(tmp_path, model, entry | {"size": [40, 32], "mean": [0.5], "std": [0.5], "multiple_of": 8, "threshold": 0.1})
    whole, outcomes = path.read_bytes(), collections.Counter()
    for seed in range(count):
        path.write_bytes(mutated(whole, seed) if seed % 4 == 3 else mutated_json(whole, seed))
        try:
            load_models(path)
            outcomes["read"] += 1
        except PhysPoseError:
            outcomes["refused"] += 1
    with capsys.disabled():
        if count > 100:
            print(f"\n{count} broken manifests: {dict(outcomes)}")


@pytest.mark.parametrize(
    "change",
    [
        {"size": [10**9, 10**9]},
        {"multiple_of": 10**9},
        {"mean": [float("nan")]},
        {"std": [HUGE]},
        {"threshold": float("nan")},
        {"file": "x" * 300},
        {"file": "\0"},
        {"file": "loop"},
        {"file": "/dev/zero"},
        {"file": "."},
        {"sha256": "0" * 64},
    ],
    ids=lambda change: next(iter(change)),
)
def test_impossible_entries_are_refused(tmp_path, change):
    (tmp_path / "loop").symlink_to("loop")
    model, entry = says("pair_matcher")
    with pytest.raises(DataError, match=r"models\[0\]"):
        load_models(write(tmp_path, model, entry | change))


WEIGHTS = ["../secret", "a/../../secret", "link", "loop", "pipe", "/dev/zero", "", "missing", "x" * 5000]


@pytest.mark.parametrize("location", ["weights", *WEIGHTS])
def test_weights_outside_of_the_folder_are_not_read(tmp_path, location):
    folder = tmp_path / "models"
    folder.mkdir()
    for path in (folder / "weights", tmp_path / "secret"):
        np.full((5, 2), 7, np.float32).tofile(path)
    (folder / "link").symlink_to(tmp_path / "secret")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    model, entry = says("pair_matcher")
    tensor = next(t for t in model.graph.initializer if t.name == "points_0c")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "40")):
        tensor.external_data.add(key=key, value=value)
    found = load_models(write(folder, model, entry))["pair_matcher"]
    if location == "weights":
        assert found(IMAGE, IMAGE).points_0.tolist() == [[7, 7]] * 5
    else:
        with pytest.raises(DataError, match=r"m\.onnx is no ONNX model that can be run"):
            found(IMAGE, IMAGE)
