"""Compile the engine's loops into their cache: ``python -m tests.helpers.compilation``.

Of pytest workers that begin without a cache each compiles all of them.
"""

from pbrl_ppl.physics import Simulator, compiled, flow, lockstep
from pbrl_ppl.scene import Body, Scene
from tests.helpers.engines import BOX, cart, chain, proposals
from tests.helpers.worlds import G, simulator


def main() -> None:
    """Predict once by each loop: of single bodies, of joined ones, and of contacts."""
    _, start, actions = cart(walls=False)
    alone = Scene(time_step=0.1, normal_gravity=G, bodies=(Body("cart", BOX, wheel=True),))
    for engine, (made, begin, inputs) in (
        ("auto", (simulator(alone), start, actions)),
        ("auto", chain()),
        ("chipmunk", cart(walls=True)),
    ):
        loop = Simulator(made.physics.changed(engine=engine))
        loop(proposals(loop.physics.layout, 1), begin[:2], inputs[:2])
    assert all(loop.rollout.signatures for loop in (lockstep, flow, compiled))


if __name__ == "__main__":
    main()
