"""Planar scenes of MuJoCo models, in MJCF or URDF.

MuJoCo reads the models: ``pip install mujoco``. Nothing here is needed to read the arrays of its
rollouts, see :func:`from_mujoco`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mujoco_bridge.rollouts import FLAT, FREE, HINGE, PLANES, SLIDE
from pbrl_ppl.errors import PbrlWarning, SceneError, warn
from pbrl_ppl.scene import WORLD, Body, Joint, Scene, Shape, Wall
from pbrl_ppl.state import Floats, Ints

if TYPE_CHECKING:
    import mujoco


class ConversionWarning(PbrlWarning):
    """A scene of another simulator's model that leaves out what scenes do not have."""


#: mjtJoint in words.
_JOINTS = ("a free joint", "a ball joint", "a slide", "a hinge")


def scene_from_mjcf(
    source: str | Path | mujoco.MjModel,
    plane: str = "xy",
    *,
    known_mass: bool = False,
    time_step: float | None = None,
    shapes: Mapping[str, Shape] | None = None,
) -> Scene:
    """Return the planar scene of a MuJoCo model, in MJCF or URDF.

    Bodies keep their names. A body with a free joint, or with slides along both axes of the plane
    and a hinge about its normal, is free; one with a hinge or a slide alone has a hinge or slider
    to its parent or the world. Their damping and dry friction become the effects ``pivot_damping``
    and ``pivot_friction``, or ``slider_damping`` and ``slider_friction``, damping of equal slides
    ``linear_drag`` and of a free body's hinge ``angular_drag``. An inertia or a centre of mass that
    differs from that of an even outline becomes ``inertia_scale`` or ``com_offset``. The priors of
    these effects, and of the masses, are about the model's values. Geoms of the world become walls
    (planes) and static bodies (others).

    Parameters
    ----------
    source : str, Path or mujoco.MjModel
        A file, XML text, or a compiled model.
    plane : str
        ``xy``, a top view, or ``xz``, a side view, whose angle turns from x to z.
    known_mass : bool
        Whether the model's masses are given (``known``) rather than inferred.
    time_step : float, optional
        Of the scene (s), the time between samples; the model's time step by default.
    shapes : mapping of str to Shape, optional
        Outlines of bodies by name in place of their geoms', about their centres of mass.

    Returns
    -------
    Scene
        Each body's ``pose`` is that in the model's reference configuration (``qpos0``).

    Raises
    ------
    SceneError
        If the model cannot be read, a body does not move in the plane as above, has no geom or
        several, or one without an outline (a capsule across the view, a mesh), or MuJoCo is not
        installed.

    Warns
    -----
    ConversionWarning
        Lists what the scene leaves out: joint limits, springs, actuators' dynamics, constraints.

    Examples
    --------
    ::

        scene = scene_from_mjcf("arm.xml", plane="xz", time_step=0.02)
        Path("scene.toml").write_text(scene.to_toml())
    """
    if plane not in PLANES:
        raise SceneError(f"plane is {plane!r}, expected xy (a top view) or xz (a side view)")
    seen = _View(_compiled(source), PLANES[plane], dict(shapes or {}))
    model = seen.model
    moving = [i for i in range(1, model.nbody) if model.body_weldid[i] == i]
    if lost := sorted({*seen.shapes} - {seen.name(i) for i in moving}):
        raise SceneError(
            f"shapes names {', '.join(lost)}, which is no moving body of the MuJoCo model; its"
            f" moving bodies are {', '.join(seen.name(i) for i in moving)}"
        )
    read = [seen.body(i, known_mass) for i in moving]
    static, walls = seen.world(moving)
    seen.list_left_out()
    across = PLANES[plane] @ np.asarray(model.opt.gravity)
    scene = Scene(
        time_step=float(model.opt.timestep if time_step is None else time_step),
        gravity=(rounded(across[0]), rounded(across[1])),
        normal_gravity=rounded(abs(across[2])),
        bodies=(*(body for body, _ in read), *static),
        walls=tuple(walls),
        joints=tuple(joint for _, joint in read if joint is not None),
    )
    if seen.left_out:
        left_out = "; ".join(seen.left_out)
        warn(f"the scene of the MuJoCo model leaves out: {left_out}", ConversionWarning)
    return scene


def _compiled(source: str | Path | mujoco.MjModel) -> mujoco.MjModel:
    """Return a compiled model of a file, text or model."""
    try:
        import mujoco
    except ImportError:
        raise SceneError("a scene of a MuJoCo model needs MuJoCo: pip install mujoco") from None
    if not isinstance(source, str | Path):
        if not isinstance(source, mujoco.MjModel):
            raise SceneError(f"{source!r} is no MuJoCo model; expected a path, XML text or MjModel")
        return source
    is_text = isinstance(source, str) and source.lstrip().startswith("<")
    if not is_text and not Path(source).is_file():
        raise SceneError(f"{source}: there is no such file; check the path")
    read = mujoco.MjModel.from_xml_string if is_text else mujoco.MjModel.from_xml_path
    try:
        return read(str(source))
    except ValueError as error:
        where = "MuJoCo model" if is_text else f"MuJoCo model {source}"
        raise SceneError(f"{where}: cannot be read: {' '.join(str(error).split())}") from None


def rotation(angle: float) -> Floats:
    """Return the matrix of a rotation in the plane (2, 2)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def rounded(value: float) -> float:
    """Return a number without the rounding errors of rotations."""
    return float(f"{float(value):.9g}") if abs(value) > 1e-12 else 0.0


def pair(point: Iterable[float]) -> tuple[float, float]:
    """Return a point of the plane, rounded."""
    x, y = (rounded(round(float(value), 12)) for value in point)
    return x, y


class _View:
    """A model in its reference configuration, seen in a plane, with what a scene leaves out.

    ``axes`` are the plane's axes and its normal (3, 3). Differences of mass distributions from an
    outline's are none up to a share ``even``.
    """

    def __init__(
        self, model: mujoco.MjModel, axes: Floats, shapes: dict[str, Shape], *, even: float = 0.01
    ) -> None:
        import mujoco

        self.model, self.data, self.axes, self.shapes = model, mujoco.MjData(model), axes, shapes
        self.types = mujoco.mjtGeom
        mujoco.mj_forward(model, self.data)
        self.left_out, self.even = list[str](), even
        self.poses: dict[int, tuple[Floats, float]] = {}

    def name(self, i: int) -> str:
        return str(self.model.body(i).name) or f"body{i}"

    def parent(self, i: int) -> int:
        """Return the moving body that holds a body; 0 is the world."""
        return int(self.model.body_weldid[self.model.body_parentid[i]])

    def kinds(self, i: int) -> Ints:
        """Return the kinds of a body's joints."""
        first = int(self.model.body_jntadr[i])
        return np.asarray(self.model.jnt_type[first : first + int(self.model.body_jntnum[i])])

    def place(self, point: ArrayLike) -> Floats:
        """Return a point of MuJoCo's world in the plane (2,)."""
        flat: Floats = self.axes[:2] @ np.asarray(point)
        return flat

    def geom_name(self, g: int) -> str:
        return str(self.model.geom(g).name) or f"geom{g}"

    def geom_kind(self, g: int) -> str:
        """Return the name of the kind of a geom: ``box``, ``hfield``, ``mesh``."""
        return str(self.types(self.model.geom_type[g]).name).removeprefix("mjGEOM_").lower()

    def body(self, i: int, known_mass: bool) -> tuple[Body, Joint | None]:
        """Return a moving body, with those that are welded to it, and its hinge, if any.

        Bodies are asked for in their order, so that a parent comes before its children.
        """
        name, held = self.name(i), self.held(i)
        theta = self.angle(i)
        mass, centre, moment = self.inertia(i)
        shape, origin = self.outline(i, theta, centre)
        self.poses[i] = origin, theta
        prior = {} if known_mass else {"mass": {"mu": rounded(math.log(mass)), "sigma": 1.5}}
        size = shape.bounding_radius
        scale = moment / (mass * shape.unit_moment)
        if abs(math.log(scale)) > self.even:
            prior["inertia_scale_scale"] = {"mu": rounded(math.log(scale)), "sigma": 0.1}
        offset = rotation(-theta) @ (centre - origin)
        if np.abs(offset).max() > self.even * size:
            for axis, value in zip("xy", offset, strict=True):
                prior[f"com_offset_{axis}"] = {"mu": rounded(value), "sigma": rounded(size / 10)}
        for label, value in self.friction(i, held is not None).items():
            prior[label] = {"mu": rounded(value), "sigma": rounded(value / 2)}
        if held is None and np.abs(self.place(self.data.xpos[i]) - origin).max() > FLAT * size:
            self.left_out.append(
                f'the frame of body "{name}", which is not at its outline\'s centroid: put it there'
                " before from_mujoco reads rollouts"
            )
        effects = [label.rpartition("_")[0] for label in prior if label != "mass"]
        body = Body(
            name,
            shape,
            known={"mass": rounded(mass)} if known_mass else (),  # type: ignore[arg-type]
            prior=prior,  # type: ignore[arg-type]
            effects=tuple(dict.fromkeys(effects)),
            pose=(*pair(origin), rounded(theta)),
        )
        if held is None:
            return body, None
        parent, anchor, way = held
        above, turn = self.poses.get(parent, (np.zeros(2), 0.0))
        other = self.name(parent) if parent else WORLD
        at_parent = pair(rotation(-turn) @ (anchor - above))
        at_child = pair(rotation(-theta) @ (anchor - origin))
        if way is None:
            return body, Joint("hinge", (other, name), at_parent, at_child)
        along = pair(rotation(-turn) @ way)
        return body, Joint("slider", (name, other), at_child, at_parent, axis=along)

    def angle(self, i: int) -> float:
        """Return a body's angle in the reference configuration.

        A free body's is that of its frame; of others it is the parent's, and zero on the world.
        """
        if parent := self.parent(i):
            return self.angle(parent)
        if self.kinds(i)[0] != FREE:
            return 0.0
        frame = self.axes @ self.data.xmat[i].reshape(3, 3) @ self.axes.T
        if frame[2, 2] < 1 - FLAT:
            raise SceneError(
                f'body "{self.name(i)}" is tilted out of the plane in the reference configuration;'
                " turn it into the plane, or choose the other plane"
            )
        return math.atan2(frame[1, 0], frame[0, 0])

    def held(self, i: int) -> tuple[int, Floats, Floats | None] | None:
        """Return parent (0 is the world), place (2,) and a slider's axis (2,); None if free."""
        model, kinds = self.model, self.kinds(i).tolist()
        parent, first = self.parent(i), int(model.body_jntadr[i])
        joints = range(first, first + len(kinds))
        across = [self.axes @ self.data.xaxis[j] for j in joints]
        where = f'body "{self.name(i)}"'
        expected = (
            "expected a free joint, two slides in the plane and a hinge about its normal, or one"
            " slide or hinge alone"
        )
        for kind, axis in zip(kinds, across, strict=True):
            flat = abs(axis[2]) > 1 - FLAT if kind == HINGE else abs(axis[2]) < FLAT
            if kind in (HINGE, SLIDE) and not flat:
                raise SceneError(
                    f"{where}: a joint of it leads out of the plane; {expected}. Choose the other"
                    " plane (xy or xz), or turn the model"
                )
        for j in joints:
            name = str(model.joint(j).name) or f"joint{j}"
            for there, what in (
                (model.jnt_limited[j], "limits"),
                (np.any(model.jnt_stiffness[j]), "spring (see the effect torsion_spring)"),
                (model.dof_armature[model.jnt_dofadr[j]], "armature"),
            ):
                if there:
                    self.left_out.append(f'the {what} of joint "{name}"')
        if kinds == [FREE]:
            return None
        if parent == 0 and sorted(kinds) == [SLIDE, SLIDE, HINGE]:
            a, b = (axis[:2] for axis, kind in zip(across, kinds, strict=True) if kind == SLIDE)
            if abs(a[0] * b[1] - a[1] * b[0]) > FLAT:
                return None
        if kinds in ([HINGE], [SLIDE]):
            way = across[0][:2] if kinds == [SLIDE] else None
            return parent, self.place(self.data.xanchor[first]), way
        names = ", ".join(_JOINTS[kind] for kind in kinds)
        above = f'on body "{self.name(parent)}"' if parent else "in the world"
        raise SceneError(f"{where}: it has {names} {above}; {expected}. Change its joints in MJCF")

    def friction(self, i: int, held: bool) -> dict[str, float]:
        """Return the coefficients of effects that the joints' damping and dry friction are."""
        model = self.model
        dofs = slice(int(model.body_dofadr[i]), int(model.body_dofadr[i] + model.body_dofnum[i]))
        damping = np.array([np.ravel(values)[0] for values in model.dof_damping[dofs]])
        dry = model.dof_frictionloss[dofs]
        kinds = self.kinds(i)
        if held:
            use, what = ("slider", "force") if kinds[0] == SLIDE else ("pivot", "torque")
            parameters = {
                f"{use}_damping_coefficient": damping[0],
                f"{use}_friction_{what}": dry[0],
            }
        else:
            # one coefficient for all slides
            slide, turn = damping[:3], damping[3:]
            if FREE not in kinds:
                slide, turn = damping[kinds == SLIDE], damping[kinds == HINGE]
            parameters = {
                "linear_drag_coefficient": slide.mean(),
                "angular_drag_coefficient": turn[0],
            }
            if np.ptp(slide) > self.even * slide.max():
                self.left_out.append(f'different damping along the slides of "{self.name(i)}"')
            if dry.any():
                self.left_out.append(
                    f'frictionloss of the joints of "{self.name(i)}" (see the effect'
                    " sliding_friction)"
                )
        return {name: float(value) for name, value in parameters.items() if value}

    def inertia(self, i: int) -> tuple[float, Floats, float]:
        """Return mass, centre of mass (2,), and moment about it, of a body and those welded to it.

        In kg, m and kg m^2.
        """
        model, normal = self.model, self.axes[2]
        parts = np.flatnonzero(model.body_weldid == i)
        masses = np.asarray(model.body_mass)[parts]
        places = np.array([self.place(self.data.xipos[part]) for part in parts])
        centre = masses @ places / masses.sum()
        moment = masses @ ((places - centre) ** 2).sum(axis=1)
        for part in parts:
            along = self.data.ximat[part].reshape(3, 3).T @ normal
            moment += along**2 @ model.body_inertia[part]
        return float(masses.sum()), centre, float(moment)

    def geoms(self, i: int) -> list[int]:
        """Return the geoms of a body and those welded to it: those that collide, or else all."""
        every = np.flatnonzero(self.model.body_weldid[self.model.geom_bodyid] == i).tolist()
        return [g for g in every if self.meets(g)] or every

    def meets(self, g: int) -> bool:
        return bool(self.model.geom_contype[g] or self.model.geom_conaffinity[g])

    def outline(self, i: int, theta: float, centre: Floats) -> tuple[Shape, Floats]:
        """Return a body's outline in its frame, and the place of its centroid (2,)."""
        name, geoms = self.name(i), self.geoms(i)
        if name in self.shapes:
            return self.shapes[name], centre
        if not geoms:
            raise SceneError(
                f'body "{name}" has no geom; give its outline in m about its centre of mass,'
                f' shapes={{"{name}": Shape.box(0.3, 0.1)}}, or, in a URDF, a <collision>'
            )
        cure = f'shapes={{"{name}": {self.box_about(geoms, theta)}}}'
        if len(geoms) > 1:
            names = ", ".join(self.geom_name(g) for g in geoms)
            raise SceneError(
                f'body "{name}" has {len(geoms)} geoms ({names}), and a body of a scene one'
                f" outline; keep one of them, or give its outline: {cure}"
            )
        shape = self.flat(geoms[0], theta)
        if shape is None:
            kind = self.geom_kind(geoms[0])
            raise SceneError(
                f'body "{name}": its geom "{self.geom_name(geoms[0])}" is a {kind} that has no'
                " circle or rectangle for an outline in this plane; make it a box or a cylinder, or"
                f" give its outline: {cure}"
            )
        return shape

    def flat(self, g: int, theta: float) -> tuple[Shape, Floats] | None:
        """Return a geom's outline in a frame that is turned by theta, and its centroid (2,)."""
        kind, size = self.geom_kind(g), self.model.geom_size[g]
        centre = self.place(self.data.geom_xpos[g])
        turned = self.axes @ self.data.geom_xmat[g].reshape(3, 3)  # its axes in columns
        upright, lying = abs(turned[2, 2]) > 1 - FLAT, abs(turned[2, 2]) < FLAT
        is_round = kind == "ellipsoid" and upright and abs(size[0] - size[1]) < FLAT * size[0]
        if kind == "sphere" or is_round or (kind in ("capsule", "cylinder") and upright):
            return Shape.circle(rounded(size[0])), centre
        if kind == "cylinder" and lying:
            along, half = turned[:2, 2], size[1::-1]
        elif kind == "box" and np.abs(turned[2]).max() > 1 - FLAT:
            first, second = (k for k in range(3) if k != np.abs(turned[2]).argmax())
            along, half = turned[:2, first], size[[first, second]]
        else:
            return None
        angle = math.atan2(along[1], along[0]) - theta
        quarter = round(angle / (math.pi / 2))
        width, height = map(rounded, 2 * (half[::-1] if quarter % 2 else half))
        if abs(angle - quarter * math.pi / 2) < FLAT:
            return Shape.box(width, height), centre
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half @ rotation(angle).T
        return Shape.polygon([pair(corner) for corner in corners]), centre

    def box_about(self, geoms: list[int], theta: float) -> str:
        """Return code of a box of the extent of geoms in a frame that is turned by theta."""
        turn = rotation(-theta) @ self.axes[:2]
        corners = np.concatenate([self.corners(g) for g in geoms]) @ turn.T
        width, height = np.ptp(corners, axis=0)
        return f"Shape.box({width:.3g}, {height:.3g})"

    def corners(self, g: int) -> Floats:
        """Return the corners (8, 3) of a geom's bounding box in MuJoCo's world."""
        box = np.asarray(self.model.geom_aabb[g])
        signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
        local = box[:3] + signs * box[3:]
        return np.asarray(self.data.geom_xpos[g] + local @ self.data.geom_xmat[g].reshape(3, 3).T)

    def world(self, moving: list[int]) -> tuple[list[Body], list[Wall]]:
        """Return the static bodies and walls that the world's geoms are."""
        model = self.model
        heights = [self.corners(g) @ self.axes[2] for i in moving for g in self.geoms(i)]
        low, high = (np.array([end(column) for column in heights]) for end in (np.min, np.max))
        bodies, walls, names = [], [], {self.name(i) for i in moving}
        for g in np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0).tolist():
            name = f'geom "{self.geom_name(g)}" of the world'
            if not self.meets(g):
                continue
            height, shape = self.corners(g) @ self.axes[2], self.flat(g, 0.0)
            thick = FLAT * np.ptp(height)
            if self.geom_kind(g) == "plane":
                turned = self.axes @ self.data.geom_xmat[g].reshape(3, 3)
                if abs(turned[2, 2]) < FLAT:
                    walls.append(self.wall(g, turned))
                elif abs(turned[2, 2]) > 1 - FLAT:
                    self.left_out.append(
                        f"friction on the floor, {name} (see the effect sliding_friction)"
                    )
                else:
                    self.left_out.append(f"{name}, a plane that is tilted against the view")
            elif not len(low) or np.any(
                (low < height.max() - thick) & (high > height.min() + thick)
            ):
                if shape is None:
                    self.left_out.append(f"{name}, which has no outline in this plane")
                    continue
                label = self.geom_name(g)
                label = f"{label} (world)" if label in names else label
                names.add(label)
                bodies.append(Body(label, shape[0], static=True, pose=(*pair(shape[1]), 0.0)))
            else:
                self.left_out.append(f"{name}, which is above or below all bodies")
        return bodies, walls

    def wall(self, g: int, turned: Floats) -> Wall:
        """Return the wall of an upright plane; an infinite one is ten times the model's size."""
        side = 0 if abs(turned[2, 0]) < abs(turned[2, 1]) else 1
        half = self.model.geom_size[g][side] or 10 * max(float(self.model.stat.extent), 1.0)
        middle, along = self.place(self.data.geom_xpos[g]), turned[:2, side] * half
        return Wall(pair(middle - along), pair(middle + along))

    def list_left_out(self) -> None:
        """List what the model as a whole has that a scene has not."""
        model = self.model
        for n in range(model.neq):
            self.left_out.append(f'equality constraint "{model.equality(n).name or n}"')
        self.left_out += [f'tendon "{model.tendon(n).name or n}"' for n in range(model.ntendon)]
        for i in np.flatnonzero(model.body_gravcomp):
            self.left_out.append(f'the gravity compensation of body "{self.name(int(i))}"')
        if model.opt.density or model.opt.viscosity or np.any(model.opt.wind):
            self.left_out.append("the medium (density, viscosity, wind; see linear_drag)")
