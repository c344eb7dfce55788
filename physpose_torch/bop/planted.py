"""Failures planted into the images of a BOP result file, reproducibly."""

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from physpose_torch.alternatives import find_alternatives
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.harm import match_acting
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.geometry.body import Body
from physpose_torch.losses import acting
from physpose_torch.planted import Estimated, Failure, Planted
from physpose_torch.scene import Scene

__all__ = ["KnownImages", "PlantedImages", "plant", "true_images"]


class KnownImages(NamedTuple):
    """Images and the truth about them."""

    images: list[tuple[ImageScene, Estimated]]
    obj_ids: dict[Body, int]
    """Of all bodies in them."""


class PlantedImages(NamedTuple):
    """Images with a failure, as if they had been read from a file of their own."""

    estimates: Estimates
    """Their rows; there is no file to write back."""
    images: list[ImageScene]
    """With their rows in these estimates."""
    touched: np.ndarray
    """(rows,) bool: made or moved by planting."""
    source: np.ndarray
    """(rows,) int64, the row of the original estimates that each comes from; -1: made here."""


def true_images(images: Sequence[ImageScene], estimates: Estimates, dataset: BopDataset) -> KnownImages:
    """The images that have a scene, with the truth about them, for :func:`plant`.

    Ground truth instances are in the order of falling visibility. Those whose object is estimated in none of these images
    are left out: their bodies are not at hand.
    """
    images = [i for i in images if i.scene is not None and not i.problems]
    bodies: dict[int, Body] = {}
    acts = np.zeros(len(estimates), dtype=bool)
    for image in images:
        bodies |= dict(zip(estimates.obj_id[image.rows].tolist(), image.scene.objects, strict=True))
        acts[image.rows] = acting(image.scene, poses_of([image], estimates)[1]).numpy()
    matches = match_acting(estimates, dataset, acts)
    matched = dict(zip(matches.rows.tolist(), matches.gts.tolist(), strict=True))
    found = []
    for image in images:
        gt = dataset.ground_truth(image.scene_id)
        there = np.flatnonzero(gt.im_id == image.im_id)
        here = set(gt.obj_id[there].tolist()) | set(estimates.obj_id[image.rows].tolist())
        instances = there[np.isin(gt.obj_id[there], list(bodies))]
        instances = instances[np.argsort(-np.nan_to_num(gt.visib_fract[instances], nan=1.0), kind="stable")]
        place = {int(k): i for i, k in enumerate(instances)}
        truth = torch.tensor([place[matched[row]] if row in matched else -1 for row in image.rows.tolist()])
        true_bodies = tuple(bodies[k] for k in gt.obj_id[instances].tolist())
        absent = tuple(bodies[k] for k in sorted(bodies) if k not in here)
        poses, scores = poses_of([image], estimates)
        found.append(
            (image, Estimated(poses, scores, image.scene, gt.T_camera_object[instances], true_bodies, truth, absent))
        )
    return KnownImages(found, {body: obj_id for obj_id, body in bodies.items()})


def plant(
    failure: Failure,
    known: KnownImages,
    estimates: Estimates,
    *,
    counts: Mapping[tuple[int, int, int], int] | None = None,
    seed: int = 0,
) -> PlantedImages:
    """Plant a failure into all images that it fits; the others are left out.

    Which rows are alternatives of one object is found out anew, as it would be with a file. What is drawn for an image does
    not depend on which other images there are, but for the bodies that false positives can be of.

    Args:
        failure: what to plant.
        known: see :func:`true_images`.
        estimates: their rows.
        counts: (scene_id, im_id, obj_id) → number of instances, from a targets file; not told to every failure.
        seed: of the draws.
    """
    counts = (failure.counted and counts) or {}
    made: list[tuple[ImageScene, Planted]] = []
    for image, estimated in known.images:
        # failures of one name draw alike, so that two scores of a false positive compare
        words = [seed, image.scene_id, image.im_id, zlib.crc32(failure.name.encode())]
        state = np.random.SeedSequence(words).generate_state(1)
        planted = failure.plant(estimated, torch.Generator().manual_seed(int(state[0])))
        if planted is not None:
            made.append((image, planted))
    scenes, start = [], 0
    for image, planted in made:
        rows = np.arange(start, start + len(planted.poses))
        start += len(rows)
        scene = planted.scene
        keys = {b: (image.scene_id, image.im_id, known.obj_ids[b]) for b in scene.objects}
        told = {(0, b.label): counts[key] for b, key in keys.items() if key in counts}
        same = find_alternatives(planted.poses, scene, planted.scores, counts=told)
        scene = Scene(scene.objects, scene.statics, gravity=scene.gravity, same_object=same)
        scenes.append(ImageScene(image.scene_id, image.im_id, rows, scene))
    touched = np.concatenate([np.zeros(0, dtype=bool), *(p.touched.numpy() for _, p in made)])
    source = [np.where(p.source >= 0, i.rows[p.source.clamp_min(0)], -1) for i, p in made]
    source = np.concatenate([np.zeros(0, dtype=np.int64), *source])
    return PlantedImages(_as_file(estimates, made, source, known.obj_ids), scenes, touched, source)


def _as_file(
    estimates: Estimates, made: list[tuple[ImageScene, Planted]], source: np.ndarray, obj_ids: dict[Body, int]
) -> Estimates:
    count = [len(p.poses) for _, p in made]
    none = torch.zeros((0, 4, 4), dtype=torch.float64)
    return Estimates(
        path=estimates.path,
        scene_id=np.repeat(np.array([i.scene_id for i, _ in made], dtype=np.int64), count),
        im_id=np.repeat(np.array([i.im_id for i, _ in made], dtype=np.int64), count),
        obj_id=np.array([obj_ids[b] for _, p in made for b in p.scene.objects], dtype=np.int64),
        score=np.concatenate([np.zeros(0), *(p.scores.numpy() for _, p in made)]),
        T_camera_object=torch.cat([none, *(p.poses for _, p in made)]),
        time=np.full(len(source), -1.0),
        line=np.zeros(len(source), dtype=np.int64),
        text=(),
    )
