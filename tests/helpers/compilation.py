"""Compile the engine's loops into their cache: ``python -m tests.helpers.compilation [LOOP ...]``.

Of pytest workers that begin without a cache each compiles all of them. The loops are ``lockstep``
of single bodies, ``flow`` of joined ones, and ``compiled`` of contacts; without an argument, all.
"""

import sys

from pbrl_ppl.physics import Simulator, compiled, flow, lockstep
from pbrl_ppl.scene import Body, Scene
from tests.helpers.engines import BOX, cart, chain, proposals
from tests.helpers.worlds import G, simulator


def alone():
    """Return a simulator of the cart without walls, its first states and its actions."""
    _, start, actions = cart(walls=False)
    scene = Scene(time_step=0.1, normal_gravity=G, bodies=(Body("cart", BOX, wheel=True),))
    return simulator(scene), start, actions


#: Loop -> its module, an engine, and what makes a simulator, states and actions that it is run on.
LOOPS = {
    "lockstep": (lockstep, "auto", alone),
    "flow": (flow, "auto", chain),
    "compiled": (compiled, "chipmunk", lambda: cart(walls=True)),
}


def main(*names: str) -> None:
    """Predict once by each of these loops, or by all."""
    for name in names or LOOPS:
        module, engine, make = LOOPS[name]
        made, begin, inputs = make()
        loop = Simulator(made.physics.changed(engine=engine))
        loop(proposals(loop.physics.layout, 1), begin[:2], inputs[:2])
        assert module.rollout.signatures


if __name__ == "__main__":
    main(*sys.argv[1:])
