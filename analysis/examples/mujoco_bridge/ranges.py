"""Scenes of posteriors as MJCF, for domain randomisation."""

from __future__ import annotations

import math
from collections.abc import Iterable
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import ArrayLike

from mujoco_bridge.rollouts import PLANES
from mujoco_bridge.scenes import ConversionWarning, rotation, rounded
from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import SceneError, warn
from pbrl_ppl.posterior import Idata, labelled_draws, layout_of, scene_of
from pbrl_ppl.scene import WORLD, Body, Joint, Scene
from pbrl_ppl.state import Floats

#: Attributes of an element: text, a number or several numbers.
Attributes = dict[str, ArrayLike]


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

        text, ranges = mjcf_ranges(pp.load_posterior("report/after.nc"))
        Path("cart.xml").write_text(text)
        ranges["cart"]["mass"]  # [2.31, 2.38]
    """
    if plane not in PLANES:
        raise SceneError(f"plane is {plane!r}, expected xy (a top view) or xz (a side view)")
    if not 0 < probability < 1:
        raise SceneError(f"probability is {probability!r}, expected between 0 and 1")
    scene, draws = scene_of(idata), labelled_draws(idata)
    tails = (1 - probability) / 2, (1 + probability) / 2
    ranges: dict[str, dict[str, list[float]]] = {}
    means: dict[str, dict[str, float]] = {}
    for body in scene.moving:
        values: dict[str, float | Floats] = dict(body.known)
        for block in layout_of(idata, effects).blocks:
            for owner in (body.owner, body.name):
                if block.of == "body" and f"{block.name}[{owner}]" in draws:
                    values[block.name] = draws[f"{block.name}[{owner}]"]
        if "mass" in values:
            scale = values.get("inertia_scale_scale", 1.0)
            values["inertia"] = values["mass"] * body.shape.unit_moment * scale
        inferred = {name: drawn for name, drawn in values.items() if np.size(drawn) > 1}
        ranges[body.name] = {n: np.quantile(x, tails).tolist() for n, x in inferred.items()}
        means[body.name] = {name: float(np.mean(drawn)) for name, drawn in values.items()}
    text, left_out = _Writer(scene, means, PLANES[plane], depth).write()
    if left_out:
        warn("the MJCF of the scene leaves out: " + "; ".join(left_out), ConversionWarning)
    return text, ranges


class _Writer:
    """MJCF of a scene with these values of its bodies' parameters."""

    def __init__(
        self, scene: Scene, values: dict[str, dict[str, float]], axes: Floats, depth: float
    ) -> None:
        self.scene, self.values, self.axes, self.half = scene, values, axes, depth / 2
        self.left_out: list[str] = []
        self.root = Element("mujoco", model="scene")
        gravity = axes.T @ (*scene.gravity, -scene.normal_gravity)
        step = scene.time_step / scene.substeps
        _add(self.root, "option", timestep=step, gravity=gravity)
        self.asset, world = _add(self.root, "asset"), _add(self.root, "worldbody")
        #: Elements, and angles in the reference configuration, of the bodies so far.
        self.elements, self.angles = {WORLD: world}, {WORLD: 0.0}

    def write(self) -> tuple[str, list[str]]:
        """Return the text, and what it leaves out."""
        for number, wall in enumerate(self.scene.walls, start=1):
            middle, half = np.add(wall.start, wall.end) / 2, np.subtract(wall.end, wall.start) / 2
            size = np.hypot(*half), 1e-3 * np.hypot(*half)
            place = self.placed(middle, math.atan2(half[1], half[0]))
            self.box(self.elements[WORLD], f"wall{number}", size, place)
        free = [body.name for body in self.scene.dynamic]
        for body in self.scene.bodies:
            if body.name not in free:
                x, y, theta = body.pose or (0.0, 0.0, 0.0)
                mocap = {"mocap": "true"} if body.kinematic else {}
                self.fill(body, self.begin(body, WORLD, (x, y), theta, **mocap))
                self.angles[body.name] = theta
        joints = self.hinges()
        while free or joints:
            for joint in joints:
                a, b = joint.bodies or ("", "")
                if a in self.elements or b in self.elements:
                    if a in self.elements and b in self.elements:
                        self.connect(joint)
                    else:
                        parent, child = (a, b) if a in self.elements else (b, a)
                        self.hang(joint, parent, child)
                        free.remove(child)
                    joints.remove(joint)
                    break
            else:
                self.release(self.scene.body(free.pop(0)))
        if not len(self.asset):
            self.root.remove(self.asset)
        indent(self.root)
        return tostring(self.root, encoding="unicode") + "\n", self.left_out

    def hinges(self) -> list[Joint]:
        """Return the known hinges and sliders; list other joints as left out."""
        hung = [joint for joint in self.scene.joints if joint.traits.hangs and joint.known]
        self.left_out += [
            f'joint "{name}", which is not a hinge or slider with known anchors'
            for name, joint in zip(self.scene.joint_names, self.scene.joints, strict=True)
            if joint not in hung
        ]
        return hung

    def release(self, body: Body) -> None:
        """Add a free body."""
        element = self.begin(body, WORLD, (body.pose or (0.0, 0.0))[:2], 0.0)
        kinds = ("x", "slide", "linear"), ("y", "slide", "linear"), ("theta", "hinge", "angular")
        for axis, (name, kind, drag) in zip(self.axes, kinds, strict=True):
            damping = self.values[body.name].get(f"{drag}_drag_coefficient", 0.0)
            name = f"{body.name}_{name}"
            _add(element, "joint", name=name, type=kind, axis=axis, damping=damping)
        self.fill(body, element, {"linear_drag", "angular_drag"})

    def hang(self, joint: Joint, parent: str, name: str) -> None:
        """Add a body that hangs in a hinge or slider on another."""
        body, values = self.scene.body(name), self.values[name]
        above, below = joint.anchor_a or (0.0, 0.0), joint.anchor_b or (0.0, 0.0)
        if joint.bodies == (name, parent):
            above, below = below, above
        turn, axis = -self.angles[parent], self.axes[2]
        use, kind, drag, dry = "pivot", "hinge", "angular_drag", "pivot_friction_torque"
        if joint.traits.slides:
            reference = self.scene.reference_angle(name)
            turn = reference - self.scene.reference_angle(parent)
            angle = self.scene.direction(joint) - reference
            axis = self.axes[:2].T @ (math.cos(angle), math.sin(angle))
            use, kind, drag, dry = "slider", "slide", "linear_drag", "slider_friction_force"
        place = np.asarray(above) - rotation(turn) @ below
        element = self.begin(body, parent, place, turn)
        self.angles[name] = self.angles[parent] + turn
        damping = values.get(f"{use}_damping_coefficient", 0.0)
        known = {f"{use}_damping", f"{use}_friction"}
        if parent not in [moving.name for moving in self.scene.moving]:
            damping += values.get(f"{drag}_coefficient", 0.0)
            known |= {drag}
        _add(
            element,
            "joint",
            name=f"{name}_slide" if joint.traits.slides else f"{name}_theta",
            type=kind,
            axis=axis,
            pos=self.axes[:2].T @ below,
            damping=damping,
            frictionloss=values.get(dry, 0.0),
        )
        self.fill(body, element, known)

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
            equality = _add(self.root, "equality")
        place = self.axes[:2].T @ (anchor or (0.0, 0.0))
        _add(equality, "connect", body1=first, anchor=place, **second)

    def begin(self, body: Body, parent: str, place: ArrayLike, turn: float, **more: str) -> Element:
        """Add the element of a body, without content."""
        where = self.placed(place, turn)
        element = _add(self.elements[parent], "body", name=body.name, **where, **more)
        self.elements[body.name], self.angles[body.name] = element, 0.0
        return element

    def fill(self, body: Body, element: Element, effects: set[str] | None = None) -> None:
        """Add a body's inertia and geom; list what is left out of it, but for these effects."""
        values = self.values.get(body.name, {})
        more: Attributes = {}
        if "mass" in values:
            centre = [values.get(f"com_offset_{axis}", 0.0) for axis in "xy"]
            # in the plane, moments about its axes do not matter
            moments = [values["inertia"]] * 3
            place = self.axes[:2].T @ centre
            _add(element, "inertial", pos=place, mass=values["mass"], diaginertia=moments)
        if "mu_c" in values:
            more["friction"] = values["mu_c"]
        shape, name, half = body.shape, body.name, self.half
        if shape.size is not None:
            self.box(element, name, np.array(shape.size) / 2, more)
        elif shape.radius is not None:
            more = {"type": "cylinder", "size": (shape.radius, half), "zaxis": self.axes[2], **more}
            _add(element, "geom", name=name, **more)
        else:
            corners = [(*p, z) for z in (-half, half) for p in shape.vertices or ()]
            vertices = (np.array(corners) @ self.axes).ravel()
            _add(self.asset, "mesh", name=name, vertex=vertices, inertia="convex")
            # a mesh's geom is about its centre, which is the outline's centroid
            _add(element, "geom", name=name, type="mesh", mesh=name, **more)
        if body.wheel:
            self.left_out.append(f'the wheel of body "{name}"')
        if effects is not None:
            lost = sorted({*body.effects} - effects - {"inertia_scale", "com_offset"})
            self.left_out += [f'effect {one} of body "{name}"' for one in lost]

    def box(self, parent: Element, name: str, size: Iterable[float], more: Attributes) -> None:
        """Add a box of these half sizes along the plane's axes."""
        sizes = np.abs(self.axes.T @ (*size, self.half))
        _add(parent, "geom", name=name, type="box", size=sizes, **more)

    def placed(self, place: ArrayLike, theta: float) -> Attributes:
        """Return the attributes of a place in the plane, and of an angle."""
        turn = (math.cos(theta / 2), *(math.sin(theta / 2) * self.axes[2]))
        return {"pos": self.axes[:2].T @ np.asarray(place), "quat": turn}


def _add(parent: Element, tag: str, **attributes: ArrayLike) -> Element:
    """Add an element with attributes of text, a number or several numbers."""
    element = SubElement(parent, tag)
    for name, value in attributes.items():
        if not isinstance(value, str):
            numbers = map(rounded, np.asarray(value)) if np.ndim(value) else [value]
            value = " ".join(f"{number:.9g}" for number in numbers)
        element.set(name, value)
    return element
