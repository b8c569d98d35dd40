"""MuJoCo's system identification on a comparable problem, to compare in one run.

A cart of one body, free to slide along x and y and to turn, with damping and dry friction in each
direction: seven parameters. 360 commands of 0.1 s, 20 engine steps each. Their toolbox fits one
long trajectory, as that is what it takes, and compares at every engine step. It needs
``mujoco[sysid]``.
"""

from __future__ import annotations

import contextlib
import io
import time

import mujoco
import numpy as np
from mujoco import rollout, sysid

if not hasattr(sysid, "optimize"):  # mujoco does not say that its toolbox is missing
    raise ImportError("mujoco.sysid is there without what it needs")

COMMANDS, STEPS, ROUNDS = 360, 20, 3
NOISE = np.array([0.002, 0.002, 0.004, 0.01, 0.01, 0.02])
JOINTS = ("x", "y", "yaw")
MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="8" diaginertia="0.5 0.5 0.8"/>
      <joint name="x" type="slide" axis="1 0 0" damping="1.5" frictionloss="3"/>
      <joint name="y" type="slide" axis="0 1 0" damping="1.5" frictionloss="3"/>
      <joint name="yaw" type="hinge" axis="0 0 1" damping="0.3" frictionloss="0.3"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="x"/> <motor joint="y"/> <motor joint="yaw"/>
  </actuator>
  <sensor>
    <jointpos name="x" joint="x"/> <jointpos name="y" joint="y"/> <jointpos name="yaw" joint="yaw"/>
    <jointvel name="vx" joint="x"/> <jointvel name="vy" joint="y"/>
    <jointvel name="omega" joint="yaw"/>
  </sensor>
</mujoco>
"""


def parameters() -> sysid.ParameterDict:
    """Return the unknown parameters at a wrong start: mass, damping and dry friction."""

    def entry(joint: str, name: str) -> object:
        def modify(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
            value = getattr(spec.joint(joint), name)
            if np.ndim(value):
                value[0] = parameter.value[0]
            else:
                setattr(spec.joint(joint), name, parameter.value[0])

        return modify

    def mass(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        spec.body("cart").mass = parameter.value[0]

    found = sysid.ParameterDict()
    found.add(sysid.Parameter("mass", nominal=3.0, min_value=0.5, max_value=50.0, modifier=mass))
    for joint in JOINTS:
        for name in ("damping", "frictionloss"):
            modifier = entry(joint, name)
            found.add(
                sysid.Parameter(
                    f"{joint} {name}", nominal=1.0, min_value=0.0, max_value=10.0, modifier=modifier
                )
            )
    return found


def sysid_seconds() -> float:
    """Return the median time of a fit, which must find the truth."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec.from_string(MODEL)
    model = spec.compile()
    data = mujoco.MjData(model)
    command = rng.normal(0, [12.0, 12.0, 2.0], (COMMANDS + 1, 3))
    command = np.repeat(command, STEPS, axis=0)[: COMMANDS * STEPS + 1]
    begin = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    states, measured = (batch[0] for batch in rollout.rollout(model, data, begin, command[:-1]))
    measured = measured + NOISE * rng.standard_normal(measured.shape)
    sequences = sysid.ModelSequences(
        "cart", spec, "pushed", begin,
        sysid.TimeSeries(np.arange(len(command)) * model.opt.timestep, command),
        sysid.TimeSeries.from_names(states[:, 0], measured, model),
    )  # fmt: skip
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = sysid.optimize(
                initial_params=parameters(), residual_fn=residual, verbose=False
            )
        times.append(time.perf_counter() - start)
    if abs(found["mass"].value[0] / 8.0 - 1) > 0.01:
        raise RuntimeError(f"sysid found a mass of {found['mass'].value[0]} kg, expected 8")
    return float(np.median(times))
