"""The catalogue: every effect of the package, in the order in which they are named."""

from pbrl_ppl.effects.actuator_delay import actuator_delay
from pbrl_ppl.effects.actuator_rotation import actuator_rotation
from pbrl_ppl.effects.angular_drag import angular_drag
from pbrl_ppl.effects.anisotropic_gain import anisotropic_gain
from pbrl_ppl.effects.body_force import body_force
from pbrl_ppl.effects.com_offset import com_offset
from pbrl_ppl.effects.constant_force import constant_force
from pbrl_ppl.effects.constant_torque import constant_torque
from pbrl_ppl.effects.dead_zone import dead_zone
from pbrl_ppl.effects.distance_joint import distance_joint
from pbrl_ppl.effects.effect import Effect
from pbrl_ppl.effects.force_cutoff import force_cutoff
from pbrl_ppl.effects.force_gain import force_gain
from pbrl_ppl.effects.frame_rotation import frame_rotation
from pbrl_ppl.effects.gravity_tilt import gravity_tilt
from pbrl_ppl.effects.heavy_tails import heavy_tails
from pbrl_ppl.effects.hidden_obstacle import hidden_obstacle
from pbrl_ppl.effects.inertia_scale import inertia_scale
from pbrl_ppl.effects.linear_drag import linear_drag
from pbrl_ppl.effects.magnus_force import magnus_force
from pbrl_ppl.effects.mass_change import mass_change
from pbrl_ppl.effects.pivot_damping import pivot_damping
from pbrl_ppl.effects.pivot_friction import pivot_friction
from pbrl_ppl.effects.point_attractor import point_attractor
from pbrl_ppl.effects.push_offset import push_offset
from pbrl_ppl.effects.quadratic_drag import quadratic_drag
from pbrl_ppl.effects.saturation import saturation
from pbrl_ppl.effects.sensor_bias import sensor_bias
from pbrl_ppl.effects.sensor_scale import sensor_scale
from pbrl_ppl.effects.sliding_friction import sliding_friction
from pbrl_ppl.effects.spring import spring
from pbrl_ppl.effects.torque_gain import torque_gain
from pbrl_ppl.effects.torsion_spring import torsion_spring
from pbrl_ppl.effects.wheel import wheel

#: Where two effects cannot be told apart, the earlier one is named: a hinge's own friction before
#: drag on a body, which looks the same on a single pendulum, and the simpler before the richer.
catalogue: tuple[Effect, ...] = (
    pivot_damping,
    pivot_friction,
    linear_drag,
    quadratic_drag,
    angular_drag,
    gravity_tilt,
    constant_force,
    body_force,
    constant_torque,
    push_offset,
    actuator_rotation,
    inertia_scale,
    com_offset,
    force_gain,
    torque_gain,
    anisotropic_gain,
    sliding_friction,
    wheel,
    actuator_delay,
    dead_zone,
    force_cutoff,
    saturation,
    magnus_force,
    spring,
    torsion_spring,
    point_attractor,
    mass_change,
    hidden_obstacle,
    distance_joint,
    sensor_bias,
    sensor_scale,
    frame_rotation,
    heavy_tails,
)
