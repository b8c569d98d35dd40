"""The command that runs, as one would type it again."""

from __future__ import annotations

import shlex

import typer


def command_line(context: typer.Context) -> str:
    """Write a command with its arguments and the options that are not at their defaults.

    Parameters
    ----------
    context : typer.Context
        Of the command; Typer gives it to a parameter of that type.
    """
    words = ["pbrl-ppl", str(context.info_name)]
    options = []
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if value is None or value is False:
            continue
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif value is True:
            options.append(parameter.opts[0])
        else:
            for each in value if isinstance(value, (list, tuple)) else (value,):
                options += [parameter.opts[0], str(each)]
    return shlex.join([*words, *options])
