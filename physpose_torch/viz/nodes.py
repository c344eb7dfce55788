"""What the viewer shows of one image, as nodes of a viser scene: objects, ghosts, statics, table and camera."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from physpose_torch.geometry.body import Body
from physpose_torch.viz.scene import PALETTE, table_rect
from physpose_torch.viz.viewed import ViewedImage

if TYPE_CHECKING:
    import viser

__all__ = ["SceneNodes", "field_of_view", "quaternion_position"]

_RED, _GHOST, _STATIC, _TABLE, _LINE = (219, 28, 31), (255, 138, 31), (150, 150, 150), (236, 233, 228), (190, 186, 178)
_FRUSTUM = 0.08  # size of the camera's pyramid [m]
_BESIDE = 0.45  # angle about the vertical from the camera to where one looks from [rad]
_BACK = 1.7  # its distance from the objects, by the camera's
_WIDEST = 640  # of the image that is sent to the browser [px]
_CREASE = 0.7  # faces that meet at more than this are not smoothed into each other [rad]
_FINE = 30_000  # a mesh of more faces is smooth anyway, and slow to split


class SceneNodes:
    """Nodes in the place of those of the image before. Names as in :class:`~physpose_torch.viz.viewer.PoseViewer`.

    Args:
        server: where to show them.
        viewed: the image.
    """

    def __init__(self, server: "viser.ViserServer", viewed: ViewedImage) -> None:
        self.server, self.viewed = server, viewed
        scene = server.scene
        for name in ("/objects", "/initial", "/statics", "/table", "/camera"):
            scene.remove_by_name(name)
        self._objects: list[Any] = []
        self._surfaces: list[Any] = []
        self._reds: list[Any] = []
        self._parts: list[Any] = []
        scene.add_frame("/objects", show_axes=False)
        self._initial = scene.add_frame("/initial", show_axes=False)
        first = viewed.poses(0)
        for k, body in enumerate(viewed.scene.objects):
            name, smooth = f"/objects/{k}", _smooth(body)
            triangles = np.asarray(smooth.vertices), np.asarray(smooth.faces)
            self._objects.append(scene.add_frame(name, show_axes=False))
            self._surfaces.append(self._add_surface(f"{name}/surface", body, triangles, k))
            self._reds.append(scene.add_mesh_simple(f"{name}/red", *triangles, color=_RED, side="double"))
            self._parts.append(scene.add_mesh_trimesh(f"{name}/parts", _parts(body)))
            wxyz, position = quaternion_position(first[k])
            scene.add_mesh_simple(
                f"/initial/{k}", *triangles, color=_GHOST, opacity=0.35, wxyz=wxyz, position=position, cast_shadow=False
            )
        for k, static in enumerate(viewed.scene.static_bodies):
            mesh = static.shape.mesh
            wxyz, position = quaternion_position(viewed.T_world_camera @ static.T_camera_body.detach().cpu().double())
            scene.add_mesh_simple(
                f"/statics/{k}",
                mesh.vertices,
                mesh.faces,
                color=_STATIC,
                flat_shading=True,
                wxyz=wxyz,
                position=position,
            )
        low, high = self._bounds()
        self._table = self._add_table(low, high)
        self._camera = self._add_camera()
        self._aim(low, high)

    def _add_surface(self, name: str, body: Body, triangles: tuple[np.ndarray, np.ndarray], k: int) -> Any:
        if body.appearance is not None and body.appearance.visual.kind != "face":
            return self.server.scene.add_mesh_trimesh(name, body.appearance)
        color = tuple(int(PALETTE[k % len(PALETTE)][i : i + 2], 16) for i in (1, 3, 5))
        if body.appearance is not None:  # one colour; of more, GLB would make a blur
            color = tuple(np.asarray(body.appearance.visual.face_colors)[:, :3].mean(0).round().astype(int).tolist())
        return self.server.scene.add_mesh_simple(name, *triangles, color=color, side="double")

    def _bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner of all objects from first step to last, world frame [m]."""
        viewed = self.viewed
        corners = []
        for T in (viewed.poses(0), viewed.poses(viewed.last)):
            for pose, body in zip(T, viewed.scene.objects, strict=True):
                center = pose[:3, :3] @ body.center + pose[:3, 3]
                corners += [center - body.radius, center + body.radius]
        if not corners:
            corners = [torch.full((3,), -0.1, dtype=torch.float64), torch.full((3,), 0.1, dtype=torch.float64)]
        points = torch.stack(corners)
        return points.amin(0), points.amax(0)

    def _add_table(self, low: Tensor, high: Tensor) -> Any | None:
        if self.viewed.plane is None:
            return None
        rect = table_rect(torch.stack([low, high]))
        width, height = (rect[1] - rect[0]).tolist()
        x, y = rect.mean(0).tolist()
        return self.server.scene.add_grid(
            "/table",
            width,
            height,
            cell_size=0.05,
            section_size=max(width, height),
            cell_color=_LINE,
            section_color=_LINE,
            plane_color=_TABLE,
            plane_opacity=0.75,  # what is under the table shines through
            position=(x, y, 0.0),
        )

    def _add_camera(self) -> Any | None:
        viewed = self.viewed
        if viewed.K is None:
            return None
        image = viewed.image
        if image is not None:
            every = -(-image.shape[1] // _WIDEST)
            image = np.ascontiguousarray(image[::every, ::every])
        height, width = viewed.size
        wxyz, position = quaternion_position(viewed.T_world_camera)
        return self.server.scene.add_camera_frustum(
            "/camera",
            fov=field_of_view(viewed),
            aspect=width / height,
            scale=_FRUSTUM,
            thickness=0.001,
            image=image,
            format="jpeg",
            wxyz=wxyz,
            position=position,
        )

    def _aim(self, low: Tensor, high: Tensor) -> None:
        """New browsers look at the objects from behind the camera, and from beside it."""
        middle = (low + high) / 2
        away = self.viewed.T_world_camera[:3, 3] - middle
        if self.viewed.K is None:
            away = away.new_tensor([0.3, -1.0, 0.6]) * float((high - low).norm())
        c, s = np.cos(_BESIDE), np.sin(_BESIDE)
        away = away.new_tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ away
        initial = self.server.initial_camera
        initial.up = (0.0, 0.0, 1.0)
        initial.position = tuple((middle + _BACK * away).tolist())
        initial.look_at = tuple(middle.tolist())

    def move(self, step: int) -> None:
        """Put the objects where they are at a step."""
        for frame, T in zip(self._objects, self.viewed.poses(step), strict=True):
            frame.wxyz, frame.position = quaternion_position(T)

    def show(self, wrong: Sequence[bool], *, initial: bool, parts: bool, red: bool, table: bool, camera: bool) -> None:
        """Show and hide: each object as surface, as convex parts, or in red where it is ``wrong``; and what is around."""
        for k, bad in enumerate(wrong):
            self._reds[k].visible = red and bad
            self._parts[k].visible = parts and not (red and bad)
            self._surfaces[k].visible = not parts and not (red and bad)
        self._initial.visible = initial
        for node, visible in ((self._table, table), (self._camera, camera)):
            if node is not None:
                node.visible = visible


def quaternion_position(T: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion (w, x, y, z) and position of a transform (4, 4)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(T[:3, :3].numpy()).as_quat(scalar_first=True), T[:3, 3].numpy()


def field_of_view(viewed: ViewedImage) -> float:
    """Vertical [rad]."""
    return 2 * float(np.arctan(viewed.size[0] / 2 / float(viewed.K[1, 1])))


def _smooth(body: Body) -> Any:
    """The body's mesh with its creases split, so that the browser does not shade a box like a ball."""
    import trimesh

    mesh = body.mesh
    return mesh if len(mesh.faces) > _FINE else trimesh.graph.smooth_shade(mesh, angle=_CREASE)


def _parts(body: Body) -> Any:
    """The convex parts as one mesh, each in its own colour."""
    import trimesh

    meshes = body.parts.to_trimesh()
    for k, mesh in enumerate(meshes):
        mesh.unmerge_vertices()  # facets, not smooth
        color = [int(PALETTE[k % len(PALETTE)][i : i + 2], 16) for i in (1, 3, 5)]
        mesh.visual.vertex_colors = np.tile([*color, 255], (len(mesh.vertices), 1))
    return trimesh.util.concatenate(meshes)
