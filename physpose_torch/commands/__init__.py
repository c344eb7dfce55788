"""Commands of the ``physpose`` program, one small file each."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from physpose_torch.bop.calibration import read_calibration
from physpose_torch.commands.ablate import Ablate
from physpose_torch.commands.calibrate import Calibrate
from physpose_torch.commands.decompose import Decompose
from physpose_torch.commands.demo import Demo
from physpose_torch.commands.eval import Eval
from physpose_torch.commands.refine import Refine
from physpose_torch.commands.report import Report
from physpose_torch.commands.table import Table
from physpose_torch.commands.view import View
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError

__all__ = ["parse"]

COMMANDS = {
    "demo": Demo,
    "refine": Refine,
    "report": Report,
    "eval": Eval,
    "calibrate": Calibrate,
    "ablate": Ablate,
    "table": Table,
    "decompose": Decompose,
    "view": View,
}
PRESETS = {"default": RefinerConfig, "lm": RefinerConfig.lm, "paper": RefinerConfig.paper}


def parse(args: Sequence[str]) -> Any:
    """The command that the arguments name, ready to be called. Single options start from the preset and the
    calibration that are asked for."""
    preset, calibration = _preset(args), _value(args, "--calibration")
    config = PRESETS[preset]()
    choices = []
    for name, command in COMMANDS.items():
        options = {}
        if "preset" in command.__dataclass_fields__:
            own = config
            if command in (Refine, View) and calibration is not None and args[0] == name:
                own = config.calibrated(read_calibration(calibration))
            options["default"] = _with_defaults(command, preset=preset, config=own)
        choices.append(Annotated[command, tyro.conf.subcommand(name, **options)])
    return tyro.cli(
        Union[tuple(choices)],  # noqa: UP007
        prog="physpose",
        description="Physically consistent 6D object poses: objects neither sink, nor overlap, nor float.",
        args=args,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _preset(args: Sequence[str]) -> str:
    """It decides the defaults of the other options, so it is read before them, like the calibration."""
    preset = _value(args, "--preset")
    if preset is None:
        return "default"
    if preset not in PRESETS:
        raise InvalidInputError(f"--preset {preset}: expected one of {', '.join(PRESETS)}")
    return preset


def _value(args: Sequence[str], option: str) -> str | None:
    """What follows an option, if it is there."""
    for i, word in enumerate(args):
        if word.startswith(f"{option}="):
            return word.removeprefix(f"{option}=")
        if word == option and i + 1 < len(args):
            return args[i + 1]
    return None


def _with_defaults(command: type, **values: Any) -> Any:
    """An instance of a command with these values; what has no default stays to be given."""
    for field in dataclasses.fields(command):
        if (
            field.name not in values
            and field.default is dataclasses.MISSING
            and field.default_factory is dataclasses.MISSING
        ):
            values[field.name] = tyro.MISSING
    return command(**values)
