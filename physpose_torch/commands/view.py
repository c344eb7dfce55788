"""``physpose view``: the poses of a BOP result file, and their refinement step by step, in the browser."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
import tyro

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.bop.table import read_image
from physpose_torch.commands.common import progress
from physpose_torch.commands.images import ImageOptions, Images
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import DataError, InvalidInputError, PhysPoseError
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene

if TYPE_CHECKING:
    from physpose_torch.viz.viewed import ViewedImage

__all__ = ["View"]

Key = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class View(ImageOptions):
    """Look at the poses of a BOP result file in the browser: objects on their table, the camera with its image, and a slider
    over the steps of the refinement, with the report. Nothing is written. Ctrl-C ends it.

    physpose view --demo shows the embedded scene. Needs the extra viz: pip install "physpose-torch[viz]".
    """

    estimates: Annotated[Path | None, tyro.conf.Positional] = None
    """Result file: scene_id,im_id,obj_id,score,R,t,time (t in mm). Not with --demo."""
    dataset: Path | None = None
    """BOP dataset folder. Not with --demo."""
    demo: bool = False
    """Show the embedded scene instead of a result file."""
    seed: int = 1
    """Which arrangement, with --demo."""
    scenes: Annotated[tuple[int, ...], tyro.conf.arg(aliases=("--scene",))] = ()
    """Only these scenes."""
    images: Annotated[tuple[int, ...], tyro.conf.arg(aliases=("--image",))] = ()
    """Only images of these numbers."""
    batch: Annotated[int, tyro.conf.Suppress] = 1
    preset: str = "default"
    """default; lm: the same cost by fifteen Gauss-Newton steps; or paper: the paper's cost and gradient descent."""
    calibration: Path | None = None
    """The estimator's bias and spread, by physpose calibrate; without: what RGB estimators are usually like."""
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """Single options, starting from preset and calibration."""
    host: str = "127.0.0.1"
    """Address to serve at; 0.0.0.0 lets other machines look, too."""
    port: int = 8080
    """Port to serve at; the next free one, if it is taken."""

    def __call__(self) -> int:
        from physpose_torch.viz.viewer import PoseViewer, load_viser, serve

        load_viser()  # before minutes of work
        if not 0 <= self.port < 65536:
            raise InvalidInputError(f"--port {self.port}: expected 0 to 65535")
        config = replace(self.config, keep_trajectory=True)
        images, names = self._demo(config) if self.demo else self._result_file(config)
        with PoseViewer(images, names=names, host=self.host, port=self.port) as viewer:
            taken = "" if self.port in (0, viewer.server.get_port()) else f" (port {self.port} is taken)"
            with suppress(KeyboardInterrupt):
                print(f"{viewer.url}{taken}; Ctrl-C ends", flush=True)
                serve(viewer)
        return 0

    def _demo(self, config: RefinerConfig) -> "tuple[Sequence[ViewedImage], list[str]]":
        from physpose_torch.demo import run_demo
        from physpose_torch.household import household_meshes
        from physpose_torch.viz.viewed import ViewedImage

        if self.estimates is not None:
            raise InvalidInputError(f"--demo shows no result file; leave out {self.estimates} or --demo")
        with progress(len(household_meshes()), "decompose", "mesh") as bar:
            demo = run_demo(seed=self.seed, config=config, on_body=lambda name: bar.update())
        size = (demo.truth.height, demo.truth.width)
        viewed = ViewedImage("demo", demo.scene, demo.refinement.trajectory, demo.truth.K, size)
        return [viewed], [viewed.name]

    def _result_file(self, config: RefinerConfig) -> "tuple[Sequence[ViewedImage], list[str]]":
        for name, option in (("estimates", "a result file"), ("dataset", "--dataset DIR")):
            if getattr(self, name) is None:
                raise InvalidInputError(f"physpose view needs {option}, or --demo for the embedded scene")
        images = BopImages(
            self.open(), PhysPoseRefiner(config), scenes=self.scenes, every=self.every, images=self.images
        )
        if not len(images):
            raise InvalidInputError(f"{self.estimates} has no image that --scenes, --images and --every leave over")
        return images, images.names


class BopImages(Sequence):
    """The images of a result file, each read and refined when it is asked for.

    Args:
        opened: the result file.
        refiner: whose config keeps the trajectory.
        scenes: only these scenes, if any, as it was opened.
        every: only every n-th image, as it was opened.
        images: only images of these numbers, if any.
    """

    def __init__(
        self,
        opened: Images,
        refiner: PhysPoseRefiner,
        *,
        scenes: Sequence[int] = (),
        every: int = 1,
        images: Sequence[int] = (),
    ) -> None:
        self.estimates, self.dataset, self.refiner = opened.estimates, opened.dataset, refiner
        pairs = zip(opened.estimates.scene_id.tolist(), opened.estimates.im_id.tolist(), strict=True)
        keys = [key for key in dict.fromkeys(pairs) if not scenes or key[0] in scenes][::every]
        self.keys: list[Key] = [key for key in keys if not images or key[1] in images]
        self.names = [f"scene {scene} image {image}" for scene, image in self.keys]
        self._coming: Iterator[ImageScene] = opened.scenes
        self._came: dict[Key, ImageScene] = {}
        self._viewed = lru_cache(maxsize=16)(self._view)

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> "ViewedImage":
        return self._viewed(self.keys[index])

    def _find(self, key: Key) -> ImageScene:
        """They come in file order; those before are kept, for bodies are what takes time and memory."""
        while key not in self._came:
            image = next(self._coming, None)
            if image is None:
                raise DataError(f"scene {key[0]} image {key[1]} is not in the result file any more")
            self._came[image.scene_id, image.im_id] = image
        return self._came[key]

    def _view(self, key: Key) -> "ViewedImage":
        from physpose_torch.viz.viewed import ViewedImage

        image = self._find(key)
        K, size, picture = _camera(self.dataset, *key)
        problems = list(image.problems)
        if image.scene is not None and not problems:
            poses, scores = poses_of([image], self.estimates)
            try:
                trajectory = self.refiner(poses, image.scene, scores=scores).trajectory
                return ViewedImage(image.name, image.scene, trajectory, K, size, picture, scores)
            except PhysPoseError as error:
                problems.append(f"{image.name}: {error}")
        nothing = torch.zeros(1, 0, 4, 4, dtype=torch.float64)
        return ViewedImage(image.name, Scene(()), nothing, K, size, picture, problem="; ".join(problems))


def _camera(
    dataset: BopDataset, scene_id: int, im_id: int
) -> tuple[torch.Tensor | None, tuple[int, int] | None, np.ndarray | None]:
    """Intrinsics, size and image, as far as the dataset has them."""
    try:
        K = dataset.camera(scene_id, im_id).K
    except PhysPoseError:
        return None, None, None
    try:
        if dataset.has_image(scene_id, im_id):
            picture = read_image(dataset.image_path(scene_id, im_id)).numpy()
            return K, picture.shape[:2], picture
        width, height = dataset.image_size(scene_id)
        return K, (height, width), None
    except PhysPoseError:
        return K, None, None
