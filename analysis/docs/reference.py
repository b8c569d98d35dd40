"""MkDocs hook: the reference's pages, from the package itself, and links in its docstrings."""

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Collection
from dataclasses import fields
from pathlib import Path
from typing import Any

import typer

from pbrl_ppl import Command, Effect, EffectParameter, catalogue
from pbrl_ppl.cli.app import app
from pbrl_ppl.effects.effect import STAGES

ROOT = Path(__file__).parents[2]

#: Laws as formulas. ``v`` is the velocity of the centroid, ``u`` the commanded force, ``tau`` the
#: commanded torque, ``dt`` the sampling interval, ``R`` the matrix of a rotation.
FORMULAS = {
    "pivot_damping": "torque = −coefficient · ω, ω relative to the other body of the hinge",
    "pivot_friction": "torque = −torque · sign(ω); at rest, any torque up to it",
    "pivot_load_friction": "|torque| ≤ motor · |commanded torque| + load · |torque of "
    "all else about the hinge|, beside other friction",
    "pivot_stribeck": "|torque| ≤ torque · exp(−(ω / speed)²), beside other friction",
    "slider_damping": "F = −coefficient · v along the axis, v relative to the other body",
    "slider_friction": "F = −force · sign(v) along the axis; at rest, any force up to it",
    "slider_stribeck": "|F| ≤ force · exp(−(v / speed)²) along the axis, beside other friction",
    "linear_drag": "F = −coefficient · v",
    "quadratic_drag": "F = −coefficient · |v| v",
    "angular_drag": "torque = −coefficient · ω",
    "quadratic_angular_drag": "torque = −coefficient · |ω| ω",
    "drag_by_axis": "F = −R(θ) (along · v_x′, across · v_y′), v′ = R(−θ) v",
    "quadratic_drag_by_axis": "F = −R(θ) (along · |v_x′| v_x′, across · |v_y′| v_y′), v′ = R(−θ) v",
    "gravity_tilt": "g → R(angle) g",
    "constant_force": "F = (force_x, force_y) in the world's frame",
    "body_force": "F = R(θ) (force_x, force_y): turns with the body",
    "constant_torque": "torque = torque",
    "push_offset": "torque = (R(θ) offset) × u",
    "actuator_rotation": "u → R(angle) u",
    "inertia_scale": "I → scale · I",
    "com_offset": "the centre of mass is at (x, y) in the body's frame",
    "force_gain": "u → factor · u",
    "torque_gain": "tau → factor · tau",
    "anisotropic_gain": "(u_x, u_y) → (x · u_x, y · u_y)",
    "sliding_friction": "|F| ≤ mu m g against sliding, |torque| ≤ radius · mu m g against turning",
    "turning_friction": "|torque| ≤ torque against turning",
    "sliding_stribeck": "mu → mu (1 + share · exp(−(v / speed)²))",
    "pivot_hysteresis": "torque = −torque · z / angle, dz/dt = ω − |ω| z / (angle (1 "
    "+ rise · exp(−(ω / speed)²)))",
    "wheel": "at (w_x, w_y): |F| ≤ mu_x m g along w_theta, |F| ≤ mu_y m g across it",
    "actuator_delay": "u(t) → u(t − share · dt), tau likewise",
    "first_order_lag": "time · df/dt = u − f; f acts; f = begin · u at a recording's first row",
    "dead_zone": "u → u (1 − threshold / |u|) where |u| > threshold, else 0",
    "torque_dead_zone": "tau → tau (1 − threshold / |tau|) where |tau| > threshold, else 0",
    "force_cutoff": "u → u where |u| ≥ threshold, else 0",
    "saturation": "u → u · min(1, limit / |u|)",
    "torque_saturation": "tau → tau · min(1, limit / |tau|)",
    "rate_limit": "|df/dt| ≤ rate, f follows u; f acts",
    "torque_rate_limit": "the same of the torque",
    "actuator_backlash": "f → min(max(f, u − threshold), u + threshold); f acts",
    "torque_backlash": "the same of the torque",
    "magnus_force": "F = coefficient · ω × v",
    "wind": "F = −coefficient · |v − w| (v − w)",
    "spring": "F = −stiffness · (position − anchor)",
    "torsion_spring": "torque = −stiffness · (θ − angle), by the shorter way round",
    "upper_stop": "torque = −stiffness · max(0, θ − angle)",
    "lower_stop": "torque = stiffness · max(0, angle − θ)",
    "cogging": "torque = cosine · cos(count θ) + sine · sin(count θ)",
    "mass_change": "m → factor · m from that time on, in that trajectory and later ones",
    "hidden_obstacle": "contact with a static disc at (x, y)",
    "distance_joint": "|position of (a_x, a_y) of the body − (b_x, b_y)| = length",
    "sensor_bias": "measured = state + bias",
    "sensor_scale": "measured = (length · x, length · y, angle · θ), rates likewise",
    "askew_camera": "measured place = (x, y) / (1 + along_x · x + along_y · y)",
    "encoder_eccentricity": "measured angle = θ + cosine · cos θ + sine · sin θ",
    "frame_rotation": "measured position and velocity = R(angle) · true ones; θ + angle",
    "heavy_tails": "noise of Student's t with 1 / inverse_nu degrees of freedom",
}
#: Effects that are often confused, and in which recordings.
LOOK_ALIKES = (
    (("pivot_damping", "angular_drag", "linear_drag"),
     "on one arm in a hinge they are the same data"),
    (("pivot_friction", "pivot_damping", "quadratic_drag"),
     "over a narrow range of speeds; record slow motion up to the stop, and fast motion"),
    (("slider_damping", "linear_drag"), "on one body on a rail they are the same data"),
    (("slider_friction", "sliding_friction"), "on a rail in a top view they are the same data"),
    (("linear_drag", "quadratic_drag", "sliding_friction"),
     "over a narrow range of speeds; record slow and fast motion"),
    (("angular_drag", "sliding_friction"), "over a narrow range of angular speeds"),
    (("gravity_tilt", "constant_force", "constant_torque", "com_offset", "sensor_bias",
      "frame_rotation", "torsion_spring"),
     "on one arm in a hinge at small angles: all move the angle of rest"),
    (("constant_force", "gravity_tilt"), "on a body of known mass; record bodies of two masses"),
    (("constant_force", "body_force"), "if the body hardly turns"),
    (("constant_force", "magnus_force"), "at one velocity and one angular speed"),
    (("constant_torque", "push_offset"), "if the push is the same all the time"),
    (("push_offset", "com_offset"), "both let a push turn the body; record turns without a push"),
    (("actuator_rotation", "frame_rotation"), "without gravity or walls; a known direction helps"),
    (("force_gain",), "the mass, if it is inferred: only their ratio shows; weigh the body"),
    (("force_gain", "sensor_scale"), "lengths measured too large look like pushes too strong"),
    (("force_gain", "anisotropic_gain"), "if pushes go along one axis alone"),
    (("force_gain", "mass_change"), "if the load is there from the first row on"),
    (("force_gain", "saturation"), "if all pushes are above the limit; push weakly, too"),
    (("inertia_scale", "torque_gain"), "if only commanded torques turn the body"),
    (("inertia_scale", "com_offset"), "in a hinge: both change how hard the arm is to turn"),
    (("dead_zone", "force_cutoff", "sliding_friction"),
     "a weak push does nothing; record strong pushes, and motion without any"),
    (("sliding_friction", "wheel"), "if the friction along the wheel is that across it"),
    (("actuator_delay",),
     "a late sensor: with one clock in the log the two are the same data; a motor's lag"),
    (("spring", "constant_force"), "if the anchor is far beyond the motion"),
    (("spring", "distance_joint"), "a stiff cable that is always taut"),
    (("hidden_obstacle", "heavy_tails"), "if there are few hits; record more of them"),
    (("pivot_friction", "pivot_load_friction", "pivot_stribeck"),
     "over a narrow range of speeds and torques; vary both"),
    (("pivot_friction", "pivot_hysteresis"), "if the hinge turns far between its stops"),
    (("slider_friction", "slider_stribeck"), "over a narrow range of speeds"),
    (("angular_drag", "quadratic_angular_drag"), "over a narrow range of angular speeds"),
    (("linear_drag", "drag_by_axis"), "on a body that does not turn"),
    (("quadratic_drag", "quadratic_drag_by_axis", "wind"), "if the body moves one way alone"),
    (("sliding_friction", "sliding_stribeck", "turning_friction"),
     "if the body never stops, or does not turn"),
    (("actuator_delay", "first_order_lag", "rate_limit", "torque_rate_limit", "actuator_backlash",
      "torque_backlash"),
     "if commands change slowly; record steps of several sizes"),
    (("dead_zone", "torque_dead_zone", "torque_saturation"),
     "if commands have few sizes; record many"),
    (("torsion_spring", "upper_stop", "lower_stop", "cogging", "encoder_eccentricity"),
     "over a narrow range of angles"),
    (("sensor_scale", "askew_camera"), "if the body stays at a place"),
)  # fmt: skip
#: Measured rigs on which an effect was named; see the page on hardware.
FOUND = {
    "pivot_damping": "a hobby servo that turns a weight, a propeller on an arm",
    "pivot_friction": "a propeller on an arm, a double pendulum, a pole that swings",
    "pivot_load_friction": "a hobby servo that turns a weight",
    "pivot_stribeck": "a hobby servo that turns a weight",
    "quadratic_drag": "a table-tennis ball on a string, a swinging pole",
    "linear_drag": "a linear carriage",
    "first_order_lag": "a propeller on an arm",
    "turning_friction": "a puck that slides and turns",
}
#: What a recording must have for an effect, besides measurements of a dimension.
NEEDS = {
    "commands": "commands",
    "places": "places that the body passes again",
    "camera": "places from a camera",
}
#: Which bodies an effect suits, by the name of its condition.
APPLIES = {
    "always": "any body that moves freely",
    "is_pivoted": "a body that hangs in a hinge",
    "is_sliding": "a body that a slider holds",
    "is_unpivoted": "a body that hangs in no hinge",
    "is_unjoined": "a body that hangs in no hinge or slider",
    "_has_gravity": "any body, in a scene with `gravity`",
    "_is_pressed": "any body, in a scene with `normal_gravity` (a top view)",
    "_lies_free": "a body that hangs in no hinge, in a scene with `normal_gravity` (a top view)",
    "sends_wrenches": "a body without actuators",
    "_lacks_wheel": "a body without `wheel = true`, in a scene with `normal_gravity` (a top view)",
}
_ROLE = re.compile(r":(?:py:)?[a-z]+:<code>([^<]*)</code>")


def on_files(files: Any, config: Any) -> Any:
    """Add the reference's pages."""
    from mkdocs.structure.files import File

    sys.path.insert(0, str(Path(__file__).parent))  # a hook is no package
    import gallery

    pictures = {effect.name: gallery.picture(effect) for effect in catalogue}
    shown = {name: picture for name, picture in pictures.items() if picture is not None}
    for name, content in {**rooms(shown), "commands": command_page()}.items():
        files.append(File.generated(config, f"reference/{name}.md", content=content))
    for name, picture in shown.items():
        files.append(File.generated(config, f"reference/gallery/{name}.svg", content=picture))
    return files


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Convert roles of docstrings, such as ``:class:``, into links to public names."""
    # an example that is shown and not run begins with two colons
    return _ROLE.sub(_linked, html).replace("<p>::</p>", "")


def _linked(role: re.Match[str]) -> str:
    """Return a name as code, with a link if the reference has an entry of that name."""
    shown, _, target = role[1].rpartition(" &lt;")
    target = target.removesuffix("&gt;").lstrip("~")
    if not shown:
        shown = target.rpartition(".")[2] if role[1].startswith("~") else target
        shown = shown.removeprefix("pbrl_ppl.")
    # a public name's entry has the short path
    name = target if target.startswith("pbrl_ppl.") else f"pbrl_ppl.{target}"
    return f'<autoref identifier="{name}" optional><code>{shown}</code></autoref>'


def rooms(pictures: Collection[str] = ()) -> dict[str, str]:
    """Return the reference's pages: the public names of each room, and the errors.

    ``pictures`` are the names of the effects that have one.
    """
    found: dict[str, list[str]] = {}
    for statement in ast.parse((ROOT / "pbrl_ppl" / "__init__.pyi").read_text()).body:
        if isinstance(statement, ast.ImportFrom):
            names = found.setdefault(str(statement.module).partition(".")[0], [])
            names += [alias.name for alias in statement.names]
    public = {name for names in found.values() for name in names}
    tree = ast.parse((ROOT / "pbrl_ppl" / "errors.py").read_text())
    found["errors"] = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    pages = {}
    for room, names in found.items():
        path = ROOT / "pbrl_ppl" / room
        code = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        said = ast.get_docstring(ast.parse(code.read_text())) or ""
        paths = [
            f"pbrl_ppl.{name}" if name in public else f"pbrl_ppl.{room}.{name}" for name in names
        ]
        blocks = "".join(f"{_entry(path)}\n\n" for path in paths)
        pages[room] = f"# {room.capitalize()}\n\n{said}\n\n{blocks}"
        if room == "effects":
            pages[room] = f"{effects_page(pictures)}\n\n## In Python\n\n{said}\n\n{blocks}"
    return pages


def _entry(path: str) -> str:
    """Return what makes the entry of a public name; the catalogue's module has the same name."""
    if path != "pbrl_ppl.catalogue":
        return f"::: {path}"
    return (
        "## catalogue { #pbrl_ppl.catalogue }\n\nTuple of all effects above, each an"
        " [Effect][pbrl_ppl.Effect]. `(*pp.catalogue, mine)` adds one of yours."
    )


def effects_page(pictures: Collection[str] = ()) -> str:
    """Return the page of all effects of the catalogue, by stage."""
    text = [
        "# Effects", "",
        f"The catalogue has {len(catalogue)} effects. A body declares one by its name in the scene;"
        " `close-loop` finds those that are missing. For a law that is not here, write"
        " [an effect of your own](../guides/own_effect.md).", "",
        "```toml", "[[body]]", 'name = "cart"', 'effects = ["linear_drag"]', "```", "",
        "Default priors are in [natural units](formats.md#natural-units) of the body where a unit"
        " such as `force/speed` is given, so that they suit rigs of any size; `pbrl-ppl check`"
        " prints them in SI units. A body's `prior = { linear_drag_coefficient = { sigma = 2.0 } }`"
        " replaces one, in SI units. Places are counted from the body's mean position.", "",
        "In the formulas v is the velocity of the centroid, ω the angular velocity, u the commanded"
        " force, tau the commanded torque, m g the force on the floor, dt the sampling interval,"
        " and R(a) a rotation by the angle a.", "",
        "The search tries common effects first, and [unusual ones"
        "](../explanation/decisions.md#common-laws-first) only if they explain what common ones"
        " leave.", "",
        "| effect | group | stage | what it is |", "|---|---|---|---|",
    ]  # fmt: skip
    text += [
        f"| [`{effect.name}`](#{effect.name}) | {'unusual' if effect.unusual else 'common'} |"
        f" {_stage(effect)} | {effect.sentence} |"
        for effect in catalogue
    ]
    for stage in STAGES:
        said = (inspect.getdoc(stage) or "").partition("\n")[0]
        text += ["", f"## At the stage {stage.__name__.lower()}", "", said]
        those = [each for each in catalogue if isinstance(each.stage, stage)]
        text += [effect_entry(each, each.name in pictures) for each in those]
    return "\n".join(text)


def effect_entry(effect: Effect, picture: bool = False) -> str:
    """Return the entry of an effect: its law, parameters, look-alikes and declaration."""
    text = ["", f"### {effect.name}", "", f"{effect.sentence[0].upper()}{effect.sentence[1:]}.", ""]
    if picture:
        text += [f"![A motion with and without it, and the change](gallery/{effect.name}.svg)", ""]
    if effect.name in FORMULAS:
        text += [f"- Law: {FORMULAS[effect.name]}."]
    text += [
        f"- Source: {effect.reference}.",
        f"- On: {APPLIES.get(effect.applies.__name__, 'bodies that its condition names')}.",
        f"- Stage: {_stage(effect)}.",
        f'- In a scene: `effects = ["{effect.name}"]`.',
    ]
    if effect.unusual:
        text += [f"- Unusual: {effect.unusual}."]
    needs = (*effect.needs, *["commands"] * isinstance(effect.stage, Command))
    if needs:
        needed = ", ".join(NEEDS.get(name, f"measurements of {name}") for name in needs)
        text += [f"- A recording must have: {needed}."]
    if effect.name in FOUND:
        text += [f"- Found on: {FOUND[effect.name]}."]
    text += [f"- Its code: {len(_code(effect).splitlines()) - 2} lines."]
    if effect.log_odds:
        text += [
            f"- Prior odds: −{-effect.log_odds:g} nats beside common effects such as drag"
            " (`log_odds`)."
        ]
    for names, where in LOOK_ALIKES:
        if effect.name in names:
            others = ", ".join(f"[`{name}`](#{name})" for name in names if name != effect.name)
            text += [f"- Easily confused with {others + ': ' if others else ''}{where}."]
    head = "variable | unit | values | default prior | no effect at"
    text += ["", f"| {head} |", "|---|---|---|---|---|"]
    text += [_row(effect, parameter) for parameter in effect.parameters]
    return "\n".join([*text, "", '??? note "Its code"', "", _code(effect)])


def _stage(effect: Effect) -> str:
    return type(effect.stage).__name__.lower()


def _row(effect: Effect, parameter: EffectParameter) -> str:
    """Return a parameter's row: its variable, unit, support, prior and null value."""
    prior, unit = parameter.prior, "" if parameter.unit == "1" else parameter.unit
    over, _, under = parameter.scale.partition("/")
    scale = f"{over}/({under})" if " " in under else parameter.scale
    low, high = prior.support
    support = "angles" if prior.uniform else f"{low:g} to {high:g}".replace("inf", "∞")
    null = f"{parameter.null:g}{' ' + scale if scale and parameter.null else ''}"
    words = prior.in_words(scale or parameter.unit)
    cells = f"`{effect.variable(parameter)}`", unit, support.replace("-", "−"), words, null
    return f"| {' | '.join(cells)} |"


def _code(effect: Effect) -> str:
    """Return the functions of an effect's stage as an indented block of code."""
    made = [getattr(effect.stage, field.name) for field in fields(effect.stage)]
    code = "\n\n".join(
        _source(each)
        for each in made
        if callable(each) and getattr(each, "__name__", "") != "_no_discs"
    )
    return "\n".join(f"    {line}".rstrip() for line in ("```python", *code.split("\n"), "```"))


def _source(part: Callable[..., object]) -> str:
    """Return the code of a function, or of a value that is called, with its fields."""
    if inspect.isfunction(part):
        return inspect.getsource(part).rstrip()
    values = {name: getattr(value, "__name__", value) for name, value in vars(part).items()}
    said = [f"# self.{name} = {value}" for name, value in values.items()]
    return "\n".join([*said, textwrap.dedent(inspect.getsource(type(part).__call__)).rstrip()])


def command_page() -> str:
    """Return the page of all commands with their arguments and options."""
    text = ["# Commands", "", app.info.epilog or ""]
    made = typer.main.get_command(app).commands
    for each in app.registered_commands:
        name, example = str(each.name), str(each.epilog).removeprefix("Example: ")
        text += ["", f"## pbrl-ppl {name}", "", made[name].help or "", "", f"    {example}", ""]
        text += ["| argument or option | |", "|---|---|"]
        for each in made[name].params:
            flags = each.opts + each.secondary_opts
            shown = ", ".join(flags) if flags[0].startswith("-") else str(each.name).upper()
            said = " ".join((getattr(each, "help", None) or "").split()).replace("|", "\\|")
            text.append(f"| `{shown}` | {said} |")
    return "\n".join(text)
