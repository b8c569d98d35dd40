"""Dimensions and coordinates of a problem's variables, as the pm.Model and posteriors have them."""

from __future__ import annotations

from typing import Any

from pbrl_ppl.likelihood.coordinates import ACCELERATION, CONTACT, DRIFT
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.parameters import Block
from pbrl_ppl.state import INPUT, STATE

#: Dimensions of the noise variables along trajectories.
_NOISE_DIMS = {
    "sigma": "sensor", ACCELERATION: "velocity", CONTACT: "velocity", DRIFT: "position",
}  # fmt: skip
#: Dimensions of measured next states, and of the data that they are predicted from.
NEXT_STATE_DIMS = ("transition", "step", "body", "state")
START_DIMS = ("transition", "body", "full_state")
ACTION_DIMS = ("transition", "step", "body", "wrench")


def variable_dims(problem: Problem) -> dict[str, tuple[str, ...]]:
    """Return the dimensions of each parameter and noise variable by name."""
    dims: dict[str, tuple[str, ...]] = {
        block.name: (_block_dim(problem, block),) for block in problem.layout.blocks
    }
    if problem.library is not None:
        dims["library_index"] = (_owner_dim(problem, tuple(problem.scene.owners), "library"),)
    for name in problem.noise_variables:
        if problem.scalar_sigma:
            dims[name] = ()
        else:
            dims[name] = (_NOISE_DIMS[name] if problem.likelihood.filtered else "state",)
    return dims


def variable_coords(problem: Problem) -> dict[str, list[Any]]:
    """Return the labels of each dimension by name."""
    coords: dict[str, list[Any]] = {
        "body": [body.name for body in problem.scene.moving],
        "full_state": list(STATE),
        "state": list(problem.observations.names),
        "wrench": list(INPUT[: problem.inputs.shape[-1]]),
        "transition": list(range(problem.segments.n)),
        "step": list(range(1, problem.data.horizon + 1)),
    }
    if problem.likelihood.filtered:
        coords |= {_NOISE_DIMS[name]: list(own) for name, own in problem.noise_variables.items()}
    owners = tuple(problem.scene.owners)
    coords.setdefault(_owner_dim(problem, owners, ""), list(owners))
    for block in problem.layout.blocks:
        coords.setdefault(_block_dim(problem, block), list(block.owners))
    return coords


def _block_dim(problem: Problem, block: Block) -> str:
    """Return the dimension of a parameter: joints, or the bodies or classes that have it."""
    if block.of == "joint":
        return "joint" if not block.name.startswith("i_") else "free_joint"
    return _owner_dim(problem, block.owners, block.effect or block.name)


def _owner_dim(problem: Problem, owners: tuple[str, ...], name: str) -> str:
    """Return ``body`` for all moving bodies, ``owner`` for all owners, or a name of its own."""
    if set(owners) == {body.name for body in problem.scene.moving}:
        return "body"
    return "owner" if owners == tuple(problem.scene.owners) else f"{name}_body"
