"""What is worked out once and kept."""

from functools import cached_property
from typing import Any

import torch

__all__ = ["lasting_property"]


class lasting_property(cached_property):
    """A cached property of tensors, which gradients may pass through later though it was first asked for in inference mode."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        with torch.inference_mode(False):
            return super().__get__(instance, owner)
