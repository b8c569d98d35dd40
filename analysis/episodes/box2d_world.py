"""World simulated by Box2D: another engine than the agent's."""

from __future__ import annotations

import cmath
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, final

import numpy as np

from episodes.world import EpisodeError, World
from pbrl_ppl import Task
from pbrl_ppl.physics import scenery
from pbrl_ppl.scene import WORLD
from pbrl_ppl.state import Floats

try:
    with warnings.catch_warnings():  # its generated wrapper warns on import under newer Pythons
        warnings.simplefilter("ignore", DeprecationWarning)
        import Box2D
except ImportError as error:  # an optional dependency
    raise EpisodeError(
        f"Box2D world: {error}; install Box2D: pip install 'pbrl_ppl[paper]'"
    ) from None


#: Box2D's tolerances are compiled in: nothing bounces below 1 length unit per second, and overlaps
#: up to 0.005 units remain. With the centimetre as unit they are 1 cm/s and 0.05 mm.
_CM = 100.0
#: Largest number of corners of a polygon in Box2D.
_CORNERS = 8
#: Engine steps in a time step by default.
_STEPS = 250
#: Iterations of the engine's velocity and position solvers, and of the wheel's solver.
_ITERATIONS, _WHEEL_ITERATIONS = (20, 10), 10


@final
class Box2DWorld(World):
    """True dynamics of a task by Box2D, with the floor's friction on wheels added.

    The paper's worlds are of this kind. Wrenches and wheels are computed here, contacts and hinges
    by Box2D, in single precision. As in the package's engine, friction and restitution of a contact
    are products of the two bodies' values, and walls have 1.

    Parameters
    ----------
    task, parameters, sigma, spread
        See :class:`World`.
    step : float, optional
        Approximate step of the engine (s); a 250th of the scene's time step by default.
    acting : callable, optional
        Maps the commanded wrenches (body, 3) to those that act: an effect unknown to agents. Its
        ``repr`` describes it in the files of episodes.

    Raises
    ------
    EpisodeError
        As :class:`World`; if the scene has declared effects, a joint that is no known hinge, a
        kinematic body, or a convex part of more than eight corners.
    ParameterError
        If a parameter is missing, unknown or invalid.

    Examples
    --------
    >>> from pbrl_ppl.planning import ActionSet, Goal
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.2, bodies=(Body("puck", Shape.circle(0.2), pose=(0, 0, 0)),))
    >>> pushes = ActionSet.box("puck", forces=(-4.0, 0.0, 4.0))
    >>> task = Task(scene, Goal.of({"puck": (2.0, 0.0, None)}), pushes)
    >>> world = Box2DWorld(task, {"mass": 2.0, "r": 0.0, "mu_c": 0.0})
    >>> state = world.reset(seed=0)
    >>> round(world.step(task.wrenches(state)[2]).reward, 2)  # pushed for 0.2 s
    -1.96
    """

    def __init__(
        self,
        task: Task,
        parameters: Mapping[str, object],
        *,
        sigma: float | Sequence[float] = 0.0,
        spread: float | Sequence[float] = 0.0,
        step: float | None = None,
        acting: Callable[[Floats], Floats] | None = None,
    ) -> None:
        scene = task.scene
        step = scene.time_step / _STEPS if step is None else step
        if not 0 < step <= scene.time_step:
            raise EpisodeError(
                f"Box2D world: step is {step} s, expected above 0 and at most {scene.time_step:g} s"
            )
        for body in scene.bodies:
            if body.effects or body.kinematic:
                what = "declares effects" if body.effects else "is kinematic"
                raise EpisodeError(f"Box2D world: {body.name} {what}; use World for such scenes")
        if any(joint.kind != "hinge" or not joint.known for joint in scene.joints):
            raise EpisodeError("Box2D world: a joint is no known hinge; use World for such scenes")
        self._scenery = scenery(scene)
        for solid in self._scenery.solids:
            if any(len(corners) > _CORNERS for corners, _ in solid.parts):
                raise EpisodeError(
                    f"Box2D world: a convex part of {solid.name} has more than {_CORNERS} corners;"
                    " use World for such scenes"
                )
        self._steps, self._acting = max(1, round(scene.time_step / step)), acting
        super().__init__(task, parameters, sigma=sigma, spread=spread)
        layout, phi = self._truth.layout, self._truth.phi[0]
        given = dict(zip(layout.labels, phi.tolist(), strict=True))
        self._values = [
            {
                name: float(given.get(f"{name}[{body.owner}]", dict(body.known).get(name, 0.0)))
                for name in ("mass", "r", "mu_c", "w_x", "w_y", "w_theta", "mu_x", "mu_y")
            }
            for body in scene.moving
        ]

    @property
    def description(self) -> str:
        """Return engine, true parameters and ``acting``, as JSON."""
        acting = {} if self._acting is None else {"acting": repr(self._acting)}
        return json.dumps(json.loads(super().description) | acting)

    def _play(self, state: Floats, action: Floats) -> Floats:
        action = action if self._acting is None else self._acting(action)
        engine, rigid = self._engine(state)
        step = self.task.scene.time_step / self._steps
        for i in range(self._steps):
            # half a kick, drift, half a kick: second order
            self._kick(rigid, action, step if i else 0.5 * step)
            engine.Step(step, *_ITERATIONS)
        self._kick(rigid, action, 0.5 * step)
        after = [
            (*body.position, body.angle, *body.linearVelocity, body.angularVelocity)
            for body in rigid
        ]
        return np.array(after) / [_CM, _CM, 1.0, _CM, _CM, 1.0]

    def _engine(self, state: Floats) -> tuple[Any, list[Any]]:
        """Return a Box2D world in a state, and its moving bodies."""
        scene = self.task.scene
        listener = _Products()
        engine = Box2D.b2World(
            gravity=tuple(_CM * g for g in scene.gravity), doSleep=False, contactListener=listener,
            continuousPhysics=False,
        )  # fmt: skip
        engine.listener = listener  # Box2D keeps no reference
        ground = engine.CreateStaticBody()
        rigid, by_name = [], {WORLD: ground}
        for i, solid in enumerate(self._scenery.solids):
            if i < len(state):
                values = self._values[i]
                body = engine.CreateDynamicBody(
                    position=tuple(_CM * state[i, :2]), angle=float(state[i, 2]),
                    linearVelocity=tuple(_CM * state[i, 3:5]), angularVelocity=float(state[i, 5]),
                )  # fmt: skip
                rigid.append(body)
            else:
                values = {"mu_c": 1.0, "r": 1.0}
                x, y, theta = self._scenery.fixed[i - len(state)]
                body = ground
                if solid.name != WORLD:
                    body = engine.CreateStaticBody(position=(_CM * x, _CM * y), angle=theta)
            by_name[solid.name] = body
            _add_parts(body, solid, values)
            if i < len(state):
                mass = values["mass"]
                moment = mass * scene.moving[i].shape.unit_moment
                body.massData = Box2D.b2MassData(mass=mass, center=(0, 0), I=moment * _CM**2)
        for joint in scene.joints:
            first, second = (by_name[name] for name in joint.bodies or ())
            engine.CreateRevoluteJoint(
                bodyA=first, localAnchorA=tuple(_CM * a for a in joint.anchor_a or ()),
                bodyB=second, localAnchorB=tuple(_CM * a for a in joint.anchor_b or ()),
                collideConnected=False,
            )  # fmt: skip
        return engine, rigid

    def _kick(self, rigid: list[Any], action: Floats, step: float) -> None:
        """Apply the wrenches and the floor's friction on the wheels to the velocities."""
        scene = self.task.scene
        bodies = zip(rigid, action, self._values, scene.moving, strict=True)
        for body, wrench, values, declared in bodies:
            v = complex(*body.linearVelocity) / _CM
            omega = body.angularVelocity
            if not (v or omega or wrench.any()):
                continue  # at rest
            mass = values["mass"]
            inertia = mass * declared.shape.unit_moment
            v += complex(*wrench[:2]) / mass * step
            omega += float(wrench[2]) / inertia * step
            limit = mass * scene.normal_gravity * step
            v, omega = _rolled(values, cmath.exp(1j * body.angle), mass, inertia, limit, v, omega)
            body.linearVelocity = (v.real * _CM, v.imag * _CM)
            body.angularVelocity = omega


class _Products(Box2D.b2ContactListener):
    """Contact listener that multiplies frictions and restitutions, as the package's engine does."""

    def PreSolve(self, contact: Any, manifold: Any) -> None:
        pair = contact.fixtureA.userData, contact.fixtureB.userData
        contact.friction = pair[0]["mu_c"] * pair[1]["mu_c"]
        contact.restitution = pair[0]["r"] * pair[1]["r"]


def _add_parts(body: Any, solid: Any, values: dict[str, float]) -> None:
    """Add the convex parts of a solid to a Box2D body."""
    for corners, radius in solid.parts:
        points = [(float(x), float(y)) for x, y in _CM * corners]
        if len(points) == 1:
            shape = Box2D.b2CircleShape(pos=points[0], radius=_CM * radius)
        elif len(points) == 2:
            shape = Box2D.b2EdgeShape(vertices=points)
        else:
            shape = Box2D.b2PolygonShape(vertices=points)
        body.CreateFixture(shape=shape, density=1.0, userData=values)


def _rolled(
    values: dict[str, float],
    turn: complex,
    mass: float,
    inertia: float,
    limit: float,
    v: complex,
    omega: float,
) -> tuple[complex, float]:
    """Return velocities after the floor's friction on the wheel, at most mu times a limit per axis.

    Projected Gauss-Seidel for the impulses that stop the wheel's point; vectors are complex.
    """
    arm = turn * complex(values["w_x"], values["w_y"])
    along = turn * cmath.exp(1j * values["w_theta"])
    axes = [(along, values["mu_x"]), (1j * along, values["mu_y"])]
    levers = [(arm.conjugate() * axis).imag for axis, _ in axes]
    impulse = [0.0, 0.0]
    for _ in range(_WHEEL_ITERATIONS):
        for k, ((axis, mu), lever) in enumerate(zip(axes, levers, strict=True)):
            speed = (v.conjugate() * axis).real + omega * lever
            wanted = impulse[k] - speed / (1 / mass + lever**2 / inertia)
            wanted = min(max(wanted, -mu * limit), mu * limit)
            v += (wanted - impulse[k]) / mass * axis
            omega += (wanted - impulse[k]) * lever / inertia
            impulse[k] = wanted
    return v, omega
