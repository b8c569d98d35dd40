"""A wheeled cart and the true parameters of its histories."""

from pbrl_ppl.scene import Body, Scene, Shape

CART = {
    "mass": 6.5,
    "r": 0.2,
    "mu_c": 0.3,
    "w_x": -0.25,
    "w_y": 0.0,
    "w_theta": 0.1,
    "mu_x": 0.04,
    "mu_y": 0.45,
}


def cart_scene(**options) -> Scene:
    """Return a wheeled cart on a floor, seen from above, in a room without walls."""
    cart = Body("cart", Shape.box(0.9, 0.55), **({"wheel": True} | options))
    return Scene(time_step=0.1, normal_gravity=9.81, bodies=(cart,))
