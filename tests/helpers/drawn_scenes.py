"""Valid scenes drawn at random: shapes, joints, walls, classes, actuators, effects and priors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbrl_ppl.effects import catalogue
from pbrl_ppl.effects.effect import is_pivoted, is_sliding
from pbrl_ppl.scene import Actuator, Body, Joint, Scene, Shape, Wall

Rng = np.random.Generator
G = 9.81
RATES = (5, 10, 20, 25, 30, 50, 60, 100, 120, 200, 240, 250, 500, 1000)
#: What is joined, and how often each is drawn.
KINDS = {
    "free": 0.34, "pushed": 0.1, "chain": 0.22, "cart": 0.12, "rod": 0.08, "mixed": 0.08,
    "inferred": 0.06,
}  # fmt: skip


@dataclass(frozen=True)
class World:
    """A scene, and the sizes of its motion: length (m), mass (kg), speed (m/s)."""

    scene: Scene
    kind: str
    size: float
    mass: float
    speed: float

    @property
    def force(self) -> float:
        """Force that makes the speed within a body's length (N)."""
        return self.mass * self.speed**2 / self.size


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def shape(rng: Rng, size: float) -> Shape:
    """Return a shape of at most this bounding radius (m)."""
    kind = rng.integers(4)
    if kind == 0:
        return Shape.circle(round(size * rng.uniform(0.4, 0.9), 6))
    if kind == 1:
        return Shape.box(*(np.round(size * rng.uniform(0.3, 1.2, 2), 6).tolist()))
    corners = int(rng.integers(3, 7))
    angle = 2.0 * np.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) / corners
    radius = size * rng.uniform(0.5, 0.9, corners)
    if kind == 3 and corners > 4:  # concave
        radius[1] *= 0.5
    points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    after = np.roll(points, -1, axis=0)
    cross = points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]
    centroid = ((points + after) * cross[:, None]).sum(0) / (3.0 * cross.sum())
    return Shape.polygon((points - centroid).tolist())


def world(rng: Rng) -> World:
    """Return a scene without a recording's layout."""
    size, kind = log_uniform(rng, 0.01, 2.0), str(rng.choice([*KINDS], p=[*KINDS.values()]))
    mass = log_uniform(rng, 0.02, 50.0) * min(1.0, 10.0 * size**2)
    above = kind in ("pushed", "inferred") or (rng.random() < (0.7 if kind == "free" else 0.3))
    speed = size * log_uniform(rng, 0.3, 10.0) if above else float(np.sqrt(G * size))
    rate = speed / size * log_uniform(rng, 3.0, 60.0)
    if rng.random() < 0.1:
        rate = log_uniform(rng, 5.0, 1000.0)
    time_step = 1.0 / min(RATES, key=lambda each: abs(np.log(each / rate)))
    bodies, joints = _parts(rng, kind, size)
    dynamic = [i for i, body in enumerate(bodies) if not body.get("kinematic")]
    for i in dynamic:
        free = not any(bodies[i]["name"] in (joint.bodies or ()) for joint in joints)
        bodies[i]["wheel"] = bool(above and free and kind != "inferred" and rng.random() < 0.25)
        bodies[i] |= _parameters(rng, mass, bodies[i]["wheel"])
    if len(dynamic) > 1 and rng.random() < 0.25:
        _same_class(rng, [bodies[i] for i in dynamic])
    walls: list[Wall] = []
    if kind in ("free", "pushed", "mixed") and rng.random() < 0.4:
        walls = _walls(rng, size, len(bodies))
    every = [Body(**body) for body in bodies]
    if rng.random() < 0.1:
        far = (-8.0 * size, 3.0 * size, 0.3)
        every.append(Body("post", Shape.circle(0.4 * size), static=True, pose=far))
    scene = Scene(
        time_step=time_step, substeps=int(rng.choice([5, 10, 20])), bodies=tuple(every),
        joints=tuple(joints), walls=tuple(walls), gravity=(0.0, 0.0) if above else (0.0, -G),
        normal_gravity=G if above and (rng.random() < 0.8 or _wheels(every)) else 0.0,
        test_is_later=bool(rng.random() < 0.8),
    )  # fmt: skip
    drawn = World(scene, kind, size, mass, speed)
    drawn = replace(drawn, scene=_actuated(rng, drawn) if rng.random() < 0.25 else scene)
    return replace(drawn, scene=_with_effects(rng, drawn))


def _wheels(bodies: list[Body]) -> bool:
    return any(body.wheel for body in bodies)


def _parts(rng: Rng, kind: str, size: float) -> tuple[list[dict[str, Any]], list[Joint]]:
    """Return the arguments of the bodies, and the joints."""
    count = int(rng.choice([1, 2, 3, 4], p=[0.5, 0.25, 0.15, 0.1]))
    if kind in ("chain", "cart", "mixed"):
        count = min(count, 3 if kind == "chain" else 2)
    poses = [(round(4.0 * size * i, 6), 0.0, 0.0) for i in range(count + 1)]
    bodies: list[dict[str, Any]] = [
        {"name": f"b{i}", "shape": shape(rng, size)}
        | ({"pose": poses[i]} if rng.random() < 0.3 or kind in ("rod", "inferred") else {})
        for i in range(count)
    ]
    joints: list[Joint] = []
    if kind == "pushed":
        finger = Shape.circle(0.2 * size)
        return [*bodies, {"name": "finger", "shape": finger, "kinematic": True}], joints
    if kind in ("chain", "cart", "mixed"):
        bodies = []
        if kind == "cart":
            bodies = [{"name": "cart", "shape": Shape.box(size, 0.5 * size)}]
            axis = (1.0, 0.0) if rng.random() < 0.7 else (1.0, 0.5)
            rail = Joint("slider", ("cart", "world"), (0.0, 0.0), (0.0, 0.0), axis=axis)
            joints, count = [rail], count - 1
        place = (0.0, 0.0) if rng.random() < 0.5 else (0.5 * size, round(size, 6))
        holder, hook = ("cart", (0.0, 0.0)) if bodies else ("world", place)
        for i in range(count):
            length = round(size * rng.uniform(0.5, 1.5), 6)
            hung = Shape.box(round(0.1 * size, 6), length)
            if rng.random() < 0.2:
                hung = Shape.circle(0.5 * length)
            bodies.append({"name": f"link{i}", "shape": hung})
            joints.append(Joint("hinge", (f"link{i}", holder), (0.0, 0.5 * length), hook))
            holder, hook = f"link{i}", (0.0, -0.5 * length)
        if kind == "mixed":
            bodies.append({"name": "puck", "shape": shape(rng, size)})
    elif kind == "rod":
        if count > 1:
            joints = [Joint("distance", ("b0", "b1"), (0.2 * size, 0.0), (-0.2 * size, 0.0))]
        else:
            high = (0.3 * size, 2.0 * size)
            joints = [Joint("distance", ("world", "b0"), high, (0.0, 0.1 * size))]
    elif kind == "inferred":
        ends = ("b0", "world") if count == 1 or rng.random() < 0.5 else ("b0", "b1")
        joints = [Joint("distance", ends if rng.random() < 0.6 else None, known=False)]
    return bodies, joints


def _parameters(rng: Rng, mass: float, wheel: bool) -> dict[str, Any]:
    """Return what is known of a body, and its priors."""
    known: dict[str, float] = {}
    prior: dict[str, dict[str, float]] = {}
    chance = rng.random()
    if chance < 0.5:
        known["mass"] = float(f"{mass:.3g}")
    elif chance < 0.8:
        prior["mass"] = {"mu": round(float(np.log(mass)), 3), "sigma": rng.choice([0.2, 1.0])}
    for name in ("r", "mu_c"):
        if rng.random() < 0.3:
            known[name] = round(rng.uniform(0.0, 0.8), 2)
        elif rng.random() < 0.1:
            prior[name] = {"mu": -1.0 if name == "r" else 0.4, "sigma": 0.5}
    if wheel and rng.random() < 0.2:
        known["w_theta"] = 0.3
    if wheel and rng.random() < 0.2:
        prior["mu_x"] = {"mu": 0.1, "sigma": 0.2}
    return {"known": known, "prior": prior}


def _same_class(rng: Rng, bodies: list[dict[str, Any]]) -> None:
    """Make bodies a class, in place."""
    first, attributes = bodies[0], ("locked",) if rng.random() < 0.3 else ()
    for body in bodies:
        body |= {"object_class": "thing", "attributes": attributes}
        body |= {key: first[key] for key in ("known", "prior", "wheel")}
        if first["wheel"]:
            body["shape"] = first["shape"]


def _walls(rng: Rng, size: float, count: int) -> list[Wall]:
    """Return one to four sides of a room about the bodies."""
    low, high, half = -3.5 * size, (4.0 * count + 1.0) * size, 3.0 * size
    ends = [
        ((low, -half), (high, -half)), ((low, half), (high, half)),
        ((low, -half), (low, half)), ((high, -half), (high, half)),
    ]  # fmt: skip
    return [Wall(*ends[i]) for i in sorted(rng.choice(4, rng.integers(1, 5), replace=False))]


def _actuated(rng: Rng, world: World) -> Scene:
    """Return the scene with actuators on one of its bodies."""
    scene = world.scene
    body = scene.dynamic[rng.integers(len(scene.dynamic))]
    hung = is_pivoted(scene, body)
    kinds = ["motor", "servo", "wrench"] if hung else ["thruster", "motor", "wrench", "servo"]
    actuators = []
    for i in range(int(rng.choice([1, 2, 3], p=[0.6, 0.3, 0.1]))):
        kind = str(rng.choice(kinds))
        strength = world.force * (1.0 if kind == "thruster" else world.size)
        known: dict[str, float] = {}
        prior: dict[str, dict[str, float]] = {}
        more: dict[str, Any] = {}
        stated = rng.random()
        if kind == "thruster":
            more["at"] = (0.0, round(0.3 * world.size * float(rng.integers(-1, 2)), 6))
            if rng.random() < 0.5:
                known["direction"] = round(rng.uniform(-1.5, 1.5), 2)
            elif rng.random() < 0.3:
                prior["direction"] = {"mu": 0.0, "sigma": 0.2}
        if kind in ("thruster", "motor") and stated < 0.6:
            known["gain"] = float(f"{strength:.3g}")
        if kind == "motor" and 0.6 <= stated < 0.8:
            known = {"torque_constant": strength, "resistance": 1.0, "supply": 1.0}
        if kind == "servo":
            more["of"] = str(rng.choice(["angle", "speed"]))
            if stated < 0.6:
                known = {"kp": strength, "kd": 0.1 * strength * world.size / world.speed}
            if rng.random() < 0.3:
                known["limit"] = 3.0 * strength
        if kind == "wrench":
            more["of"] = "torque" if hung else str(rng.choice(["force_x", "force_y", "torque"]))
        if rng.random() < 0.2 and not hung:
            more["frame"] = "world"
        actuators.append(
            Actuator(name=f"u{i}", kind=kind, body=body.name, known=known, prior=prior, **more)
        )
    return scene.replace(actuators=tuple(actuators))


def applicable(scene: Scene, body: Body) -> list[str]:
    """Return the effects that a body may declare."""
    return [effect.name for effect in catalogue if effect.applies(scene, body)]


def _with_effects(rng: Rng, world: World) -> Scene:
    """Return the scene with declared effects, and with what is typical of some bodies."""
    bodies, by_name = [], {effect.name: effect for effect in catalogue}
    for body in world.scene.bodies:
        if body in world.scene.dynamic and rng.random() < 0.5:
            names = applicable(world.scene, body)
            count = min(int(rng.integers(1, 4)), len(names))
            chosen = tuple(str(name) for name in rng.choice(names, count, replace=False))
            prior = dict(body.prior)
            for name in chosen if rng.random() < 0.4 else ():
                effect = by_name[name].on(body.name).in_si(scene_with_sizes(world)).effect
                for parameter in effect.parameters[:1]:
                    one = parameter.prior
                    if one.family in ("normal", "half_normal", "log_normal", "truncated_normal"):
                        values = {"mu": float(one.mu), "sigma": float(0.5 * one.sigma)}
                        prior[effect.variable(parameter)] = values
            body = replace(body, effects=chosen, prior=prior)
        if body in world.scene.dynamic and rng.random() < 0.1:
            body = replace(body, typical={"force": world.force, "speed": world.speed})
        bodies.append(body)
    return world.scene.replace(bodies=tuple(bodies))


def scene_with_sizes(world: World, scene: Scene | None = None) -> Scene:
    """Return the scene with the natural units of its motion, for the sizes of true effects."""
    scene = scene or world.scene
    typical = {
        "mass": world.mass, "force": world.force, "torque": world.force * world.size,
        "speed": world.speed, "turn_rate": world.speed / world.size, "range": 4.0 * world.size,
        "time": 10.0 * world.size / world.speed,
    }  # fmt: skip
    bodies = [
        replace(body, typical=typical) if body in scene.dynamic else body for body in scene.bodies
    ]
    return scene.replace(bodies=tuple(bodies))


def coordinates(scene: Scene, body: Body) -> str:
    """Return how a body's state is given: hinged, sliding or free."""
    if is_pivoted(scene, body):
        return "hinged"
    return "sliding" if is_sliding(scene, body) else "free"
