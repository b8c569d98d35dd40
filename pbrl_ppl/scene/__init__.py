"""Scenes: shapes, bodies, walls and joints as declared; TOML to `Scene` and back."""

from pbrl_ppl.scene.checks import CONTACT_NAMES, nearest
from pbrl_ppl.scene.scene import WORLD, Body, Joint, Point, Scene, Shape, Wall

__all__ = [
    "CONTACT_NAMES",
    "WORLD",
    "Body",
    "Joint",
    "Point",
    "Scene",
    "Shape",
    "Wall",
    "nearest",
]
