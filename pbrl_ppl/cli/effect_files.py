"""Effect files of ``--effect-file``: Python files that define a user's own effects."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pbrl_ppl.errors import EffectError

if TYPE_CHECKING:
    from pbrl_ppl.effects import Attached, Effect
    from pbrl_ppl.scene import Scene


def own_effects(paths: Sequence[Path] | None) -> tuple[Effect, ...]:
    """Return the effects that effect files define, in their order.

    Raises
    ------
    EffectError
        If there is no such file, its code raises, it defines no effect, an effect has the name of
        a catalogue effect, or two have one name.
    """
    from pbrl_ppl.effects import catalogue

    effects: dict[str, Effect] = {}
    for path in paths or ():
        for effect in _defined(path):
            if effect in catalogue:  # imported by the file
                continue
            if effects.setdefault(effect.name, effect) is not effect:
                raise EffectError(
                    f"effect file {path}: there are two effects {effect.name}; rename one"
                )
    return tuple(effects.values())


def with_catalogue(paths: Sequence[Path] | None) -> tuple[Effect, ...]:
    """Return the catalogue and after it the effects of effect files."""
    from pbrl_ppl.effects import catalogue

    return (*catalogue, *own_effects(paths))


def added_effects(
    scene: Scene, effects: Sequence[Effect]
) -> tuple[Scene, tuple[Effect | Attached, ...]]:
    """Return a scene without its own effects' names, and these effects on their bodies.

    An effect that the scene declares by name acts on those bodies, another one on every body that
    it applies to.
    """
    added: list[Effect | Attached] = []
    for effect in effects:
        declared = [body.name for body in scene.bodies if effect.name in body.effects]
        added += [effect.on(body) for body in declared] or [effect]
    names = {effect.name for effect in effects}
    bodies = tuple(
        replace(body, effects=tuple(name for name in body.effects if name not in names))
        for body in scene.bodies
    )
    return scene.replace(bodies=bodies), tuple(added)


def _defined(path: Path) -> list[Effect]:
    """Run a file, and return its effects at module level."""
    from pbrl_ppl.effects import Effect, check_names

    try:
        source = path.read_bytes()
    except OSError as error:
        raise EffectError(
            f"effect file {path}: it cannot be read ({error.strerror}); give the path of a Python"
            " file"
        ) from None
    # no module of the program: where effects are pickled, their laws go along
    names: dict[str, object] = {"__name__": f"effect_file_{path.stem}", "__file__": str(path)}
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), names)
    except Exception as error:
        raise EffectError(
            f"effect file {path}{_line(error, path)}: {type(error).__name__}: {error}; fix the file"
        ) from error
    effects = [*dict.fromkeys(value for value in names.values() if isinstance(value, Effect))]
    if not effects:
        raise EffectError(
            f"effect file {path}: it has no Effect at module level, such as tether ="
            " pp.Effect(...); define one"
        )
    try:
        check_names(effects)
    except EffectError as error:
        raise EffectError(f"effect file {path}: {error}") from None
    return effects


def _line(error: Exception, path: Path) -> str:
    """Return the line of a file at which an error was raised, in words; none if it is unknown."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f", line {error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""
