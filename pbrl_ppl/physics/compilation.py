"""Compile the engine's loops into their cache, before or beside what needs them."""

from __future__ import annotations

from collections.abc import Iterable

from pbrl_ppl.physics import compiled, flow, lockstep
from pbrl_ppl.physics.calls import compile_beside
from pbrl_ppl.physics.physics import Transition
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall

#: The loops by what moves in them: single bodies, joined ones or bodies on friction, and contacts.
LOOPS = {
    "single": lockstep.rollout_free,
    "joined": flow.rollout_tree,
    "touching": compiled.rollout_engine,
}
_PUCK = Body("puck", Shape.circle(0.1))
_SCENES = {
    "single": Scene(time_step=0.1, bodies=(_PUCK,)),
    "joined": Scene(
        time_step=0.1, bodies=(_PUCK,), joints=(Joint("hinge", ("world", "puck"), (0, 0), (0, 0)),)
    ),
    "touching": Scene(time_step=0.1, bodies=(_PUCK,), walls=(Wall((0.11, -1), (0.11, 1)),)),
}


def compile_loops(names: Iterable[str] = tuple(LOOPS)) -> None:
    """Compile these of `LOOPS`: predict one interval by each."""
    for name in names:
        puck = Transition(_SCENES[name], {"mass": 1.0, "r": 0.0, "mu_c": 0.0}, check_start=False)
        puck([0, 0, 0, 0.1 * (name == "touching"), 0, 0, 0, 0, 0, 0])


def compile_for_search(scene: Scene) -> None:
    """Compile beside what follows the loop that a scene does not need, but friction on it does."""
    if not scene.joints:
        code = f"from {__name__} import compile_loops; compile_loops(('joined',))"
        compile_beside(flow.rollout_tree, code)
