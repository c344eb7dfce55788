"""``python -m physpose_torch.bench``: what distances and refinements cost, and how exact they are.

Without a subcommand all three benchmarks run with modest sizes, a few minutes in all.
"""

import json
import logging
import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import torch
import tyro

from physpose_torch.bench.engines import EngineOptions, run_engines
from physpose_torch.bench.grasp import GraspOptions, run_grasps
from physpose_torch.bench.growth import GrowthCase, bench_growth, growth_table, sweep
from physpose_torch.bench.images import load_images
from physpose_torch.bench.loops import installed_loops
from physpose_torch.bench.machine import describe_machine, find_device
from physpose_torch.bench.oracle import find_oracle
from physpose_torch.bench.pairs import batches_table, bench_batches, bench_pairs, pairs_table
from physpose_torch.bench.part_pairs import make_part_pairs
from physpose_torch.bench.plot import picture_format, plot_costs
from physpose_torch.bench.scenes import bench_scenes, make_config, scenes_table
from physpose_torch.bench.stress import StressOptions, run_stress
from physpose_torch.bench.tables import TableOptions, run_tables
from physpose_torch.bench.training import TrainingOptions, run_training
from physpose_torch.distance.autograd import backends
from physpose_torch.errors import InvalidInputError, PhysPoseError
from physpose_torch.files import write_file

__all__ = ["main"]

MOST_IMAGES = 600
"""Part pairs come from at most this many images."""
BUSY = 0.5
"""Programs running; above this, times are not those of a quiet machine."""


@dataclass(frozen=True)
class _Bench(ABC):
    """What every benchmark takes."""

    data: Path | None = None
    """Folder with ycbv/ in it. Default: PHYSPOSE_DATA, and generated scenes if that is not set."""
    backend: tuple[str, ...] = ()
    """Distance backends; pairs also knows coal and python-fcl, as a plain loop. Default: all that are installed, and for
    growth the best one."""
    device: str = "cpu"
    """cpu or cuda."""
    threads: int = 1
    """Threads of torch."""
    seed: int = 0
    """Of every draw."""
    json: Path | None = None
    """Write the numbers and the machine to this file."""
    plot: Path | None = None
    """Write a plot of cost against size to this file."""

    def __call__(self) -> int:
        device = find_device(self.device)
        if self.threads < 1:
            raise InvalidInputError(f"--threads {self.threads}: expected at least 1")
        self._check_backends()
        if self.plot is not None:
            picture_format(self.plot)  # before minutes of work
        torch.set_num_threads(self.threads)
        results: dict[str, Any] = {"machine": describe_machine(device), "notes": []}
        print(_machine_line(results["machine"]))
        load = (results["machine"]["load_before"] or [0.0])[0]
        if load > BUSY:
            results["notes"].append(
                f"load {load} before the start: other programs shared the cores, times are too long"
            )
        try:
            self.run(results, device)
        finally:  # what was measured before something failed is kept
            for note in results["notes"]:
                print(f"note: {note}")
            if self.json is not None:
                write_file(self.json, json.dumps(_plain(results), indent=2, allow_nan=False) + "\n")
        if self.plot is not None:
            plot_costs(self.plot, results)
        return 0

    @abstractmethod
    def run(self, results: dict[str, Any], device: torch.device) -> None:
        """Measure, print, and add to the results."""

    def _check_backends(self) -> None:
        known = [*backends(), *installed_loops()]
        for name in self.backend:
            if name not in known:
                raise InvalidInputError(f"--backend {name}: installed here are {', '.join(known)}")

    def _own_backends(self) -> list[str]:
        """Backends of this package that are asked for, or all."""
        return [b for b in backends() if not self.backend or b in self.backend]


@dataclass(frozen=True)
class Pairs(_Bench):
    """Distance backends on real part pairs, apart, touching and deep: time, and error against the test oracle."""

    pairs: int = 3000
    """Part pairs, a third of each kind. With the oracle, some 8 ms for each on two cores."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        run_pairs(results, device, self.pairs, self.data, self.seed, self.backend)


@dataclass(frozen=True)
class Scenes(_Bench):
    """Whole refinements: milliseconds per iteration and per image, by number of images in the batch."""

    images: tuple[int, ...] = (1, 16, 64, 256)
    """Images in a batch."""
    preset: tuple[str, ...] = ("default",)
    """default, lm, paper, or several of them."""
    repeats: int = 3
    """Batches for each row, of different images as far as there are; the median counts."""
    keep_slow: bool = False
    """Also run fcl on more than 16 images."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        configs = [(preset, make_config(preset, backend)) for preset in self.preset for backend in self._own_backends()]
        options = {"repeats": self.repeats, "keep_slow": self.keep_slow}
        run_scenes(results, device, self.images, configs, self.data, self.seed, **options)


@dataclass(frozen=True)
class Growth(_Bench):
    """Cost and peak memory against parts of an object, objects in an image, and images, in generated scenes."""

    parts: tuple[int, ...] = (1, 4, 16, 64)
    """Parts of an object; 6 objects in 4 images."""
    objects: tuple[int, ...] = (1, 4, 16)
    """Objects in an image; 8 parts each, 4 images."""
    images: tuple[int, ...] = (1, 4, 16, 64)
    """Images; 6 objects of 8 parts in each."""
    fixed: tuple[int, int, int] = (8, 6, 4)
    """Parts, objects and images where it is another of them that grows. A crowd: ``--parts --images --fixed 1 1 1 --objects
    100 1000 5000``."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        for backend in self._own_backends() if self.backend else backends()[:1]:
            base = GrowthCase(*self.fixed, backend=backend, device=str(device), threads=self.threads, seed=self.seed)
            run_growth(results, base, self.parts, self.objects, self.images)


@dataclass(frozen=True)
class Table(TableOptions, _Bench):
    """The table's plane from images and noisy poses: errors, failures, and how far its covariance is to be believed."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        if self.plot is not None:
            raise InvalidInputError("--plot: table measures no cost against size; use --json")
        run_tables(results, self, self.data, self.seed)


@dataclass(frozen=True)
class Grasp(GraspOptions, _Bench):
    """The paper's grasping test by geometry: how often a gripper sent to estimated and to refined poses gets hold."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        if self.plot is not None:
            raise InvalidInputError("--plot: grasp measures no cost against size; use --json")
        run_grasps(results, self, self.seed)


@dataclass(frozen=True)
class Training(TrainingOptions, _Bench):
    """A pose network trained with and without the physics term, over several seeds from --seed on: physics and pose errors."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        if self.plot is not None or self.data is not None or self.backend or device.type != "cpu":
            raise InvalidInputError("training: runs on generated scenes on the CPU; no --plot, --data, --backend, --device")
        run_training(results, self, self.seed)


@dataclass(frozen=True)
class Stress(StressOptions, _Bench):
    """Generated scenes with failures planted: who is made worse, by which preset; and what the covariance is worth."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        if self.plot is not None or self.data is not None or self.backend or device.type != "cpu":
            raise InvalidInputError("stress: runs on generated scenes on the CPU; no --plot, --data, --backend, --device")
        run_stress(results, self, self.seed)


@dataclass(frozen=True)
class Engines(EngineOptions, _Bench):
    """The engines of physpose refine: images a second, and whether the poses are those of one process."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        if self.plot is not None or self.data is not None or self.backend or device.type != "cpu":
            raise InvalidInputError("engines: runs on a result file on the CPU; no --plot, --data, --backend, --device")
        run_engines(results, self)


@dataclass(frozen=True)
class All(_Bench):
    """Pairs, scenes and growth with modest sizes: what runs without a subcommand."""

    pairs: int = 3000
    """Part pairs, a third of each kind."""
    images: tuple[int, ...] = (1, 16, 64, 256)
    """Images in a batch."""

    def run(self, results: dict[str, Any], device: torch.device) -> None:
        common = {"data": self.data, "backend": self.backend, "threads": self.threads, "seed": self.seed}
        Pairs(pairs=self.pairs, **common).run(results, device)
        Scenes(images=self.images, **common).run(results, device)
        Growth(**common).run(results, device)


COMMANDS = {
    "all": All,
    "pairs": Pairs,
    "scenes": Scenes,
    "growth": Growth,
    "table": Table,
    "grasp": Grasp,
    "training": Training,
    "stress": Stress,
    "engines": Engines,
}


def run_pairs(results, device, count, data, seed, names) -> None:
    """Pairs of every kind, and calls of every size."""
    if count < 3:
        raise InvalidInputError(f"--pairs {count}: expected at least 3, one of each kind")
    images = load_images(MOST_IMAGES if count > 300 else 30, data=data, seed=seed)
    oracle = find_oracle()
    print(f"\nPart pairs: {images.source}; errors against {oracle if oracle else 'nothing'}")
    if oracle is None:
        results["notes"].append("errors need the oracle of a checkout (tests/oracle.py): times only")
    sets, notes = make_part_pairs(images.images, count, oracle=oracle, seed=seed)
    results["notes"] += notes
    results["pairs_source"] = images.source
    results["pairs"] = bench_pairs(sets, device, judged=oracle is not None, names=names, on_row=_progress)
    print(pairs_table(results["pairs"]))
    results["batches"] = bench_batches(sets[0], device, names=names, on_row=_progress)
    print(f"\nPairs in one call, float64, apart\n{batches_table(results['batches'])}")


def run_scenes(results, device, counts, configs, data, seed, **options) -> None:
    """Whole refinements."""
    if not counts or min(counts) < 1 or options["repeats"] < 1:
        raise InvalidInputError(f"--images {counts}, --repeats {options['repeats']}: expected positive numbers")
    images = load_images(max(counts), data=data, seed=seed)
    per_image = 1e3 * images.seconds_scenes / len(images.images)
    results["scenes_source"] = images.source
    results["scene_building"] = {"seconds_bodies": images.seconds_bodies, "ms_per_image": per_image}
    print(f"\nRefinements: {images.source}; {torch.get_num_threads()} torch thread(s)")
    print(
        f"not in the times: bodies {images.seconds_bodies:.1f} s, scenes {per_image:.1f} ms an image, Scene.cat (below)"
    )
    results["scenes"], notes = bench_scenes(images.images, counts, configs, device, on_row=_progress, **options)
    results["notes"] += notes
    print(scenes_table(results["scenes"]))


def run_growth(results, base: GrowthCase, parts, objects, images) -> None:
    """Sizes of generated scenes, one process each."""
    if min([*parts, *objects, *images, base.parts, base.objects, base.images]) < 1:
        raise InvalidInputError("--parts, --objects, --images, --fixed: expected positive numbers")
    what = "torch's allocator on the device" if base.device.startswith("cuda") else "resident set above a tiny scene's"
    print(f"\nGrowth: generated scenes, backend {base.backend}; peak memory: {what}, a process for each row")
    rows = bench_growth(sweep(base, sorted(parts), sorted(objects), sorted(images)), on_row=_progress)
    results.setdefault("growth", []).extend(rows)
    print(growth_table(rows))


def _progress(row: dict[str, Any]) -> None:
    """A line on stderr for each row, where somebody watches."""
    if sys.stderr.isatty():
        print(*(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()), file=sys.stderr)


def _machine_line(machine: dict[str, Any]) -> str:
    versions = ", ".join(f"{k} {v}" for k, v in machine["versions"].items() if v)
    load = machine["load_before"]
    busy = f", load {load[0]}" if load else ""
    return (
        f"{machine['cpu']}, {machine['cores']} cores{busy}; device {machine['device']}; "
        f"{machine['torch_threads']} torch thread(s)\nPython {machine['python']}, {versions}"
    )


def _plain(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def parse(args: Sequence[str]) -> _Bench:
    """The benchmark that the arguments name; all of them if they name none."""
    args = list(args)
    if not args or (args[0].startswith("-") and args[0] not in ("-h", "--help")):
        args.insert(0, "all")
    choices = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in COMMANDS.items())
    return tyro.cli(
        Union[choices],  # noqa: UP007
        prog="python -m physpose_torch.bench",
        description="What distances and refinements cost, and how exact they are. Without a subcommand: all.",
        args=args,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark; returns its exit code."""
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
    try:
        return parse(sys.argv[1:] if argv is None else argv)()
    except PhysPoseError as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
