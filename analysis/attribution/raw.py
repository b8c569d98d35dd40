"""Raw logs beside the project, and what a new user does to read them."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pbrl_ppl as pp
from attribution.measured import SHARED, Recording
from pbrl_ppl.history import read_recording


@dataclass(frozen=True)
class Raw(Recording):
    """A log as another program wrote it: one command writes its scene, one edit completes it.

    Parameters
    ----------
    train, test : str
        Files or folders below ``folder``; without ``test`` the loop holds trajectories out.
    new : tuple of str
        Options of ``pbrl-ppl new`` beside ``--history``.
    edits : tuple of (str, str)
        Beginning of a line of the scene that was written, and the line in its place, in order.
    more : str
        TOML at the end of the scene.
    """

    train: str = ""
    test: str = ""
    new: tuple[str, ...] = ()
    edits: tuple[tuple[str, str], ...] = ()
    more: str = ""

    @property
    def is_there(self) -> bool:
        """Whether its files are."""
        return (self.folder / self.train).exists()

    @property
    def inputs(self) -> tuple[Any, ...]:
        """What the loop's result depends on beside the files."""
        return self.train, self.test, self.new, self.edits, self.more

    def load(self) -> tuple[pp.Scene, pp.History, pp.History | None]:
        """Return scene, train and, if there is one, test, by the command line.

        Raises
        ------
        ValueError
            With what the command says, if it fails, or if the scene lacks a line to edit.
        """
        log = self.folder / self.train
        with tempfile.TemporaryDirectory() as here:
            path = Path(here) / "scene.toml"
            command = [sys.executable, "-m", "pbrl_ppl", "new", path, "--history", log, *self.new]
            done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
            if done.returncode:
                said = done.stderr.strip().removeprefix("error: ")
                raise ValueError(said.replace(f"{self.folder}/", ""))
            path.write_text(self.edited(path.read_text()))
            scene = pp.Scene.load(path)
        test = read_recording(self.folder / self.test, scene) if self.test else None
        return scene, read_recording(log, scene), test

    def edited(self, text: str) -> str:
        """Return a scene's text with the edits."""
        lines = text.splitlines()
        for begin, line in self.edits:
            places = [place for place, old in enumerate(lines) if old.startswith(begin)]
            if not places:
                raise ValueError(f"the scene that `new` wrote has no line that begins {begin!r}")
            lines[places[0]] = line
        return "\n".join([*lines, self.more, ""])


def _weighed(mass: float) -> tuple[str, str]:
    """Return the edit that gives a body its mass (kg)."""
    return "# known = { mass", f"known = {{ mass = {mass} }}"


def _bob(name: str, *new: str, edits: tuple[tuple[str, str], ...] = ()) -> Raw:
    """Return the log of a bob of 0.5 kg that hangs by 0.3 m from a hinge with dry friction."""
    return Raw(
        name,
        _FOLDER,
        laws=("pivot_friction",),
        train=f"{name}.csv",
        new=(*new, "--side", "--body", "bob=circle:0.01"),
        edits=(_weighed(0.5), ("anchor_a", "anchor_a = [0.0, 0.3]"), *edits),
    )


_FOLDER = SHARED / "raw"
#: The raw logs, in the order of their README, which has the truth.
RAW = (
    _bob("semicolon_comma_bom", edits=(("anchor_b", "anchor_b = [0.0, 0.0]"),)),
    _bob("resets_nan_doubles", "--columns", "torque=u"),
    _bob("two_clocks_ms"),
    _bob("burst_stamps", "--columns", "theta=theta_rad"),
    Raw(
        "ros_pose",
        _FOLDER,
        laws=("sliding_friction", "actuator_delay"),
        also=("turning_friction",),  # of the same floor
        train="ros_pose.csv",
        new=("--commands", "ros_cmd.csv", "--top", "--body", "puck=circle:0.04"),
        edits=(_weighed(0.2), ("[recording]", '[recording]\nforces = "body"')),
    ),
    Recording(
        "coast",
        _FOLDER / "coast",
        laws=("quadratic_drag",),
        same_data={"quadratic_drag": ("quadratic_drag_by_axis",)},
    ),
    Raw(
        "count16-wrap",
        _FOLDER / "count16-wrap",
        laws=("pwm_dead_zone",),
        same_data={"pwm_dead_zone": ("torque_dead_zone",)},
        train="train.csv",
        test="test.csv",
        new=(
            *("--columns", "time=millis,theta=count", "--units", "time=ms,theta=8192/turn"),
            *("--top", "--body", "wheel=circle:0.05"),
        ),
        edits=(
            _weighed(1.68),
            ("anchor_a", "anchor_a = [0.0, 0.0]"),
            ("# known = { gain", "prior = { loss = { sigma = 0.1 } }"),
        ),
    ),
    Raw(
        "speed-overflow",
        _FOLDER / "speed-overflow",
        laws=("slider_damping", "slider_friction"),
        same_data={"slider_damping": ("linear_drag",), "slider_friction": ("sliding_friction",)},
        train="train.csv",
        test="test.csv",
        new=(
            *("--columns", "time=profileTime,x=position,vx=velocity"),
            *("--units", "x=54324.89/m,vx=54324.89/m", "--top", "--body", "carriage=box:0.3x0.2"),
        ),
        edits=(_weighed(4.2),),
        more="""
[[joint]]
kind = "slider"
bodies = ["carriage", "world"]
anchor_a = [0.0, 0.0]
anchor_b = [0.0, 0.0]
axis = [1.0, 0.0]

[[actuator]]
name = "power"
kind = "thruster"
body = "carriage"
at = [0.0, 0.0]
""",
    ),
    Raw(
        "no-load-speed",
        _FOLDER / "no-load-speed",
        laws=("pivot_damping", "pivot_friction"),
        same_data={"pivot_damping": ("angular_drag",), "pivot_friction": ("turning_friction",)},
        train="train.csv",
        test="test.csv",
        new=("--columns", "omega=speed [rad/s]", "--top", "--body", "rotor=circle:0.1"),
        edits=(_weighed(2.4),),
        more="""
[[joint]]
kind = "hinge"
bodies = ["rotor", "world"]
anchor_a = [0.0, 0.0]
anchor_b = [0.0, 0.0]
""",
    ),
    Raw(
        "slow-motion",
        _FOLDER,
        laws=("quadratic_drag",),
        train="slow-motion",
        new=("--units", "time=8/s", "--side", "--body", "ball=circle:0.02"),
        edits=(_weighed(0.0027),),
    ),
    Raw(
        "spring",
        _FOLDER / "spring",
        laws=("sliding_friction",),
        train="data_HarmOsc3.txt",
        new=("--columns", "time=0,x=1", "--top", "--body", "weight=box:0.05x0.05"),
        edits=(_weighed(1.0), ("# effects", 'effects = ["spring"]')),
    ),
)
