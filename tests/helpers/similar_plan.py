"""Physically similar tasks: lengths, masses and times multiplied by factors."""

from dataclasses import dataclass, replace

import numpy as np

from pbrl_ppl.agents import Task
from pbrl_ppl.scene import Scene, Wall


@dataclass(frozen=True)
class Similar:
    """Factors of lengths, masses and times."""

    length: float
    mass: float
    time: float

    @property
    def force(self) -> float:
        return self.mass * self.length / self.time**2

    @property
    def state(self) -> np.ndarray:
        a, t = self.length, self.time
        return np.array([a, a, 1.0, a / t, a / t, 1.0 / t])

    @property
    def wrench(self) -> np.ndarray:
        return self.force * np.array([1.0, 1.0, self.length])

    def scene(self, scene: Scene) -> Scene:
        a = self.length

        def lengths(given):
            return None if given is None else tuple((a * np.array(given)).tolist())

        bodies = tuple(
            replace(
                body,
                shape=replace(
                    body.shape,
                    size=lengths(body.shape.size),
                    radius=None if body.shape.radius is None else a * body.shape.radius,
                    vertices=lengths(body.shape.vertices),
                ),
                pose=body.pose and (a * body.pose[0], a * body.pose[1], body.pose[2]),
            )
            for body in scene.bodies
        )
        return scene.replace(
            time_step=self.time * scene.time_step,
            normal_gravity=a / self.time**2 * scene.normal_gravity,
            bodies=bodies,
            walls=tuple(Wall(lengths(w.start), lengths(w.end)) for w in scene.walls),
        )

    def task(self, task: Task) -> Task:
        a = self.length
        targets = tuple(
            replace(
                t, x=t.x and a * t.x, y=t.y and a * t.y, tolerance=t.tolerance and a * t.tolerance
            )
            for t in task.goal.targets
        )
        penalty = task.goal.contact_penalty  # of a second, in seconds
        actions = tuple(
            replace(
                action,
                force=tuple(self.force * f for f in action.force),
                torque=self.force * a * action.torque,
            )
            for action in task.actions.actions
        )
        return Task(
            self.scene(task.scene),
            replace(task.goal, targets=targets, contact_penalty=penalty),
            replace(task.actions, actions=actions),
        )

    def parameters(self, values: dict[str, float]) -> dict[str, float]:
        unit = {"mass": self.mass, "w_x": self.length, "w_y": self.length}
        return {name: unit.get(name, 1.0) * value for name, value in values.items()}


#: A rig of millimetres, one of metres and one of hundreds of metres.
RIGS = [Similar(1e-3, 1e-6, 1e-2), Similar(10.0, 1e3, 3.0), Similar(100.0, 1e6, 10.0)]
