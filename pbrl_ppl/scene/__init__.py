"""What is declared: shapes, bodies, walls, joints; TOML to `Scene` and back."""

from pbrl_ppl.scene.checks import nearest
from pbrl_ppl.scene.scene import WORLD, Body, Joint, Point, Scene, Shape, Wall

__all__ = ["WORLD", "Body", "Joint", "Point", "Scene", "Shape", "Wall", "nearest"]
