"""What is in the images: movable objects, static bodies and planes, gravity; many images flat in one batch."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.distance.broadphase import near_spheres
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.lasting import lasting_property

__all__ = ["Scene", "Static", "as_matrix"]

CROWD = 100
"""More objects and static bodies than this in one image are not all held against each other."""


def as_matrix(T: Any, *, single: bool = False) -> Any:
    """The 4×4 matrices of a ``Transform3d`` of pytorch-kinematics or PyTorch3D; everything else comes back as it is.

    Whatever has a ``get_matrix`` counts, so neither library is imported.

    Args:
        T: a ``Transform3d``, whose matrices are (B, 4, 4), or a tensor of transforms.
        single: take a batch of one as one transform, (4, 4).
    """
    if isinstance(T, Tensor) or not callable(getattr(T, "get_matrix", None)):
        return T
    T = T.get_matrix()
    return T[0] if single and T.ndim == 3 and len(T) == 1 else T


@dataclass(frozen=True, eq=False)
class Static:
    """Something that does not move, in one image."""

    shape: Body | Plane
    """A body, or a plane in the camera frame."""
    T_camera_body: Tensor | None = None
    """(4, 4) pose of a body [m]; may require grad (a robot's links, say); a ``Transform3d`` will do. None for a plane."""
    image: int = 0
    """Index of the image that it is in."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_camera_body", as_matrix(self.T_camera_body, single=True))
        if isinstance(self.shape, Plane):
            if self.T_camera_body is not None:
                raise InvalidInputError("a static Plane is given in the camera frame and takes no T_camera_body")
        elif isinstance(self.shape, Body):
            if self.T_camera_body is None:
                raise InvalidInputError(f"static body {self.shape.label!r} needs its pose T_camera_body (4, 4)")
            if self.T_camera_body.shape != (4, 4):
                raise InvalidInputError(
                    f"static body {self.shape.label!r}: T_camera_body has shape {tuple(self.T_camera_body.shape)}, "
                    "expected (4, 4)"
                )
            se3.check_rigid(self.T_camera_body, f"T_camera_body of static {self.shape.label!r}")
        else:
            raise InvalidInputError(f"Static.shape is a {type(self.shape).__name__}, expected a Body or a Plane")

    def in_image(self, image: int) -> "Static":
        """The same in another image; it has been checked already."""
        moved = copy(self)
        object.__setattr__(moved, "image", image)
        return moved


class _Packing:
    """Different bodies, each packed once; a scene shares it with what is made of it, and so all that is known of its parts."""

    def __init__(self, bodies: Iterable[Body]) -> None:
        self.number = {body: i for i, body in enumerate(dict.fromkeys(bodies))}

    @lasting_property
    def parts(self) -> ConvexParts:
        return ConvexParts.cat([body.parts for body in self.number])


class Scene:
    """Objects of one or many images, and what they must not run into.

    Batching is flat: the N objects of all images stand in one sequence, ``image`` says which image each is in.

    Args:
        objects: N movable bodies; one :class:`Body` may stand here many times.
        statics: static bodies and planes.
        gravity: unit vector(s) pointing down in the camera frame, (3,) or (I, 3); None, or a row of zeros: unknown.
        image: (N,) long, the image of each object; None: all in image 0.
        n_images: number of images I; None: as many as ``image`` and ``statics`` name.
        same_object: (N,) long; objects with one number are alternative estimates of one physical object, and never push
            each other. None: all are different.

    Raises:
        InvalidInputError: lengths, indices or gravity do not fit.
    """

    def __init__(
        self,
        objects: Sequence[Body],
        statics: Sequence[Static] = (),
        *,
        gravity: Tensor | None = None,
        image: Tensor | None = None,
        n_images: int | None = None,
        same_object: Tensor | None = None,
    ) -> None:
        self.objects = tuple(objects)
        self.statics = tuple(statics)
        n = len(self.objects)
        for i, body in enumerate(self.objects):
            if not isinstance(body, Body):
                raise InvalidInputError(f"objects[{i}] is a {type(body).__name__}, expected a Body")
        for i, static in enumerate(self.statics):
            if not isinstance(static, Static):
                raise InvalidInputError(f"statics[{i}] is a {type(static).__name__}, expected a Static")
            if static.image < 0:
                raise InvalidInputError(f"statics[{i}] is in image {static.image}, expected an index >= 0")
        self.image = _index(image, n, "image") if image is not None else torch.zeros(n, dtype=torch.long)
        last = max([int(self.image.max()) if n else -1, *(s.image for s in self.statics)], default=-1)
        self.n_images = max(last + 1, 1 if image is None else 0) if n_images is None else int(n_images)
        if last >= self.n_images:
            raise InvalidInputError(f"an object or static is in image {last}, but n_images = {self.n_images}")
        self.same_object = _index(same_object, n, "same_object") if same_object is not None else torch.arange(n)
        self.gravity = self._checked_gravity(gravity)

    @classmethod
    def tabletop(cls, objects: Sequence[Body], plane: Plane) -> "Scene":
        """One image of objects on a horizontal table: gravity is the plane's normal, downwards."""
        return cls(objects, [Static(plane)], gravity=-plane.normal.detach())

    @classmethod
    def cat(cls, scenes: Sequence["Scene"]) -> "Scene":
        """Many scenes as one batch; images, statics and gravity move along."""
        objects, statics, gravity, image, same, images, n = [], [], [], [], [], 0, 0
        for s in scenes:
            objects += s.objects
            statics += [x.in_image(x.image + images) for x in s.statics]
            gravity.append(s.gravity.double().cpu())
            image.append(s.image + images)
            same.append(s.same_object + n)
            images, n = images + s.n_images, n + len(s.objects)
        if not scenes:
            return cls((), n_images=0)
        whole = cls._of_checked(objects, statics, torch.cat(gravity), torch.cat(image), images, torch.cat(same))
        if all(s._packing is scenes[0]._packing for s in scenes):  # hypotheses of one scene
            whole._packing = scenes[0]._packing
        return whole

    def select(self, images: Tensor) -> tuple["Scene", Tensor]:
        """The scene of some images (K,) long, renumbered in that order, and the indices (M,) of their objects here."""
        images = torch.as_tensor(images, dtype=torch.long)
        new = torch.full((self.n_images,), -1)
        new[images] = torch.arange(len(images))
        image = new[self.image]
        rows = (image >= 0).nonzero()[:, 0]
        place = new.tolist()
        scene = self._of_checked(
            [self.objects[i] for i in rows.tolist()],
            [s.in_image(place[s.image]) for s in self.statics if place[s.image] >= 0],
            self.gravity[images],
            image[rows],
            len(images),
            self.same_object[rows],
        )
        scene._packing = self._packing
        return scene, rows

    def replaced(self, rows: Tensor, statics: Sequence[Static]) -> "Scene":
        """The objects ``rows`` (M,) long only, in all images, with other statics."""
        objects = [self.objects[i] for i in rows.tolist()]
        image, same = self.image[rows], self.same_object[rows]
        return self._of_checked(objects, statics, self.gravity, image, self.n_images, same)

    def detached(self) -> "Scene":
        """The same with copies of the planes and of the static bodies' poses as they are now, without gradients."""
        statics = []
        for s in self.statics:
            moved, shape = copy(s), s.shape
            if isinstance(shape, Plane):
                shape = copy(shape)
                for name in ("normal", "offset"):
                    object.__setattr__(shape, name, getattr(shape, name).detach().clone())
                object.__setattr__(moved, "shape", shape)
            else:
                object.__setattr__(moved, "T_camera_body", s.T_camera_body.detach().clone())
            statics.append(moved)
        scene = self.replaced(torch.arange(len(self)), statics)
        scene.gravity = self.gravity.detach().clone()
        scene._packing = self._packing
        return scene

    @classmethod
    def _of_checked(
        cls,
        objects: Sequence[Body],
        statics: Sequence[Static],
        gravity: Tensor,
        image: Tensor,
        n_images: int,
        same_object: Tensor,
    ) -> "Scene":
        """A scene of what other scenes have checked."""
        scene = cls.__new__(cls)
        scene.objects, scene.statics, scene.gravity = tuple(objects), tuple(statics), gravity
        scene.image, scene.n_images, scene.same_object = image, n_images, same_object
        return scene

    def __len__(self) -> int:
        return len(self.objects)

    def __repr__(self) -> str:
        return f"Scene({len(self.objects)} objects, {len(self.statics)} statics, {self.n_images} images)"

    @property
    def labels(self) -> list[str]:
        return [body.label for body in self.objects]

    # ---- packed views: entities are the objects, then the static bodies; an instance is a part of an entity

    @lasting_property
    def static_bodies(self) -> list[Static]:
        return [s for s in self.statics if isinstance(s.shape, Body)]

    @lasting_property
    def planes(self) -> list[Static]:
        return [s for s in self.statics if isinstance(s.shape, Plane)]

    @lasting_property
    def _packing(self) -> _Packing:
        return _Packing([*self.objects, *(s.shape for s in self.static_bodies)])

    @lasting_property
    def _entity_body(self) -> Tensor:
        """(N + S,) number of every entity's body among those that are packed."""
        number = self._packing.number
        bodies = [*self.objects, *(s.shape for s in self.static_bodies)]
        return torch.tensor([number[body] for body in bodies], dtype=torch.long)

    @property
    def parts(self) -> ConvexParts:
        """Convex parts of the different bodies, each body once; those of a selection are still those of the whole."""
        return self._packing.parts

    @lasting_property
    def entity_image(self) -> Tensor:
        """(N + S,) image of every object and static body."""
        return torch.cat([self.image, torch.tensor([s.image for s in self.static_bodies], dtype=torch.long)])

    @lasting_property
    def instance_start(self) -> Tensor:
        """(N + S + 1,) long: entity e has the instances ``instance_start[e]:instance_start[e + 1]``."""
        counts = self.parts.part_start.diff()[self._entity_body]
        return torch.cat([counts.new_zeros(1), counts.cumsum(0)])

    @lasting_property
    def instance_entity(self) -> Tensor:
        """(Q,) entity of every part instance."""
        return _ranges(self.instance_start[:-1], self.instance_start.diff())[0]

    @lasting_property
    def instance_part(self) -> Tensor:
        """(Q,) index of every instance into :attr:`parts`."""
        return _ranges(self.parts.part_start[self._entity_body], self.instance_start.diff())[1]

    @lasting_property
    def has_static(self) -> Tensor:
        """(I,) bool: whether anything static is known in each image."""
        known = torch.zeros(self.n_images, dtype=torch.bool)
        known[[s.image for s in self.statics]] = True
        return known

    @lasting_property
    def plane_image(self) -> Tensor:
        """(L,) image of every plane."""
        return torch.tensor([s.image for s in self.planes], dtype=torch.long)

    # planes may require grad, and an optimizer may move them in place: not cached
    @property
    def plane_normal(self) -> Tensor:
        """(L, 3), float64."""
        return _stack([s.shape.normal for s in self.planes], (0, 3))

    @property
    def plane_offset(self) -> Tensor:
        """(L,) [m], float64."""
        return _stack([s.shape.offset for s in self.planes], (0,))

    @lasting_property
    def plane_covariance(self) -> Tensor:
        """(L, 3, 3) of (two tilts [rad], offset [m]), zero for exact planes."""
        zero = torch.zeros(3, 3, dtype=torch.float64)
        return _stack([zero if s.shape.covariance is None else s.shape.covariance for s in self.planes], (0, 3, 3))

    @lasting_property
    def plane_uncertain(self) -> bool:
        """Whether any plane has a covariance."""
        return any(s.shape.covariance is not None for s in self.planes)

    @lasting_property
    def object_center(self) -> Tensor:
        """(N, 3) centre of the bounds of each object, object frame [m]."""
        return _stack([b.center for b in self._packing.number], (0, 3))[self._entity_body[: len(self)]]

    @lasting_property
    def entity_span(self) -> Tensor:
        """(N + S,) largest distance of a point of each entity's parts from the origin of its frame [m]."""
        if not len(self.entity_image):
            return torch.zeros(0, dtype=torch.float64)
        length = torch.linalg.vector_norm(self.parts.padded.double(), dim=-1).amax(1)
        span = torch.zeros(len(self.entity_image), dtype=torch.float64)
        return span.scatter_reduce(0, self.instance_entity, length[self.instance_part], "amax")

    @lasting_property
    def entity_pairs(self) -> Tensor:
        """(E, 2) pairs of entities that may meet: of one image, at least one movable, not alternatives of one object."""
        order = torch.argsort(self.entity_image, stable=True)
        end = torch.bincount(self.entity_image, minlength=self.n_images).cumsum(0)[self.entity_image[order]]
        later = torch.arange(1, len(order) + 1)
        first, second = _ranges(later, end - later)  # each with all that come after it in its image
        return self._may_meet(torch.stack([order[first], order[second]], dim=1))

    def near_pairs(self, T: Tensor, margin: float) -> Tensor:
        """Those of :attr:`entity_pairs`, in that order, that come within ``margin`` [m] of each other at poses T (N + S, 4, 4).

        All of them where no image holds more than ``CROWD``: it is not worth asking then. By spheres around their origins.
        """
        if not self.crowded:
            return self.entity_pairs
        center, found = T.detach()[:, :3, 3].double().cpu(), []
        order = torch.argsort(self.entity_image, stable=True)
        for rows in order.split(torch.bincount(self.entity_image, minlength=self.n_images).tolist()):
            if len(rows) > 1:
                found.append(rows[near_spheres(center[rows], self.entity_span[rows], margin)])
        return self._may_meet(torch.cat(found))

    @lasting_property
    def crowded(self) -> bool:
        """Whether any image holds more than ``CROWD`` objects and static bodies."""
        return bool((torch.bincount(self.entity_image) > CROWD).any())

    def _may_meet(self, pairs: Tensor) -> Tensor:
        """Pairs (E, 2) of entities of one image without those of statics, or of alternatives of one object."""
        n = len(self)
        movable = pairs[:, 0] < n
        same = torch.full((len(self.entity_image),), -1)
        same[:n] = self.same_object
        different = (same[pairs[:, 0]] != same[pairs[:, 1]]) | (pairs[:, 1] >= n)
        return pairs[movable & different]

    def seen_from_first(self, T: Tensor) -> Tensor:
        """Poses T (N + S, 4, 4) moved so that the first of each image is in the origin: nothing is lost far from the camera."""
        entity = torch.arange(len(self.entity_image))
        first = torch.full((self.n_images,), len(entity)).scatter_reduce(0, self.entity_image, entity, "amin")
        out = T.clone()
        out[:, :3, 3] -= T[first[self.entity_image].to(T.device), :3, 3]
        return out

    @lasting_property
    def plane_pairs(self) -> Tensor:
        """(E, 2) pairs (object, plane) of one image."""
        order = torch.argsort(self.plane_image, stable=True)
        count = torch.bincount(self.plane_image, minlength=self.n_images)
        who, which = _ranges((count.cumsum(0) - count)[self.image], count[self.image])
        return torch.stack([who, order[which]], dim=1)

    def centers(self, poses: Tensor) -> Tensor:
        """(N, 3) centres of the objects' bounds at poses (N, 4, 4), camera frame [m]; viewing rays go there."""
        return (poses[:, :3, :3] @ self.object_center.to(poses)[:, :, None])[:, :, 0] + poses[:, :3, 3]

    def entity_poses(self, poses: Tensor) -> Tensor:
        """(N + S, 4, 4): the objects' poses, then those of the static bodies."""
        if not self.static_bodies:
            return poses
        return torch.cat([poses, torch.stack([s.T_camera_body.to(poses) for s in self.static_bodies])])

    def _checked_gravity(self, gravity: Tensor | None) -> Tensor:
        if gravity is None:
            return torch.zeros(self.n_images, 3, dtype=torch.float64)
        gravity = torch.as_tensor(gravity, dtype=torch.float64).cpu()
        if gravity.shape == (3,):
            gravity = gravity.expand(self.n_images, 3)
        if gravity.shape != (self.n_images, 3) or not bool(gravity.detach().isfinite().all()):
            raise InvalidInputError(
                f"gravity has shape {tuple(gravity.shape)}, expected finite (3,) or ({self.n_images}, 3)"
            )
        length = torch.linalg.vector_norm(gravity.detach(), dim=-1)
        if bool((((length - 1.0).abs() > 1e-3) & (length > 0)).any()):
            raise InvalidInputError(f"gravity has lengths {length.tolist()}, expected unit vectors pointing down")
        return torch.nn.functional.normalize(gravity, dim=-1)


def _index(value: Tensor, n: int, name: str) -> Tensor:
    value = torch.as_tensor(value)
    if value.shape != (n,) or value.is_floating_point() or value.dtype == torch.bool:
        raise InvalidInputError(
            f"{name} has shape {tuple(value.shape)} and dtype {value.dtype}, expected ({n},) integers"
        )
    value = value.long().cpu()
    if n and int(value.min()) < 0:
        raise InvalidInputError(f"{name} has negative entries")
    return value


def _ranges(start: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """For every i the ``count[i]`` numbers from ``start[i]`` on, one range after another: the i of each, and the number."""
    owner = torch.repeat_interleave(count)
    within = torch.arange(len(owner)) - (count.cumsum(0) - count)[owner]
    return owner, start[owner] + within


def _stack(values: list[Tensor], shape: tuple[int, ...]) -> Tensor:
    return torch.stack([v.double() for v in values]) if values else torch.zeros(shape, dtype=torch.float64)
