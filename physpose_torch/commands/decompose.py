"""``physpose decompose``: fill the cache of convex parts for a folder of meshes."""

import contextlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from physpose_torch.commands.common import check_output, progress, table
from physpose_torch.errors import DataError
from physpose_torch.files import write_file
from physpose_torch.geometry.body import load_mesh
from physpose_torch.geometry.decompose import DecomposeOptions, decompose_many

__all__ = ["Decompose"]

MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")


@dataclass(frozen=True)
class Decompose:
    """Decompose all meshes of a folder into convex parts and keep them in the cache.

    Prints, for each mesh, how far its parts stand out of the surface and how far the surface shows between them.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with meshes (.ply, .obj, .stl, .glb, .gltf, .off), a BOP models folder say."""
    scale: float = 0.001
    """Factor from the meshes' unit to metres; the default is for BOP's millimetres."""
    options: DecomposeOptions = field(default_factory=DecomposeOptions)
    """How finely."""
    workers: int | None = None
    """Meshes at a time; default: one a core."""
    json: Path | None = None
    """Write the report to this file."""
    quiet: bool = False
    """No progress bar and no table."""

    def __call__(self) -> int:
        check_output(self.json)
        if not self.folder.is_dir():
            raise DataError(f"{self.folder} is not a folder")
        paths = sorted(p for p in self.folder.iterdir() if p.suffix.lower() in MESHES)
        if not paths:
            raise DataError(f"{self.folder} has no meshes ({', '.join(MESHES)})")

        def loader(path: Path):
            return lambda: load_mesh(path, label=path.name, scale=self.scale)

        meshes = {p.name: loader(p) for p in paths}
        reports, failures = {}, {}
        # closing: on Ctrl-C it is over only when no child process is left
        with (
            progress(len(meshes), "decompose", "mesh", quiet=self.quiet) as bar,
            contextlib.closing(decompose_many(meshes, self.options, workers=self.workers)) as results,
        ):
            for name, result in results:
                if isinstance(result, Exception):
                    failures[name] = str(result)
                else:
                    reports[name] = result.report
                bar.set_postfix_str(name)
                bar.update()
        if self.json is not None:
            content = {"meshes": {k: reports[k]._asdict() for k in sorted(reports)}, "failures": failures}
            write_file(self.json, json.dumps(content, indent=2) + "\n")
        if not self.quiet:
            mm = [
                [name, r.method, str(r.n_parts), *(1e3 * x for x in r[2:6]), r.seconds]
                for name, r in sorted(reports.items())
            ]
            print(table(["mesh", "method", "parts", "out p95", "out max", "in p95", "in max [mm]", "seconds"], mm))
            for name, r in sorted(reports.items()):
                if r.warning:
                    print(f"warning: {name}: {r.warning}")
        for name, message in sorted(failures.items()):
            print(f"error: {name}: {message}")
        return 1 if failures else 0
