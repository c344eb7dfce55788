"""Meshes that no estimator should meet: headers that declare gigabytes, files that refer to what is outside, surfaces that are
none, and a million faces. A body, or an error that names the file; with bounded time and memory.

The slow variants print what came of how many: ``pytest -m slow -s tests/test_corpus_meshes.py``.
"""

import collections
import json
import os
import resource
import struct
import subprocess
import sys
import warnings

import numpy as np
import pytest
import trimesh
from corpus import mutated
from PIL import Image

from physpose_torch.__main__ import main
from physpose_torch.errors import DataError, PhysPoseError
from physpose_torch.geometry.body import Body
from physpose_torch.geometry.decompose import DecomposeOptions

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="links and pipes of Linux")
XYZ = "property float x\nproperty float y\nproperty float z\n"
TRIANGLES = "property list uchar int vertex_indices\n"


def ply(head, body=bytes(500), form="binary_little_endian"):
    return f"ply\nformat {form} 1.0\n{head}end_header\n".encode() + body


def gltf(**buffer):
    """One triangle, of a buffer."""
    views = {"bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36, **buffer}]}
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    meshes = {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "accessors": [accessor]}
    nodes = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    return json.dumps(nodes | meshes | views).encode()


DECLARED = {
    "vertices.ply": ply(f"element vertex 1000000000000\n{XYZ}element face 12\n{TRIANGLES}"),
    "faces.ply": ply(f"element vertex 8\n{XYZ}element face 1000000000000\n{TRIANGLES}"),
    "fewer.ply": ply(f"element vertex -5\n{XYZ}element face -12\n{TRIANGLES}"),
    "ascii.ply": ply(f"element vertex 1000000000000\n{XYZ}element face 10\n{TRIANGLES}", b"0 0 0\n", "ascii"),
    "list.ply": ply(f"element vertex 1\nproperty list int float x\nelement face 9\n{TRIANGLES}", b"\xff\xff\xff\x7f" * 99),
    "elements.ply": ply("".join(f"element e{i} 1\nproperty int a\n" for i in range(5000))),
    "size.stl": bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(500),
    "size.glb": struct.pack("<4sII", b"glTF", 2, 2**32 - 1) + struct.pack("<II", 2**32 - 1, 0x4E4F534A) + b"{}",
    "size.off": b"OFF\n1000000000000 1000000000000 0\n0 0 0\n",
    "index.obj": b"v 0 0 0\n" * 10 + b"f 1 2 99999999999\n",
    "digits.obj": b"v " + b"1" * 1_000_000 + b" 0 0\nf 1 1 1\n",
    "count.gltf": gltf().replace(b'"bufferView": 0, ', b"").replace(b'"count": 3', b'"count": 1000000000000'),
    "deep.gltf": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "archive.zip": b"PK",
    "archive.gz": b"\x1f\x8b",
    "folder.ply": None,
}


@pytest.fixture
def little_memory():
    """Two gigabytes more than now."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", DECLARED)
def test_what_a_header_declares_is_not_believed(tmp_path, name, little_memory):
    path = tmp_path / name
    path.mkdir() if DECLARED[name] is None else path.write_bytes(DECLARED[name])
    with pytest.raises(DataError, match="broken: "):
        Body.from_hull(path, label="broken")


def test_a_mesh_of_many_gigabytes_is_refused(tmp_path, little_memory):
    with (tmp_path / "large.stl").open("wb") as file:
        file.truncate(20 << 30)
    with pytest.raises(DataError, match=r"large\.stl has 21\.5 GB"):
        Body.from_hull(tmp_path / "large.stl", label="large")


OUTSIDE = ["../secret", "{root}/secret", "link", "loop", "pipe", "/dev/zero", "missing", "http://example.org/x", "x" * 300]


@pytest.fixture
def folder(tmp_path):
    """With a file beside it that must not be read: three vertices, and a picture."""
    folder = tmp_path / "models"
    folder.mkdir()
    np.eye(3, dtype=np.float32).tofile(tmp_path / "secret")
    Image.new("RGB", (4, 4), (250, 0, 0)).save(tmp_path / "secret.png")
    (tmp_path / "secret.mtl").write_text("newmtl m\nKd 1 0 0\n")
    for ending in ("", ".png", ".mtl"):
        (folder / f"link{ending}").symlink_to(tmp_path / f"secret{ending}")
        (folder / f"loop{ending}").symlink_to(f"loop{ending}")
        os.mkfifo(folder / f"pipe{ending}")
    return folder


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", OUTSIDE)
def test_buffers_outside_of_the_folder_are_not_read(folder, name):
    (folder / "mesh.gltf").write_bytes(gltf(uri=name.format(root=folder.parent)))
    with pytest.raises(DataError, match=r"broken: cannot read .*mesh\.gltf as a mesh"):
        Body.from_hull(folder / "mesh.gltf", label="broken")


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["material", "texture"])
@pytest.mark.parametrize("name", OUTSIDE)
def test_materials_and_textures_outside_of_the_folder_are_not_read(folder, name, kind):
    """The shape is; it has no colours then."""
    name = name.format(root=folder.parent) + {"material": ".mtl", "texture": ".png"}[kind]
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices)
    faces = "".join(f"f {a + 1}/1 {b + 1}/1 {c + 1}/1\n" for a, b, c in box.faces)
    (folder / "own.mtl").write_text(f"newmtl m\nKd 0.5 0.5 0.5\nmap_Kd {name}\n")
    material = name if kind == "material" else "own.mtl"
    (folder / "mesh.obj").write_text(f"mtllib {material}\n{corners}vt 0 0\nusemtl m\n{faces}")
    body = Body.from_hull(folder / "mesh.obj", label="box")
    assert len(body.mesh.faces) == 12
    if body.appearance is not None:
        assert not (np.asarray(body.appearance.visual.to_color().vertex_colors)[:, 0] > 240).any()


def test_a_texture_in_the_folder_is_read(folder):
    Image.new("RGB", (4, 4), (250, 0, 0)).save(folder / "own.png")
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    picture = trimesh.visual.texture.SimpleMaterial(image=Image.new("RGB", (4, 4), (250, 0, 0)))
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=picture)
    box.export(folder / "mesh.obj")
    colours = Body.from_hull(folder / "mesh.obj", label="box").appearance.visual.to_color().vertex_colors
    assert (np.asarray(colours)[:, :3] == [250, 0, 0]).all()


BOX = trimesh.creation.box((0.1, 0.06, 0.04))


def mesh(vertices=BOX.vertices, faces=BOX.faces):
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


def moved(part, x, y=0.0, z=0.0):
    return part.copy().apply_translation((x, y, z))


REFUSED = {
    "empty": mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int)),
    "no faces": mesh(faces=np.zeros((0, 3), dtype=int)),
    "one triangle": mesh(faces=BOX.faces[:1]),
    "flat": mesh(BOX.vertices * [1, 1, 0]),
    "a line": mesh(BOX.vertices * [1, 0, 0]),
    "a point": mesh(BOX.vertices * 0),
    "one vertex thrice": mesh(faces=np.zeros((12, 3), dtype=int)),
    "NaN": mesh(np.where(BOX.vertices == BOX.vertices[3], np.nan, BOX.vertices)),
    "infinite": mesh(np.where(BOX.vertices == BOX.vertices[3], np.inf, BOX.vertices)),
    "1e300": mesh(BOX.vertices * 1e300),
    "millimetres": mesh(BOX.vertices * 1000),
    "micrometres": mesh(BOX.vertices * 1e-6),
    "one far vertex": mesh(np.where(BOX.vertices == BOX.vertices[3], 1e5, BOX.vertices)),
    "a face of none": mesh(faces=np.where(BOX.faces == 7, 99, BOX.faces)),
}
ONE_BOX = {
    "inside out": mesh(faces=BOX.faces[:, ::-1]),
    "half inside out": mesh(faces=np.where(np.arange(12)[:, None] < 6, BOX.faces, BOX.faces[:, ::-1])),
    "twice": mesh(faces=np.concatenate([BOX.faces] * 2)),
    "a hundred times": mesh(faces=np.concatenate([BOX.faces] * 100)),
    "not merged": mesh(BOX.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3)),
    "needles": mesh(faces=np.concatenate([BOX.faces, BOX.faces[:, [0, 0, 1]]])),
    "a hole": mesh(faces=BOX.faces[1:]),
    "a sheet inside": mesh(np.concatenate([BOX.vertices, BOX.vertices / 2]), np.concatenate([BOX.faces, [[8, 9, 10]]])),
    "unused vertices": mesh(np.concatenate([BOX.vertices, [[1e5, 0, 0], [0, 0, 1e5]]])),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_surfaces_without_a_volume_or_of_another_unit_are_refused(kind):
    with pytest.raises(PhysPoseError, match="broken"):
        Body.from_mesh(REFUSED[kind], label="broken", cache=False)


@pytest.mark.parametrize("kind", ONE_BOX)
def test_what_spoils_a_surface_but_not_its_shape_spoils_no_part(kind):
    body = Body.from_mesh(ONE_BOX[kind], label="box", cache=False)
    (part,) = body.parts.to_trimesh()
    assert np.abs(part.bounds - BOX.bounds).max() < 1e-9
    assert part.volume == pytest.approx(BOX.volume)


def test_decompose_lists_what_it_cannot_read_and_does_the_others(tmp_path, capsys):
    for name in ("vertices.ply", "size.glb", "count.gltf", "index.obj"):
        (tmp_path / name).write_bytes(DECLARED[name])
    for number, kind in enumerate(("flat", "one triangle", "micrometres")):
        REFUSED[kind].copy().apply_scale(1000).export(tmp_path / f"surface_{number}.ply")
    BOX.copy().apply_scale(1000).export(tmp_path / "box.ply")
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    (tmp_path / "folder.stl").mkdir()
    os.mkfifo(tmp_path / "pipe.off")
    assert main(["decompose", str(tmp_path), "--json", str(tmp_path / "out.json")]) == 1
    content = json.loads((tmp_path / "out.json").read_text())
    assert list(content["meshes"]) == ["box.ply"]
    assert len(content["failures"]) == 10
    assert all(name in text for name, text in content["failures"].items())
    assert capsys.readouterr().out.count("error: ") == 10


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "off"])
def test_broken_meshes_are_decomposed_in_time_or_refused(tmp_path, kind, capsys):
    """An L, which is cut; two seconds each."""
    shape = trimesh.util.concatenate([BOX, moved(BOX, 0.03, 0.05, 0.01)])
    shape.export(tmp_path / f"mesh.{kind}")
    whole, outcomes = (tmp_path / f"mesh.{kind}").read_bytes(), collections.Counter()
    for seed in range(30):
        (tmp_path / f"mesh.{kind}").write_bytes(mutated(whole, seed))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                body = Body.from_mesh(tmp_path / f"mesh.{kind}", label="broken", cache=False, time_limit_s=1.0)
            except PhysPoseError:
                outcomes["refused"] += 1
                continue
        assert bool(body.parts.vertices.isfinite().all()), f"seed {seed}"
        assert body.decomposition.seconds < 20, f"seed {seed}"
        outcomes[body.decomposition.method] += 1
    with capsys.disabled():
        print(f"\n{kind}: 30 broken meshes decomposed: {dict(outcomes)}")


MILLION = """
import resource, sys
import numpy as np, trimesh
from physpose_torch.geometry.body import Body

rng = np.random.default_rng(0)
ball = trimesh.creation.icosphere(8, 0.1)
if sys.argv[1] == "waves":
    ball.vertices *= 1 + 0.2 * np.sin(200 * ball.vertices[:, :1])
if sys.argv[1] == "soup":
    corners = rng.uniform(-0.1, 0.1, (1_000_000, 1, 3)) + rng.normal(0, 0.003, (1_000_000, 3, 3))
    ball = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3_000_000).reshape(-1, 3), process=False)
report = Body.from_mesh(ball, label="ball", cache=False, time_limit_s=5.0).decomposition
print(len(ball.faces), report.method, report.seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ball", "waves", "soup"])
def test_a_million_faces_need_bounded_time_and_memory(kind, capsys):
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", MILLION, kind], capture_output=True, text=True, check=True)
    faces, method, seconds, memory = done.stdout.split()
    with capsys.disabled():
        print(f"\n{kind}: {faces} faces, {method}, {float(seconds):.0f} s, {float(memory):.1f} GB")
    assert float(seconds) < 300
    assert float(memory) < 6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["crossed", "nested", "edge to edge", "specks"])
def test_surfaces_that_are_no_manifold_are_cut_or_told_to_be_one_hull(kind):
    rng = np.random.default_rng(0)
    parts = {
        "crossed": [BOX, BOX.copy().apply_transform(trimesh.transformations.rotation_matrix(1.2, (0, 0, 1)))],
        "nested": [BOX, BOX.copy().apply_scale(0.5)],
        "edge to edge": [BOX, moved(BOX, 0.1, 0.06)],
        "specks": [BOX, *(moved(BOX.copy().apply_scale(0.005), *rng.uniform(-0.05, 0.05, 3)) for _ in range(200))],
    }[kind]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        body = Body.from_mesh(trimesh.util.concatenate(parts), label=kind, cache=False, time_limit_s=3.0)
    report = body.decomposition
    assert report.seconds < 60
    assert report.n_parts <= DecomposeOptions().max_hulls
    assert (report.method == "hull") == any(kind in str(w.message) for w in told)
    assert np.isfinite(np.concatenate([p.vertices for p in body.parts.to_trimesh()])).all()
