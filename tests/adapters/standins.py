"""What the adapters meet, with the contracts (and the traps) of happypose's classes, and nothing of happypose."""

import numpy as np
import pandas as pd
import torch


class Collection:
    """``PandasTensorCollection``: a table, and tensors with one entry a row that are read and set like attributes.

    As there, ``to`` works in place, ``clone`` and indexing number the rows anew and forget ``meta``.
    """

    def __init__(self, infos: pd.DataFrame, **tensors: torch.Tensor) -> None:
        self.__dict__["_tensors"] = dict(tensors)
        self.infos = infos.reset_index(drop=True)
        self.meta = {}

    @property
    def tensors(self):
        return self._tensors

    @property
    def device(self):
        return next(iter(self._tensors.values())).device

    def register_tensor(self, name, tensor):
        self._tensors[name] = tensor

    def __getattr__(self, name):
        if name not in self.__dict__["_tensors"]:
            raise AttributeError
        return self._tensors[name]

    def __setattr__(self, name, value):
        (self._tensors if name in self._tensors else self.__dict__)[name] = value

    def __len__(self):
        return len(self.infos)

    def __getitem__(self, ids):
        return Collection(self.infos.iloc[ids], **{name: x[ids] for name, x in self._tensors.items()})

    def to(self, what):
        for name, x in self._tensors.items():
            self._tensors[name] = x.to(what)
        return self

    def clone(self):
        return Collection(self.infos.copy(), **{name: x.clone() for name, x in self._tensors.items()})


def concatenate(collections):
    """All rows; without any, a table without columns and no tensors at all."""
    collections = [c for c in collections if len(c)]
    if not collections:
        return Collection(infos=pd.DataFrame())
    infos = pd.concat([c.infos for c in collections], sort=False).reset_index(drop=True)
    names = collections[0].tensors
    return Collection(infos, **{name: torch.cat([getattr(c, name) for c in collections]) for name in names})


class Discrete:
    """``DiscreteSymmetry``: pose (4, 4), translation in the units of the mesh."""

    def __init__(self, pose) -> None:
        self.pose = np.array(pose, dtype=np.float64)


class Continuous:
    """``ContinuousSymmetry``."""

    def __init__(self, axis, offset=(0.0, 0.0, 0.0)) -> None:
        self.axis, self.offset = axis, offset


class RigidObject:
    def __init__(self, label, mesh_path, mesh_units="m", discrete=(), continuous=(), scaling_factor=1.0) -> None:
        self.label, self.mesh_path, self.mesh_units = label, mesh_path, mesh_units
        self.symmetries_discrete, self.symmetries_continuous = list(discrete), list(continuous)
        self.scaling_factor = scaling_factor

    @property
    def scale(self):
        return {"m": 1.0, "mm": 0.001}[self.mesh_units] * self.scaling_factor

    def make_symmetry_poses(self):
        """Discrete ones in metres; as there, in place, so that each call scales them again."""
        for symmetry in self.symmetries_discrete:
            symmetry.pose[:3, 3] *= self.scale
        return np.array([np.eye(4), *(symmetry.pose for symmetry in self.symmetries_discrete)])


class RigidObjectDataset:
    """No iterator, only a length and items."""

    def __init__(self, objects) -> None:
        self.list_objects = objects

    def __getitem__(self, index):
        return self.list_objects[index]

    def __len__(self):
        return len(self.list_objects)
