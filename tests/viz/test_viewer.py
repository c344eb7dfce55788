"""The viewer's nodes are where the poses are, its controls do what they say; no browser looks."""

import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError, MissingExtraError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static
from physpose_torch.viz import PoseViewer, ViewedImage, serve

pytest.importorskip("viser")

K = torch.tensor([[300.0, 0, 160], [0, 300.0, 118], [0, 0, 1]], dtype=torch.float64)


@pytest.fixture
def rising(table, box, can):
    """A box that comes out of the table, and a can that stands on it."""
    trajectory = torch.stack(
        [table.poses((-0.1, 0, 0.02 - d), (0.1, 0.05, 0.04, (0, 0, 10 * d))) for d in (0.02, 0.01, 0.005, 0.0)]
    )
    return ViewedImage("rising", Scene.tabletop([box, can], table.plane), trajectory, K, (240, 320))


@pytest.fixture
def viewer(rising):
    with PoseViewer([rising], port=0, rate=50) as shown:
        yield shown


def node(viewer, name):
    return viewer.server.scene.get_handle_by_name(name)


def pose_of(handle):
    R = Rotation.from_quat(np.asarray(handle.wxyz), scalar_first=True).as_matrix()
    return se3.from_rotation_translation(torch.tensor(R), torch.tensor(np.asarray(handle.position)))


def eventually(condition, seconds=20):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not come true"
        time.sleep(0.02)


def test_objects_are_at_their_poses_at_every_step(viewer, rising):
    assert viewer.shown == viewer.step.value == 3
    for step in (0, 2, 3):
        viewer.step.value = step
        assert viewer.shown == step
        for k in range(2):
            placed = se3.inverse(rising.T_world_camera) @ pose_of(node(viewer, f"/objects/{k}"))
            torch.testing.assert_close(placed, rising.trajectory[step, k], atol=1e-6, rtol=0)


def test_the_world_stands_on_the_table(viewer, rising, table):
    """z = 0 is the plane, z points up, the camera is above it; the resting box has its centre at half its height."""
    up = rising.T_world_camera[:3, :3] @ table.up
    torch.testing.assert_close(up, torch.tensor([0, 0, 1.0], dtype=torch.float64))
    assert float(np.asarray(node(viewer, "/objects/0").position)[2]) == pytest.approx(0.02, abs=1e-6)
    assert float(np.asarray(node(viewer, "/camera").position)[2]) == pytest.approx(-float(table.plane.offset), abs=1e-6)
    assert float(np.asarray(node(viewer, "/table").position)[2]) == pytest.approx(0, abs=1e-9)


def test_red_is_shown_in_place_of_what_penetrates_and_of_nothing_else(viewer):
    def visible():
        return [[node(viewer, f"/objects/{k}/{n}").visible for n in ("surface", "red", "parts")] for k in range(2)]

    viewer.step.value = 0
    assert visible() == [[False, True, False], [True, False, False]]
    viewer.step.value = 3
    assert visible() == [[True, False, False], [True, False, False]]
    viewer.step.value = 0
    viewer.show["parts"].value = True
    assert visible() == [[False, True, False], [False, False, True]]
    viewer.show["red"].value = False
    assert visible() == [[False, False, True], [False, False, True]]


def test_switches_show_and_hide(viewer):
    assert not node(viewer, "/initial").visible
    for name, switch in (("/initial", "initial"), ("/table", "table"), ("/camera", "camera")):
        viewer.show[switch].value = True
        assert node(viewer, name).visible
        viewer.show[switch].value = False
        assert not node(viewer, name).visible


def test_ghosts_stay_at_the_first_step(viewer, rising):
    for k in range(2):
        placed = se3.inverse(rising.T_world_camera) @ pose_of(node(viewer, f"/initial/{k}"))
        torch.testing.assert_close(placed, rising.trajectory[0, k], atol=1e-6, rtol=0)


def test_the_table_of_numbers_is_the_report_at_that_step(viewer, rising):
    viewer.step.value = 0
    report = physics_report(rising.trajectory[0], rising.scene)
    (row,) = (line for line in viewer.table.content.splitlines() if line.startswith("| box"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells == ["box", "20.0", "0.0", f"{1e3 * float(report.gap[0]):.1f}", "plane", "penetrating"]
    viewer.step.value = 3
    assert "penetrating" not in viewer.table.content
    assert "resting" in viewer.table.content


def test_playing_goes_through_the_steps_and_ends_at_the_last(viewer):
    seen = []
    viewer.step.on_update(lambda _: seen.append(viewer.step.value))
    viewer.start()
    eventually(lambda: viewer.play.label == "play" and viewer.shown == 3 and len(seen) >= 4)
    assert seen == [0, 1, 2, 3]
    for _ in range(3):  # only one of them goes on
        viewer.start()
        viewer.pause()
    viewer.start()
    eventually(lambda: viewer.play.label == "play" and viewer.shown == 3)
    assert seen[4:] == [0, 1, 2, 3]


def test_images_are_made_when_they_are_turned_to(rising, table, can):
    made = []

    class Lazy:
        def __len__(self):
            return 2

        def __getitem__(self, index):
            made.append(index)
            one = ViewedImage("one", Scene.tabletop([can], table.plane), table.poses((0, 0, 0.03))[None])
            return [rising, one][index]

    with PoseViewer(Lazy(), names=["first", "second"], port=0) as viewer:
        assert made == [0]
        viewer.image.value = "second"
        assert made == [0, 1]
        assert viewer.step.disabled  # a single set of poses
        assert viewer.shown == 0
        assert node(viewer, "/objects/1") is None
        assert node(viewer, "/initial/1") is None
        assert node(viewer, "/camera") is None  # no intrinsics
        assert "| can" in viewer.table.content
        assert "| box" not in viewer.table.content
        viewer.image.value = "first"
        assert viewer.shown == viewer.step.value == 3
        assert node(viewer, "/objects/1/surface") is not None
        assert node(viewer, "/camera") is not None


def test_a_problem_is_told_where_there_is_nothing_to_see():
    empty = ViewedImage("bad", Scene(()), torch.zeros(1, 0, 4, 4), problem="bad: no plane")
    with PoseViewer([empty], port=0) as viewer:
        assert "no plane" in viewer.table.content
        assert node(viewer, "/objects/0") is None


def test_the_camera_shows_its_image_and_its_field_of_view(table, box):
    image = np.full((240, 320, 3), 77, np.uint8)
    scene = Scene.tabletop([box], table.plane)
    viewed = ViewedImage("photo", scene, table.poses((0, 0, 0.02))[None], K, image=image)
    with PoseViewer([viewed], port=0) as viewer:
        camera = node(viewer, "/camera")
        assert camera.fov == pytest.approx(2 * np.arctan(120 / 300))
        assert camera.aspect == pytest.approx(320 / 240)
        assert camera.image is not None
        torch.testing.assert_close(pose_of(camera), viewed.T_world_camera, atol=1e-6, rtol=0)


def test_static_bodies_are_shown_and_gravity_says_what_is_up_without_a_plane(table, box):
    board = Body.box((0.5, 0.5, 0.02), label="board")
    scene = Scene([box], [Static(board, table.at(0, 0, -0.01))], gravity=table.gravity)
    viewed = ViewedImage("board", scene, table.poses((0, 0, 0.02))[None])
    with PoseViewer([viewed], port=0) as viewer:
        placed = se3.inverse(viewed.T_world_camera) @ pose_of(node(viewer, "/statics/0"))
        torch.testing.assert_close(placed, table.at(0, 0, -0.01), atol=1e-6, rtol=0)
        assert node(viewer, "/table") is None
    up = viewed.T_world_camera[:3, :3] @ table.up
    torch.testing.assert_close(up, torch.tensor([0, 0, 1.0], dtype=torch.float64))


def test_a_port_that_is_taken_is_left_to_its_owner(rising):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with PoseViewer([rising], port=port) as viewer:
            assert viewer.server.get_port() != port
            assert str(viewer.server.get_port()) in viewer.url
            with socket.create_connection(("127.0.0.1", viewer.server.get_port()), timeout=5):
                pass


def test_serving_ends_when_the_viewer_is_closed(rising):
    viewer = PoseViewer([rising], port=0)
    port = viewer.server.get_port()
    server = threading.Thread(target=serve, args=(viewer,), daemon=True)
    server.start()
    viewer.start()  # also while it plays
    viewer.close()
    server.join(timeout=20)
    assert not server.is_alive()
    assert viewer.wait(0)

    def refused():
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            return True
        return False

    eventually(refused)


def test_bad_input_is_named(table, box):
    scene, T = Scene.tabletop([box], table.plane), table.poses((0, 0, 0.02))
    with pytest.raises(InvalidInputError, match=r"expected \(T \+ 1, 1, 4, 4\)"):
        ViewedImage("a", scene, T)
    with pytest.raises(InvalidInputError, match="2 images"):
        ViewedImage("a", Scene.cat([scene, scene]), torch.stack([T[0], T[0]])[None])
    with pytest.raises(InvalidInputError, match="K has shape"):
        ViewedImage("a", scene, T[None], torch.eye(4))
    viewed = ViewedImage("a", scene, T[None])
    with pytest.raises(InvalidInputError, match="no image"):
        PoseViewer([])
    with pytest.raises(InvalidInputError, match="2 names for 1 images"):
        PoseViewer([viewed], names=["a", "b"])
    with PoseViewer([viewed], port=0) as viewer, pytest.raises(InvalidInputError, match="step 1, expected 0 to 0"):
        viewer.show_step(1)


def test_without_viser_the_error_names_the_extra(monkeypatch, table, box):
    monkeypatch.setitem(sys.modules, "viser", None)
    viewed = ViewedImage("a", Scene.tabletop([box], table.plane), table.poses((0, 0, 0.02))[None])
    with pytest.raises(MissingExtraError, match=r'pip install "physpose-torch\[viz\]"'):
        PoseViewer([viewed])


def test_the_package_loads_no_drawing_library_before_it_draws():
    code = (
        "import sys, physpose_torch.viz as viz\n"
        "assert 'torch' not in sys.modules\n"
        "for name in viz.__all__: getattr(viz, name)\n"
        "heavy = {'viser', 'matplotlib', 'warp'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_an_exact_plane_is_enough():
    """Without K, image or covariance."""
    box = Body.box((0.1, 0.1, 0.1), label="box")
    plane = Plane(torch.tensor([0.0, -1.0, 0.0]), torch.tensor(-0.3))
    T = torch.eye(4)[None, None].clone()
    T[..., :3, 3] = torch.tensor([0.0, 0.25, 0.8])
    with PoseViewer([ViewedImage("float32", Scene.tabletop([box], plane), T)], port=0) as viewer:
        assert float(np.asarray(node(viewer, "/objects/0").position)[2]) == pytest.approx(0.05, abs=1e-5)
