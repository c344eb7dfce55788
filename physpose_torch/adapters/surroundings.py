"""What is known of an image besides its objects: table, static bodies and gravity; and bodies by the estimator's labels."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import NamedTuple

from torch import Tensor

from physpose_torch.errors import InvalidInputError, PhysPoseError, UnknownLabelError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.scene import Scene, Static

__all__ = ["Surroundings", "SurroundingsOf", "bodies_by_label", "body_of", "surroundings_of"]


class Surroundings(NamedTuple):
    """What does not move in one image, and which way is down; what ``RobotEnvironment`` returns is one, too."""

    statics: Sequence[Static] = ()
    """Static bodies and planes, their ``image`` left at 0."""
    gravity: Tensor | None = None
    """(3,) unit vector pointing down, camera frame; None: unknown, and nothing falls."""


OfImage = Plane | Surroundings | tuple[Sequence[Static], Tensor | None] | None
SurroundingsOf = OfImage | Mapping[Hashable, OfImage] | Callable[[Hashable], OfImage]
"""One for all images, or by image: a mapping from its key, or a function of it. A :class:`Plane` is a horizontal table;
None: collisions only."""


def surroundings_of(surroundings: SurroundingsOf, key: Hashable) -> Surroundings:
    """The surroundings of the image ``key``.

    Raises:
        InvalidInputError: a mapping that lacks the image; what is given or found is no plane and no (statics, gravity), or
            cannot stand in a scene.
    """
    found = surroundings
    if isinstance(surroundings, Mapping):
        if key not in surroundings:
            known = ", ".join(map(repr, list(surroundings)[:10])) or "none"
            raise InvalidInputError(
                f"surroundings has no image {key!r}, only {known}; add it, or map it to None for collisions only"
            )
        found = surroundings[key]
    elif callable(surroundings):
        found = surroundings(key)
    if found is None:
        return Surroundings()
    if isinstance(found, Plane):
        return Surroundings([Static(found)], -found.normal.detach())
    if not (isinstance(found, tuple) and len(found) == 2):
        raise InvalidInputError(
            f"surroundings of image {key!r}: got a {type(found).__name__}, expected a Plane, a pair (statics, gravity) or None"
        )
    statics, gravity = found
    try:
        Scene(
            (), statics, gravity=gravity, n_images=1
        )  # its checks, one image at a time so that the message can name it
    except (PhysPoseError, TypeError) as error:
        raise InvalidInputError(f"surroundings of image {key!r}: {error}") from error
    return Surroundings(list(statics), gravity)


def bodies_by_label(bodies: Mapping[str, Body] | Iterable[Body]) -> dict[str, Body]:
    """Bodies by the label that an estimator has for them: that of the mapping, or their own.

    Raises:
        InvalidInputError: something that is not a :class:`Body`, or two bodies with one label.
    """
    if isinstance(bodies, Mapping):
        pairs = list(bodies.items())
    else:
        pairs = [(getattr(body, "label", None), body) for body in bodies]
    found: dict[str, Body] = {}
    for label, body in pairs:
        if not isinstance(body, Body):
            raise InvalidInputError(
                f"bodies: {label!r} is a {type(body).__name__}, expected a Body; see Body.from_mesh"
            )
        if label in found:
            raise InvalidInputError(f"bodies: two of them are called {label!r}; give a mapping from label to body")
        found[label] = body
    return found


def body_of(label: str, bodies: Mapping[str, Body], where: str) -> Body:
    """The body of a label; ``where`` says in the message who asks.

    Raises:
        UnknownLabelError: there is none.
    """
    if label not in bodies:
        known = ", ".join(map(repr, sorted(bodies, key=str))) or "none"
        raise UnknownLabelError(f"{where}: no body for label {label!r}; there are {known}")
    return bodies[label]
