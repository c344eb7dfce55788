"""Files that go in and out: BOP result CSV, target lists, table planes, static meshes.

The files speak millimetres (BOP); everything handed out is in metres, poses as float64 tensors `T_camera_object`,
ids and scores as numpy arrays. What is broken in one row or one image is reported as a `RowProblem` and must not stop a
run over a thousand others; only a file that cannot be read as a whole raises `DataError`.
"""

import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.files import write_file
from physpose_torch.reading import inside, load_json, read_text, shown

__all__ = [
    "Estimates",
    "PlaneRecord",
    "RowProblem",
    "StaticRecord",
    "Target",
    "load_json",
    "make_estimates",
    "parse_rows",
    "read_estimates",
    "read_planes",
    "read_statics",
    "read_targets",
    "refuse_metres",
    "rewrite_rows",
    "write_estimates",
]

_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_MM = 1e-3
_ROTATION_TOLERANCE = 1e-2
_FAR = 100.0  # [m] nothing that a tabletop camera sees is farther away
_PLANE_NEAR, _PLANE_FAR = 0.01, 20.0  # [m] outside of this a plane's offset has the wrong unit
MAX_ID = 10**9
"""All ids are smaller."""


class RowProblem(NamedTuple):
    """A row of a CSV, or an image's entry of a JSON file, that cannot be used.

    `line` is 1-based and None for JSON; `scene_id` and `im_id` are None where the row does not even tell them.
    `message` names the file and the place, and says what to do.
    """

    line: int | None
    scene_id: int | None
    im_id: int | None
    message: str


@dataclass(frozen=True, eq=False)
class Estimates:
    """The usable rows of a BOP result CSV, in file order, and the text needed to write the file back.

    Rows that are listed in `problems` are not in the arrays, but `write_estimates` keeps them verbatim.
    """

    path: Path
    """Where the rows were read from."""
    scene_id: np.ndarray
    """(rows,) int64."""
    im_id: np.ndarray
    """(rows,) int64."""
    obj_id: np.ndarray
    """(rows,) int64."""
    score: np.ndarray
    """(rows,) float64, higher is better."""
    T_camera_object: torch.Tensor
    """(rows, 4, 4) float64 [m], rotations projected onto SO(3)."""
    time: np.ndarray
    """(rows,) float64, seconds spent on the row's image; -1 where unknown."""
    line: np.ndarray
    """(rows,) int64, 1-based line of the file."""
    text: tuple[str, ...]
    """Every line of the file as read, line ends included."""
    problems: tuple[RowProblem, ...] = ()
    """Rows that cannot be used, in file order."""
    numbers: np.ndarray | None = None
    """(len(text),) int64, ascending: the 1-based line of each text, where only some of the file's were read; None: all were."""

    def __len__(self) -> int:
        return len(self.scene_id)

    @property
    def place(self) -> np.ndarray:
        """(rows,) int64, index in `text` of each row."""
        return self.line - 1 if self.numbers is None else np.searchsorted(self.numbers, self.line)


class PlaneRecord(NamedTuple):
    """A table plane `normal · x = offset` in the camera frame; the normal points up, towards the camera.

    `normal` is a (3,) float64 unit tensor, `offset` is in metres and negative (the camera, at the origin, is above the
    table), `sigma_deg` [°] and `sigma` [m] are standard deviations of tilt and height, or None if the file has none.
    """

    normal: torch.Tensor
    offset: float
    sigma_deg: float | None = None
    sigma: float | None = None


@dataclass(frozen=True, eq=False)
class StaticRecord:
    """An immovable body: a mesh file or a box, and where it is in which image."""

    label: str
    """Name of the body: the mesh's file name without its ending, unless the file says otherwise."""
    mesh: Path | None
    """Mesh file, or None for a box."""
    scale: float
    """Factor from the mesh's unit to metres; 1 for a box."""
    box: tuple[float, float, float] | None
    """Side lengths [m] of a box centred at the body's origin, or None for a mesh."""
    poses: dict[tuple[int | None, int | None], torch.Tensor]
    """(scene_id, im_id) → T_camera_body (4, 4) float64 [m]; None stands for all scenes, or all images of a scene."""

    def pose(self, scene_id: int, im_id: int) -> torch.Tensor | None:
        """T_camera_body (4, 4) [m] in an image, the most specific entry; None if the body is not in that image."""
        for key in ((scene_id, im_id), (scene_id, None), (None, None)):
            if key in self.poses:
                return self.poses[key]
        return None


class Target(NamedTuple):
    """`inst_count` instances of object `obj_id` are to be found in image `im_id` of scene `scene_id`."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int


def read_estimates(path: str | os.PathLike) -> Estimates:
    """Read a BOP result CSV, `scene_id,im_id,obj_id,score,R,t,time` (R row-major, t in mm, header optional).

    Spaces, blank lines, a byte order mark and any line ends are accepted. A rotation that is off by up to 1e-2 is
    projected onto SO(3). A file with only a header gives no rows.

    Args:
        path: The CSV, UTF-8.

    Returns:
        The usable rows [m], and in `problems` the rows that are not: wrong number of fields, not a finite number, no
        rotation, a translation behind the camera, beyond 100 m or nearer than 10 mm.

    Raises:
        DataError: The file is missing, empty, not UTF-8, no BOP CSV, or in metres.

    Source:
        BOP challenge 2019, https://bop.felk.cvut.cz/challenges/bop-challenge-2019/.
    """
    path = Path(path)
    lines = re.findall(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+", read_text(path))
    rows, problems, header = parse_rows(path, enumerate(lines, start=1))
    if not rows and not header:
        raise no_result_file(path, problems)
    refuse_metres(path, [depth for depth in (row[6][2] for row in rows) if depth > 0])
    return make_estimates(path, rows, problems, lines)


def parse_rows(
    path: Path, lines: Iterable[tuple[int, str]], *, started: bool = False
) -> tuple[list[tuple], list[RowProblem], bool]:
    """The rows among (number, text) lines of a BOP result CSV, see `read_estimates`; poses are not looked at yet.

    Args:
        path: The file, for messages.
        lines: In file order; numbers are 1-based.
        started: Rows or a header came before these lines, so none of them is a header.

    Returns:
        (line number, scene_id, im_id, obj_id, score, R as 9 numbers, t as 3 [mm], time [s]) of each row; the rows that are
        not of this form; and whether there was a header.

    Raises:
        DataError: The header is another one.
    """
    rows, problems, header = [], [], False
    for number, line in lines:
        fields = [field.strip() for field in line.lstrip("\ufeff").split(",")]
        if fields == [""]:
            continue
        if not started and any(field.lower() in ("scene_id", "im_id") for field in fields):
            if tuple(field.lower() for field in fields) != tuple(column.lower() for column in _COLUMNS):
                raise DataError(f"{path}, line {number}: the header is {shown(line.strip())}, expected {','.join(_COLUMNS)}")
            started = header = True
            continue
        started = True
        try:
            rows.append((number, *_parse_row(fields)))
        except ValueError as error:
            ids = [int(field) if re.fullmatch(r"\d{1,9}", field) else None for field in (*fields, "")[:2]]
            problems.append(RowProblem(number, *ids, f"{path}, line {number}: {error}; correct or remove the row"))
    return rows, problems, header


def no_result_file(path: Path, problems: Sequence[RowProblem]) -> DataError:
    """The error to raise for a file that has neither a row nor a header."""
    first = f"; {problems[0].message}" if problems else ""
    return DataError(f"{path}: no BOP result CSV, expected rows of {','.join(_COLUMNS)}{first}")


def refuse_metres(path: Path, depths: Sequence[float], count: int | None = None) -> None:
    """Refuse a file whose median depth says that it is in metres.

    Args:
        path: The file.
        depths: The positive t_z of its rows [mm]; those below 10 mm are enough.
        count: How many positive ones there are in all; None: these.

    Raises:
        DataError: It is below 10 mm.
    """
    middle = ((len(depths) if count is None else count) - 1) // 2
    if 0 <= middle < len(depths) and (depth := sorted(depths)[middle]) < 10:
        raise DataError(f"{path}: the median depth t_z is {depth:.3g} mm; BOP wants millimetres: multiply t by 1000")


def make_estimates(
    path: Path,
    rows: Sequence[tuple],
    problems: Sequence[RowProblem],
    text: Sequence[str],
    numbers: np.ndarray | None = None,
) -> Estimates:
    """Estimates of what `parse_rows` returned; rows with poses that cannot be used join the problems.

    Args:
        path: The file they were read from.
        rows: In file order.
        problems: Rows that cannot be used.
        text: The lines that were read.
        numbers: Their 1-based numbers, ascending; None: they are all of the file's.
    """
    problems = list(problems)
    columns = list(zip(*rows, strict=True)) or [()] * 8
    line, scene_id, im_id, obj_id = (np.array(column, dtype=np.int64) for column in columns[:4])
    R = torch.tensor(columns[5], dtype=torch.float64).reshape(-1, 3, 3)
    t = torch.tensor(columns[6], dtype=torch.float64).reshape(-1, 3)
    keep = np.ones(len(rows), dtype=bool)
    for index, message in _bad_poses(R, t):
        keep[index] = False
        ids = int(scene_id[index]), int(im_id[index])
        where = f"{path}, line {line[index]}: scene {ids[0]}, image {ids[1]}, object {obj_id[index]}"
        problems.append(RowProblem(int(line[index]), *ids, f"{where}: {message}; correct or remove the row"))
    T = torch.eye(4, dtype=torch.float64).repeat(int(keep.sum()), 1, 1)
    T[:, :3, :3] = _project_to_so3(R[torch.from_numpy(keep)])
    T[:, :3, 3] = t[torch.from_numpy(keep)] * _MM
    score, time = (np.array(columns[i], dtype=np.float64)[keep] for i in (4, 7))
    ordered = tuple(sorted(problems, key=lambda problem: problem.line))
    ids = (scene_id[keep], im_id[keep], obj_id[keep])
    return Estimates(path, *ids, score, T, time, line[keep], tuple(text), ordered, numbers)


def write_estimates(path: str | os.PathLike, estimates: Estimates, poses: Any, *, time: Any = None) -> None:
    """Write estimates back with new poses: same rows, order, scores and line ends, in one atomic step.

    A row whose pose equals the one that was read keeps its text, as do unusable rows. Numbers are written such that
    they read back exactly (repr), R row-major, t in mm.

    Args:
        path: The file to create or replace.
        estimates: What `read_estimates` returned.
        poses: T_camera_object, shape (rows, 4, 4) [m], rigid.
        time: Seconds to add to each row, shape (rows,), equal within an image; times below zero (unknown) stay.

    Raises:
        InvalidInputError: Wrong shapes, poses that are not finite or not rigid or in another unit, times that differ
            within an image, or a folder that does not exist.
        DataError: The file cannot be written; what was there before is kept.
    """
    path = Path(path)
    lines, place = list(estimates.text), estimates.place.tolist()
    for row, text in rewrite_rows(estimates, poses, time=time):
        lines[place[row]] = text
    if not path.parent.is_dir():
        raise InvalidInputError(f"{path}: the folder {path.parent} does not exist; create it first")
    write_file(path, "".join(lines))


def rewrite_rows(estimates: Estimates, poses: Any, *, time: Any = None) -> list[tuple[int, str]]:
    """(row, text with its line end) of each row that new poses or times change; arguments and errors of `write_estimates`."""
    poses = torch.as_tensor(poses).detach().to("cpu", torch.float64)
    if poses.shape != (len(estimates), 4, 4):
        raise InvalidInputError(f"poses have shape {tuple(poses.shape)}, expected ({len(estimates)}, 4, 4)")
    changed = (poses != estimates.T_camera_object).flatten(1).any(1)
    for index, message in _bad_poses(poses[:, :3, :3], poses[:, :3, 3] / _MM, anywhere=True):
        raise InvalidInputError(f"poses[{index}]: {message}; poses are T_camera_object in metres")
    added = np.zeros(len(estimates)) if time is None else np.array(time, dtype=np.float64)
    if added.shape != (len(estimates),) or not np.isfinite(added).all():
        raise InvalidInputError(f"time has shape {added.shape}, expected ({len(estimates)},) finite seconds")
    per_image: dict[tuple[int, int], float] = {}
    for key, seconds in zip(zip(estimates.scene_id, estimates.im_id, strict=True), added, strict=True):
        if per_image.setdefault(key, seconds) != seconds:
            raise InvalidInputError(f"time differs within scene {key[0]}, image {key[1]}; BOP wants one per image")
    rewritten = []
    later = (added != 0) & (estimates.time >= 0)
    place = estimates.place
    for row in np.flatnonzero(changed.numpy() | later).tolist():
        fields = estimates.text[place[row]].split(",")
        if changed[row]:
            for column, numbers in ((4, poses[row, :3, :3].flatten()), (5, poses[row, :3, 3] / _MM)):
                fields[column] = " ".join(map(repr, numbers.tolist()))
        if later[row]:
            end = re.search(r"[\r\n]*$", fields[6]).group()
            fields[6] = repr(float(estimates.time[row] + added[row])) + end
        rewritten.append((row, ",".join(fields)))
    return rewritten


def read_planes(path: str | os.PathLike) -> tuple[dict[tuple[int, int], PlaneRecord], list[RowProblem]]:
    """Read table planes per image, camera frame: `{scene: {image: entry}}` in JSON.

    An entry is `{"normal": [3], "offset_mm": x}` (normal · x = offset) or `{"R": 3×3, "t": [m]}` (T_camera_table, z up,
    t in metres), either with optional `sigma_deg` and `sigma_mm`. Other keys are ignored.

    Args:
        path: The JSON file.

    Returns:
        The planes [m] by (scene_id, im_id), and a problem for each image whose entry cannot be used.

    Raises:
        DataError: The file is missing, no JSON, has a key twice, or is not of this form.
    """
    path, planes, problems = Path(path), {}, []
    for scene_id, scene in _int_keys(load_json(path), f"{path}"):
        for im_id, entry in _int_keys(scene, f"{path}, scene {scene_id}"):
            try:
                planes[scene_id, im_id] = _plane(entry)
            except ValueError as error:
                message = f"{path}, scene {scene_id}, image {im_id}: {error}"
                problems.append(RowProblem(None, scene_id, im_id, message))
    return planes, problems


def read_statics(path: str | os.PathLike) -> list[StaticRecord]:
    """Read bodies that never move, camera frame:

        {"statics": [{"mesh": "table.ply", "scale": 0.001, "poses": {"all": {"R": [9], "t_mm": [3]}}},
                     {"box_mm": [800, 600, 30], "label": "tray", "poses": {"48": {"all": POSE}, "49": {"1": POSE}}}]}

    A mesh is found relative to the JSON's folder and may not leave it; `scale` takes its unit to metres (default 0.001:
    BOP meshes are in millimetres). A box is centred at its origin. POSE is T_camera_body, R row-major (9 or 3×3). "all"
    stands for every scene, or for every image of a scene; the most specific entry counts.

    Args:
        path: The JSON file.

    Returns:
        One record for each body [m], in file order.

    Raises:
        DataError: The file or one of its entries cannot be used.
    """
    path = Path(path)
    content = load_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("statics"), list):
        raise DataError(f'{path}: expected {{"statics": [...]}}')
    records = []
    for index, entry in enumerate(content["statics"]):
        try:
            records.append(_static(entry, path.parent, f"static_{index}"))
        except ValueError as error:
            raise DataError(f"{path}, statics[{index}]: {error}") from None
    return records


def read_targets(path: str | os.PathLike) -> list[Target]:
    """Read a BOP target list (`test_targets_bop19.json`), in file order.

    Raises:
        DataError: The file is missing or broken, lacks `inst_count`, or lists an object of an image twice.
    """
    path, targets = Path(path), {}
    content = load_json(path)
    if not isinstance(content, list):
        raise DataError(f"{path}: expected a list of targets, found {type(content).__name__}")
    for index, entry in enumerate(content):
        values = [entry.get(key) if isinstance(entry, dict) else None for key in Target._fields]
        if not all(type(value) is int and 0 <= value < MAX_ID for value in values):
            raise DataError(f"{path}, entry {index}: expected integers {', '.join(Target._fields)}, found {shown(entry)}")
        target = Target(*values)
        if targets.setdefault(target[:3], target) is not target:
            raise DataError(f"{path}, entry {index}: {shown(entry)} is listed twice; merge the entries")
    return list(targets.values())


def _parse_row(fields: list[str]) -> tuple:
    if len(fields) != len(_COLUMNS):
        raise ValueError(f"{len(fields)} fields, expected {len(_COLUMNS)} ({','.join(_COLUMNS)})")
    for name, field in zip(_COLUMNS[:3], fields[:3], strict=True):
        if not re.fullmatch(r"[0-9]{1,9}", field):
            raise ValueError(f"{name} is {shown(field)}, expected a non-negative integer")
    numbers = []
    for name, field, count in zip(_COLUMNS[3:], fields[3:], (1, 9, 3, 1), strict=True):
        try:
            values = tuple(map(float, field.split()))
        except ValueError:
            raise ValueError(f"{name} is {shown(field)}, expected {count} numbers separated by spaces") from None
        if len(values) != count:
            raise ValueError(f"{name} has {len(values)} numbers, expected {count}")
        if not all(map(math.isfinite, values)):
            raise ValueError(f"{name} is {shown(field)}, expected finite numbers")
        numbers.append(values if count > 1 else values[0])
    return (*map(int, fields[:3]), *numbers)


def _bad_poses(R: torch.Tensor, t_mm: torch.Tensor, anywhere: bool = False) -> list[tuple[int, str]]:
    """(index, what is wrong) of each pose that is not rigid, or too far, or (unless anywhere) behind the camera."""
    det = torch.linalg.det(R)
    skew = (R @ R.mT - torch.eye(3, dtype=R.dtype)).abs().flatten(1).amax(1)
    size, z = t_mm.abs().amax(1), t_mm[:, 2]
    off = ~((skew <= _ROTATION_TOLERANCE) & ((det - 1).abs() <= _ROTATION_TOLERANCE))
    bad = off | ~(size <= _FAR / _MM)
    if not anywhere:
        bad |= ~(z > 0) | (size < 10)
    messages = []
    for i in torch.nonzero(bad).flatten().tolist():
        where = "t = ({:.4g}, {:.4g}, {:.4g}) mm".format(*t_mm[i].tolist())
        if off[i]:
            message = f"R is not a rotation: det = {det[i]:.4g}, |R Rᵀ - 1| = {skew[i]:.2g}, expected 1 and 0"
        elif not size[i] <= _FAR / _MM:
            message = f"{where} is farther than {_FAR:g} m"
        elif size[i] < 10:
            message = f"{where} is nearer than 10 mm; is it in metres where millimetres are expected?"
        else:
            message = f"{where} is behind the camera, expected t_z > 0"
        messages.append((i, message))
    return messages


def _project_to_so3(R: torch.Tensor) -> torch.Tensor:
    U, _, Vh = torch.linalg.svd(R)
    return U @ Vh  # det(R) is near 1 here, so this is a proper rotation


def _int_keys(content: Any, where: str) -> list[tuple[int, Any]]:
    if not isinstance(content, dict):
        raise DataError(f"{where}: expected an object with ids as keys, found {type(content).__name__}")
    ids: dict[int, Any] = {}
    for key, value in content.items():
        if not re.fullmatch(r"[0-9]{1,9}", key):
            raise DataError(f"{where}: key {shown(key)} is not an id; the form is {{scene: {{image: entry}}}}")
        if int(key) in ids:
            raise DataError(f"{where}: id {int(key)} appears twice; keep one of them")
        ids[int(key)] = value
    return list(ids.items())


def _numbers(entry: dict, key: str, count: int) -> list[float]:
    value = entry.get(key)
    rows = [value] if count == 1 else value if isinstance(value, list) else []
    flat = [x for row in rows for x in (row if count == 9 and isinstance(row, list) else [row])]
    if len(flat) != count or not all(type(x) in (int, float) and abs(x) < 1e15 for x in flat):
        raise ValueError(f"{key!r} is {shown(value)}, expected {count} finite number{'s' * (count > 1)}")
    return [float(x) for x in flat]


def _plane(entry: Any) -> PlaneRecord:
    if not isinstance(entry, dict) or ("normal" in entry) == ("R" in entry):
        raise ValueError('expected either {"normal", "offset_mm"} or {"R", "t"}')
    if "normal" in entry:
        normal = torch.tensor(_numbers(entry, "normal", 3), dtype=torch.float64)
        offset = _numbers(entry, "offset_mm", 1)[0] * _MM
        if not abs(normal.norm() - 1) <= 1e-3:
            raise ValueError(f"the normal has length {normal.norm():.4g}, expected 1; divide by its length")
        normal = normal / normal.norm()
    else:
        normal = _rotation(entry)[:, 2]
        offset = float(normal @ torch.tensor(_numbers(entry, "t", 3), dtype=torch.float64))
    if not _PLANE_NEAR <= abs(offset) <= _PLANE_FAR:
        unit = '"offset_mm" is in millimetres, "t" in metres'
        raise ValueError(f"the plane is {abs(offset):.4g} m from the camera, expected 0.01 to 20 m; {unit}")
    if offset > 0:
        raise ValueError("the normal points away from the camera, into the table; negate both normal and offset")
    sigmas = {key: _numbers(entry, key, 1)[0] for key in ("sigma_deg", "sigma_mm") if entry.get(key) is not None}
    for key, value in sigmas.items():
        if value <= 0:
            raise ValueError(f"{key} is {value:g}, expected a positive number; leave it out if it is unknown")
    sigma = sigmas["sigma_mm"] * _MM if "sigma_mm" in sigmas else None
    return PlaneRecord(normal, offset, sigmas.get("sigma_deg"), sigma)


def _rotation(entry: dict) -> torch.Tensor:
    R = torch.tensor(_numbers(entry, "R", 9), dtype=torch.float64).reshape(1, 3, 3)
    for _, message in _bad_poses(R, torch.zeros(1, 3, dtype=torch.float64), anywhere=True):
        raise ValueError(message)
    return _project_to_so3(R)[0]


def _static(entry: Any, folder: Path, label: str) -> StaticRecord:
    if not isinstance(entry, dict) or ("mesh" in entry) == ("box_mm" in entry):
        raise ValueError('expected {"mesh" or "box_mm", "poses"}')
    mesh, box, scale = None, None, 1.0
    if "mesh" in entry:
        mesh = inside(folder, str(entry["mesh"]))
        if not mesh.is_file():
            raise ValueError(f"mesh {shown(entry['mesh'])} is not in {folder}; put it there")
        scale, label = _numbers({"scale": _MM, **entry}, "scale", 1)[0], mesh.stem
    else:
        box = tuple(side * _MM for side in _numbers(entry, "box_mm", 3))
    if scale <= 0 or (box and min(box) <= 0):
        raise ValueError("scale and box_mm must be positive")
    label = entry.get("label", label)
    if not isinstance(label, str) or not label.isprintable():
        raise ValueError(f"label is {shown(label)}, expected a name")
    return StaticRecord(label, mesh, scale, box, dict(_static_poses(entry.get("poses"))))


def _static_poses(content: Any) -> Iterator[tuple[tuple[int | None, int | None], torch.Tensor]]:
    if not isinstance(content, dict) or not content:
        raise ValueError('expected "poses": {"all": pose} or {scene: {image or "all": pose}}')
    for scene, images in content.items():
        images = {"all": images} if scene == "all" else images
        for image, pose in images.items() if isinstance(images, dict) else [("", images)]:
            if not all(re.fullmatch(r"all|[0-9]{1,9}", name) for name in (scene, image)) or not isinstance(pose, dict):
                where = f"{shown(scene)}: {shown(image)}: ..." if image else f"{scene!r}: {shown(images)}"
                raise ValueError(f'poses, {where}: expected {{"all": pose}} or {{scene: {{image or "all": pose}}}}')
            T = torch.eye(4, dtype=torch.float64)
            try:
                T[:3, :3] = _rotation(pose)
                T[:3, 3] = torch.tensor(_numbers(pose, "t_mm", 3), dtype=torch.float64) * _MM
            except ValueError as error:
                raise ValueError(f'poses, scene {scene}, image {image}: {error}; a pose is {{"R", "t_mm"}}') from None
            yield tuple(None if name == "all" else int(name) for name in (scene, image)), T
