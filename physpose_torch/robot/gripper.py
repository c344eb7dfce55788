"""A parallel gripper: what of it can collide, and where it holds."""

from dataclasses import dataclass

from physpose_torch.errors import InvalidInputError

__all__ = ["Gripper"]


@dataclass(frozen=True)
class Gripper:
    """Two finger boxes below a palm box; lengths in metres.

    Gripper frame: the origin lies midway between the tips' ends, z points where the gripper goes (out of the palm), the
    fingers close along y.
    """

    opening: float = 0.09
    """Largest distance between the fingers."""
    finger_width: float = 0.018
    """Along x."""
    finger_thickness: float = 0.009
    """Along y."""
    finger_length: float = 0.045
    """From the palm to the tips, along z."""
    pad_height: float = 0.02
    """The pad is the inner face of a finger from its tip up to here."""
    palm_width: float = 0.05
    """Along x."""
    palm_length: float = 0.15
    """Along y."""
    palm_height: float = 0.06
    """Along z."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < 10:
                raise InvalidInputError(f"Gripper {name} = {value}, expected a positive length in metres")
        if self.pad_height > self.finger_length:
            raise InvalidInputError(
                f"Gripper pad_height = {self.pad_height} is longer than the finger, {self.finger_length}"
            )
