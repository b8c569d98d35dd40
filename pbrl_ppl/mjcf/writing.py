"""Scenes of posteriors as MJCF, for domain randomisation."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import Any

import numpy as np

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import ConversionWarning, SceneError, warn
from pbrl_ppl.history.mujoco import PLANES
from pbrl_ppl.mjcf.reading import rotation, rounded
from pbrl_ppl.posterior import Idata, labelled_draws, layout_of, scene_of
from pbrl_ppl.scene import WORLD, Body, Joint, Scene
from pbrl_ppl.state import Floats


def mjcf_ranges(
    idata: Idata,
    plane: str = "xy",
    *,
    probability: float = 0.9,
    depth: float = 0.1,
    effects: Iterable[Effect] = catalogue,
) -> tuple[str, dict[str, dict[str, list[float]]]]:
    """Return a posterior's scene as MJCF, and ranges of its parameters to randomise within.

    The model has each body at its posterior mean: mass, moment of inertia and centre of mass,
    friction in contacts (MuJoCo takes the larger one of two geoms, the scene their product), and
    the damping and dry friction of its joints (``pivot_damping``, ``pivot_friction``,
    ``slider_damping``, ``slider_friction``, ``linear_drag``, ``angular_drag``). In its
    reference configuration all angles are zero (a slider's as in the poses), so that positions of
    its hinges are the scene's angles, those of a chain relative to the body above, and positions of
    sliders the distances of their anchors along the axis.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, or the loop's ``after.nc``.
    plane : str
        Where the scene lies in MuJoCo's world: ``xy``, or ``xz`` with z upwards.
    probability : float
        Of the ranges: 0.9 gives the quantiles of 5 % and 95 %.
    depth : float
        Size of bodies across the plane (m).
    effects : iterable of Effect
        Where the names of the model's effects are looked up; add your own to the package's.

    Returns
    -------
    text : str
        MJCF.
    ranges : dict of str to dict of str to list of float
        Lower and upper end by body and parameter, for JSON: each that was inferred, in SI units,
        and ``inertia``, about the centre of mass (kg m^2). They ignore dependence between
        parameters; draws of the posterior keep it.

    Raises
    ------
    PosteriorError
        If the posterior holds no scene.
    SceneError
        If ``plane`` or ``probability`` is impossible.

    Warns
    -----
    ConversionWarning
        Lists what MJCF leaves out: effects other than those above, wheels, joints that are no known
        hinges or sliders. Restitution is in the ranges alone, since MuJoCo has none.

    Examples
    --------
    ::

        text, ranges = pp.mjcf_ranges(pp.load_posterior("report/after.nc"))
        Path("cart.xml").write_text(text)
        ranges["cart"]["mass"]  # [2.31, 2.38]
    """
    if plane not in PLANES:
        raise SceneError(f"plane is {plane!r}, expected xy (a top view) or xz (a side view)")
    if not 0 < probability < 1:
        raise SceneError(f"probability is {probability!r}, expected between 0 and 1")
    scene, draws = scene_of(idata), labelled_draws(idata)
    known: dict[str, dict[str, Floats]] = {}
    for body in scene.moving:
        values: dict[str, Any] = dict(body.known)
        for block in layout_of(idata, effects).blocks:
            for owner in (body.owner, body.name):
                if block.of == "body" and f"{block.name}[{owner}]" in draws:
                    values[block.name] = draws[f"{block.name}[{owner}]"]
        if "mass" in values:
            scale = values.get("inertia_scale_scale", 1.0)
            values["inertia"] = values["mass"] * body.shape.unit_moment * scale
        known[body.name] = values
    tails = (1 - probability) / 2, (1 + probability) / 2
    ranges = {
        body: {
            name: [float(end) for end in np.quantile(drawn, tails)]
            for name, drawn in values.items()
            if np.size(drawn) > 1
        }
        for body, values in known.items()
    }
    means = {
        body: {name: float(np.mean(drawn)) for name, drawn in values.items()}
        for body, values in known.items()
    }
    text, left_out = _Writer(scene, means, PLANES[plane], depth).write()
    if left_out:
        warn("the MJCF of the scene leaves out: " + "; ".join(left_out), ConversionWarning)
    return text, ranges


class _Writer:
    """MJCF of a scene with these values of its bodies' parameters."""

    def __init__(
        self, scene: Scene, values: dict[str, dict[str, float]], axes: Floats, depth: float
    ) -> None:
        self.scene, self.values, self.axes, self.depth = scene, values, axes, depth
        self.left_out: list[str] = []
        self.root = ET.Element("mujoco", model="scene")
        step = scene.time_step / scene.substeps
        gravity = axes.T @ (*scene.gravity, -scene.normal_gravity)
        ET.SubElement(self.root, "option", timestep=f"{step:.9g}", gravity=_text(gravity))
        self.asset = ET.SubElement(self.root, "asset")
        self.world = ET.SubElement(self.root, "worldbody")

    def write(self) -> tuple[str, list[str]]:
        """Return the text, and what it leaves out."""
        for number, wall in enumerate(self.scene.walls, start=1):
            middle, half = np.add(wall.start, wall.end) / 2, np.subtract(wall.end, wall.start) / 2
            size = np.hypot(*half), 1e-3 * np.hypot(*half), self.depth / 2
            place = self.placed(middle, math.atan2(half[1], half[0]))
            self.box(self.world, f"wall{number}", size, place)
        #: Elements, and angles in the reference configuration, of the bodies so far.
        self.elements: dict[str, ET.Element] = {WORLD: self.world}
        self.angles: dict[str, float] = {WORLD: 0.0}
        free = [body.name for body in self.scene.dynamic]
        for body in self.scene.bodies:
            if body.name not in free:
                x, y, theta = body.pose or (0.0, 0.0, 0.0)
                mocap = {"mocap": "true"} if body.kinematic else {}
                self.add(body, self.world, self.placed((x, y), theta) | mocap)
                self.angles[body.name] = theta
        joints = self.hinges()
        while free or joints:
            for joint in joints:
                a, b = joint.bodies or ("", "")
                if (a in self.elements) != (b in self.elements):
                    self.hang(joint, *((a, b) if a in self.elements else (b, a)))
                    free.remove(b if b in free else a)
                    joints.remove(joint)
                    break
                if a in self.elements:
                    self.connect(joint)
                    joints.remove(joint)
                    break
            else:
                self.release(self.scene.body(free.pop(0)))
        if not len(self.asset):
            self.root.remove(self.asset)
        ET.indent(self.root)
        return ET.tostring(self.root, encoding="unicode") + "\n", self.left_out

    def hinges(self) -> list[Joint]:
        """Return the known hinges and sliders; list other joints as left out."""
        kept = []
        for name, joint in zip(self.scene.joint_names, self.scene.joints, strict=True):
            if joint.traits.hangs and joint.known:
                kept.append(joint)
            else:
                self.left_out.append(
                    f'joint "{name}", which is not a hinge or slider with known anchors'
                )
        return kept

    def release(self, body: Body) -> None:
        """Add a free body."""
        x, y, _ = body.pose or (0.0, 0.0, 0.0)
        element = self.add(body, self.world, self.placed((x, y), 0.0))
        values = self.values[body.name]
        drag, turning = (values.get(f"{e}_drag_coefficient", 0.0) for e in ("linear", "angular"))
        for axis, kind, damping in ((0, "slide", drag), (1, "slide", drag), (2, "hinge", turning)):
            joint = {"name": f"{body.name}_{('x', 'y', 'theta')[axis]}", "type": kind}
            attributes = {"axis": _text(self.axes[axis]), "damping": f"{damping:.9g}"}
            element.insert(axis, ET.Element("joint", joint | attributes))
        self.list_effects(body, {"linear_drag", "angular_drag"})

    def hang(self, joint: Joint, parent: str, name: str) -> None:
        """Add a body that hangs in a hinge or slider on another."""
        body, values = self.scene.body(name), self.values[name]
        above, below = joint.anchor_a or (0.0, 0.0), joint.anchor_b or (0.0, 0.0)
        if joint.bodies == (name, parent):
            above, below = below, above
        slides = joint.traits.slides
        turn = -self.angles[parent]
        if slides:
            turn = self.scene.reference_angle(name) - self.scene.reference_angle(parent)
        place = np.asarray(above) - rotation(turn) @ below
        element = self.add(body, self.elements[parent], self.placed(place, turn))
        self.angles[name] = self.angles[parent] + turn
        axis, use, drag, dry = self.axes[2], "pivot", "angular_drag", "pivot_friction_torque"
        if slides:
            angle = self.scene.direction(joint) - self.scene.reference_angle(name)
            axis = self.axes[:2].T @ (math.cos(angle), math.sin(angle))
            use, drag, dry = "slider", "linear_drag", "slider_friction_force"
        damping = values.get(f"{use}_damping_coefficient", 0.0)
        known = {f"{use}_damping", f"{use}_friction"}
        if not self.moves(parent):
            damping += values.get(f"{drag}_coefficient", 0.0)
            known |= {drag}
        attributes = {
            "name": f"{name}_slide" if slides else f"{name}_theta",
            "type": "slide" if slides else "hinge",
            "axis": _text(axis),
            "pos": _text(self.axes[:2].T @ below),
            "damping": f"{damping:.9g}",
            "frictionloss": f"{values.get(dry, 0.0):.9g}",
        }
        element.insert(0, ET.Element("joint", attributes))
        self.list_effects(body, known)

    def moves(self, name: str) -> bool:
        return any(body.name == name for body in self.scene.moving)

    def connect(self, joint: Joint) -> None:
        """Close a loop of hinges."""
        if joint.traits.slides:
            self.left_out.append(f"the slider of {joint.bodies}, which closes a loop")
            return
        a, b = joint.bodies or ("", "")
        first, anchor = (a, joint.anchor_a) if a != WORLD else (b, joint.anchor_b)
        second = {"body2": b} if first == a and b != WORLD else {}
        equality = self.root.find("equality")
        if equality is None:
            equality = ET.SubElement(self.root, "equality")
        place = _text(self.axes[:2].T @ (anchor or (0.0, 0.0)))
        ET.SubElement(equality, "connect", {"body1": first, "anchor": place, **second})

    def add(self, body: Body, parent: ET.Element, place: dict[str, str]) -> ET.Element:
        """Add a body with its inertia and geom."""
        element = ET.SubElement(parent, "body", {"name": body.name, **place})
        self.elements[body.name], self.angles[body.name] = element, 0.0
        values = self.values.get(body.name, {})
        if "mass" in values:
            centre = [values.get(f"com_offset_{axis}", 0.0) for axis in "xy"]
            # in the plane, moments about its axes do not matter
            ET.SubElement(
                element,
                "inertial",
                pos=_text(self.axes[:2].T @ centre),
                mass=f"{values['mass']:.9g}",
                diaginertia=_text([values["inertia"]] * 3),
            )
        friction = {"friction": f"{values['mu_c']:.9g}"} if "mu_c" in values else {}
        self.geom(body, element, friction)
        if body.wheel:
            self.left_out.append(f'the wheel of body "{body.name}"')
        return element

    def geom(self, body: Body, element: ET.Element, more: dict[str, str]) -> None:
        """Add a body's outline, drawn out to its depth."""
        shape, half = body.shape, self.depth / 2
        if shape.size is not None:
            width, height = shape.size
            self.box(element, body.name, (width / 2, height / 2, half), more)
        elif shape.radius is not None:
            round_ = {"type": "cylinder", "size": _text((shape.radius, half))}
            upright = {"zaxis": _text(self.axes[2])}
            ET.SubElement(element, "geom", {"name": body.name, **round_, **upright, **more})
        else:
            corners = [(*p, z) for z in (-half, half) for p in shape.vertices or ()]
            vertices = _text((np.array(corners) @ self.axes).ravel())
            ET.SubElement(self.asset, "mesh", name=body.name, vertex=vertices, inertia="convex")
            # a mesh's geom is about its centre, which is the outline's centroid
            mesh = {"name": body.name, "type": "mesh", "mesh": body.name}
            ET.SubElement(element, "geom", {**mesh, **more})

    def box(self, parent: ET.Element, name: str, size: Any, more: dict[str, str]) -> None:
        """Add a box of these half sizes along the plane's axes and across it."""
        sizes = _text(np.abs(self.axes.T @ np.asarray(size)))
        ET.SubElement(parent, "geom", {"name": name, "type": "box", "size": sizes, **more})

    def placed(self, place: Any, theta: float) -> dict[str, str]:
        """Return the attributes of a place in the plane, and of an angle."""
        turn = (math.cos(theta / 2), *(math.sin(theta / 2) * self.axes[2]))
        return {"pos": _text(self.axes[:2].T @ np.asarray(place)), "quat": _text(turn)}

    def list_effects(self, body: Body, known: set[str]) -> None:
        """List effects of a body that the model leaves out."""
        lost = sorted({*body.effects} - known - {"inertia_scale", "com_offset"})
        self.left_out += [f'effect {name} of body "{body.name}"' for name in lost]


def _text(numbers: Any) -> str:
    """Return numbers as MJCF has them."""
    return " ".join(f"{rounded(number):.9g}" for number in numbers)
