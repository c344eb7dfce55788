"""``physpose demo``: the embedded scene, before and after, in numbers and as a picture."""

from dataclasses import dataclass, field
from pathlib import Path

from physpose_torch.commands.common import check_output, progress, table
from physpose_torch.config import RefinerConfig

__all__ = ["Demo"]


@dataclass(frozen=True)
class Demo:
    """Build a small household scene, perturb its poses as an RGB estimator would, refine them, and show both.

    The scene is generated (mug, bowl, box, can, bottle, plate, banana; one stacked on another); nothing is downloaded.
    """

    out: Path | None = Path("physpose_demo.png")
    """Picture to write."""
    seed: int = 1
    """Which arrangement."""
    preset: str = "default"
    """default; lm: the same cost by fifteen Gauss-Newton steps; or paper: the paper's cost and gradient descent."""
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """Single options, starting from the preset."""
    quiet: bool = False
    """No progress bar and no table."""

    def __call__(self) -> int:
        from physpose_torch.demo import run_demo
        from physpose_torch.household import household_meshes

        check_output(self.out)
        with progress(len(household_meshes()), "decompose", "mesh", quiet=self.quiet) as bar:
            demo = run_demo(seed=self.seed, config=self.config, on_body=lambda name: bar.update())
        if not self.quiet:
            before, after = demo.before, demo.after
            error_before, error_after = demo.errors(demo.estimates), demo.errors(demo.refinement.poses)
            names = [
                n if s == "table" else f"{n} on {s}" for n, s in zip(demo.truth.names, demo.truth.supports, strict=True)
            ]
            rows = [
                [
                    name,
                    *(
                        f"{1e3 * float(b[i]):.1f} → {1e3 * float(a[i]):.1f}"
                        for b, a in (
                            (before.penetration_static, after.penetration_static),
                            (before.penetration_object, after.penetration_object),
                            (before.gap, after.gap),
                            (error_before, error_after),
                        )
                    ),
                ]
                for i, name in enumerate(names)
            ]
            header = ["before → after [mm]", "in the table", "in an object", "gap below", "pose error"]
            print(table(header, rows))
            print(f"\nrefined {len(names)} objects in {demo.seconds:.2f} s, {int(demo.refinement.steps[0])} steps")
        if self.out is not None:
            demo.picture(self.out)
            if not self.quiet:
                print(f"picture: {self.out}")
        return 0
