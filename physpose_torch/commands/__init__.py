"""Commands of the ``physpose`` program, one small file each."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from physpose_torch.commands.decompose import Decompose
from physpose_torch.commands.demo import Demo
from physpose_torch.commands.eval import Eval
from physpose_torch.commands.refine import Refine
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError

__all__ = ["parse"]

COMMANDS = {"demo": Demo, "refine": Refine, "eval": Eval, "decompose": Decompose}
PRESETS = {"default": RefinerConfig, "lm": RefinerConfig.lm, "paper": RefinerConfig.paper}


def parse(args: Sequence[str]) -> Any:
    """The command that the arguments name, ready to be called. Single options start from the preset that is asked for."""
    config = PRESETS[_preset(args)]()
    choices = []
    for name, command in COMMANDS.items():
        options = {}
        if "config" in command.__dataclass_fields__:
            options["default"] = _with_defaults(command, preset=_preset(args), config=config)
        choices.append(Annotated[command, tyro.conf.subcommand(name, **options)])
    return tyro.cli(
        Union[tuple(choices)],  # noqa: UP007
        prog="physpose",
        description="Physically consistent 6D object poses: objects neither sink, nor overlap, nor float.",
        args=args,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _preset(args: Sequence[str]) -> str:
    """What follows --preset; it decides the defaults of the other options, so it is read before them."""
    for i, word in enumerate(args):
        value = word.removeprefix("--preset=") if word.startswith("--preset=") else None
        if word == "--preset" and i + 1 < len(args):
            value = args[i + 1]
        if value is not None:
            if value not in PRESETS:
                raise InvalidInputError(f"--preset {value}: expected one of {', '.join(PRESETS)}")
            return value
    return "default"


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
