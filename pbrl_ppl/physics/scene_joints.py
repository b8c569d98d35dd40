"""Phi -> anchors, lengths and bodies of the joints that the scene declares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.parameters import JOINT_ANCHORS, JOINT_INDICES
from pbrl_ppl.scene import WORLD, Scene

Array = NDArray[np.float64]

#: Columns of a joint's properties: its anchors and its length (m).
JOINT_COLUMNS = (*JOINT_ANCHORS, "length")
#: A joint shorter than this (m) is a hinge.
_NO_LENGTH = 1e-9


class SceneJoints:
    """Translates parameter vectors into the joints' numbers.

    Parameters
    ----------
    scene : Scene
        Its joints, and the poses that their lengths follow from.
    places : dict of str to int
        Place of each label in phi.
    """

    def __init__(self, scene: Scene, places: dict[str, int]) -> None:
        self._scene = scene
        self._anchors = np.zeros((len(scene.joints), 4))
        self._held = np.zeros((len(scene.joints), 2), dtype=int)
        fixed = (body.name for body in scene.bodies if body.static or body.kinematic)
        holders = [*scene.joinable, *fixed]
        poses = {body.name: body.pose for body in scene.bodies} | {WORLD: None}
        self._poses = np.array([poses[name] or (0.0, 0.0, 0.0) for name in holders])
        moved, free = [], []
        for j, (owner, joint) in enumerate(zip(scene.joint_names, scene.joints, strict=True)):
            self._anchors[j] = (*(joint.anchor_a or (0, 0)), *(joint.anchor_b or (0, 0)))
            for column, name in enumerate(JOINT_ANCHORS):
                place = places.get(f"{name}[{owner}]")
                if place is not None:
                    moved.append((place, j, column))
            if joint.bodies is not None:
                self._held[j] = [holders.index(name) for name in joint.bodies]
            else:
                free.append((j, *(places[f"{name}[{owner}]"] for name in JOINT_INDICES)))
        self._moved_anchors = np.array(moved, dtype=int).reshape(-1, 3).T
        self._free = np.array(free, dtype=int).reshape(-1, 3)
        length = self._lengths(self._anchors, self._held)
        #: Which joints have no length, one a joint.
        self.hinges = tuple(
            joint.kind == "hinge" or bool(joint.known and distance < _NO_LENGTH)
            for joint, distance in zip(scene.joints, length, strict=True)
        )

    def _lengths(self, anchors: Array, held: NDArray[np.int64]) -> Array:
        """Distance of the anchors in the reference poses, shape (...,)."""
        poses = self._poses[held]
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        x, y = anchors[..., 0::2], anchors[..., 1::2]
        at_x = poses[..., 0] + c * x - s * y
        at_y = poses[..., 1] + s * x + c * y
        return np.asarray(np.hypot(at_x[..., 0] - at_x[..., 1], at_y[..., 0] - at_y[..., 1]))

    def __call__(self, phi: Array) -> tuple[Array, NDArray[np.int64]]:
        """Anchors and lengths, and what the joints of unknown bodies hold.

        Parameters
        ----------
        phi : ndarray
            Proposals, shape (proposal, p), SI units.

        Returns
        -------
        joints : ndarray
            Shape (proposal, joint, 5), columns as in :data:`JOINT_COLUMNS`, m.
        indices : ndarray
            Which of ``scene.joinable`` an inferred joint holds, shape (proposal, free joint, 2).

        Raises
        ------
        ParameterError
            If an index names nothing.
        """
        n, count = len(phi), len(self._anchors)
        if not count:
            return np.empty((n, 0, len(JOINT_COLUMNS))), np.empty((n, 0, 2), dtype=np.int64)
        joints = np.empty((n, count, len(JOINT_COLUMNS)))
        joints[..., :4] = self._anchors
        place, joint, column = self._moved_anchors
        joints[:, joint, column] = phi[:, place]
        indices = phi[:, self._free[:, 1:]]
        choices = len(self._scene.joinable)
        wrong = (indices != np.floor(indices)) | (indices < 0) | (indices >= choices)
        if wrong.any():
            raise ParameterError(
                f"joint index is {indices[wrong][0]:g}, expected a whole number from 0 to"
                f" {choices - 1}: {', '.join(self._scene.joinable)}"
            )
        held = np.repeat(self._held[None], n, axis=0)
        held[:, self._free[:, 0]] = indices
        joints[..., 4] = self._lengths(joints[..., :4], held)
        return joints, indices.astype(np.int64)
