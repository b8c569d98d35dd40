"""The black-box Op: the Simulator inside a pytensor graph."""

import pickle
import warnings

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.gradient import NullTypeGradError

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.model import SimulatorOp
from pbrl_ppl.physics import Physics, Simulator
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall
from tests.helpers.worlds import G

BOX = Shape.box(0.9, 0.55)
MODES = pytest.mark.parametrize("mode", [None, "FAST_COMPILE"])


def make(effects=("linear_drag",), gravity=(0.0, 0.0), **options) -> SimulatorOp:
    cart = Body("cart", BOX, wheel=True, effects=effects)
    walls = (Wall((2.0, -9.0), (2.0, 9.0)),)
    scene = Scene(time_step=0.1, gravity=gravity, normal_gravity=G, bodies=(cart,), walls=walls)
    attached = attach(scene)
    return SimulatorOp(Physics(scene, attached, **options))


def inputs(op: SimulatorOp, n: int = 12, horizon: int = 2) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(11)
    values = {"mass": 6.0, "r": 0.2, "mu_c": 0.3, "w_x": -0.2, "w_y": 0.05, "w_theta": 0.1}
    values |= {"mu_x": 0.04, "mu_y": 0.4, "linear_drag_coefficient": 1.5}
    k = len(op.physics.scene.dynamic)
    start = rng.normal(0, 1, (n, k, 6))
    return op.physics.layout.to_vector(values), start, rng.normal(0, 9, (n, horizon, k, 3))


def expected(op: SimulatorOp, *values: np.ndarray) -> np.ndarray:
    return Simulator(op.physics)(*values)  # with worlds of its own


def compiled(op: SimulatorOp, mode: str | None):
    phi, start, actions = pt.dvector("phi"), pt.dtensor3("start"), pt.dtensor4("actions")
    return pytensor.function([phi, start, actions], op(phi, start, actions), mode=mode)


# -- the same as the Simulator ---------------------------------------------------------------------


@MODES
@pytest.mark.parametrize("threads", [1, 2])
def test_compiled_function_is_the_simulator(mode, threads) -> None:
    """Warnings are errors here: numba's object mode would raise."""
    op = make(threads=threads)
    values = inputs(op)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        f = compiled(op, mode)
        got = f(*values)
    np.testing.assert_array_equal(got, expected(op, *values))
    # a transposed (not contiguous) initial state, and other lengths
    phi, start, actions = values
    np.testing.assert_array_equal(f(phi, start[::-2], actions[::-2]), got[::-2])
    np.testing.assert_array_equal(f(phi, start, actions[:, :1]).shape, (len(start), 1, 1, 6))


@MODES
def test_inside_a_larger_graph(mode) -> None:
    """Constants for the data, phi joined from named parts, and a reduction of the result."""
    op = make()
    phi, start, actions = inputs(op)
    mass, rest = pt.dscalar("mass"), pt.dvector("rest")
    vector = pt.concatenate([mass[None], rest])
    total = pt.sum(op(vector, start, actions) ** 2)
    f = pytensor.function([mass, rest], total, mode=mode)
    want = (expected(op, phi, start, actions) ** 2).sum()
    assert f(phi[0], phi[1:]) == pytest.approx(want, rel=1e-12)


def test_integers_are_cast() -> None:
    op = make()
    phi, start, actions = inputs(op)
    out = op(phi, start.astype(int), actions.astype("float32"))
    want = expected(op, phi, start.astype(int), actions.astype("float32"))
    np.testing.assert_array_equal(out.eval(mode="FAST_COMPILE"), want)


@MODES
def test_shape_is_known_without_the_engine(mode) -> None:
    op = make()
    phi, start, actions = pt.dvector("phi"), pt.dtensor3("start"), pt.dtensor4("actions")
    out = op(phi, start, actions)
    assert out.type.shape == (None, None, 1, 6)
    shape = pytensor.function([phi, start, actions], out.shape, mode=mode, on_unused_input="ignore")
    values = inputs(op, n=5, horizon=3)
    np.testing.assert_array_equal(shape(*values), (5, 3, 1, 6))
    if mode is None:
        assert not any(isinstance(n.op, SimulatorOp) for n in shape.maker.fgraph.apply_nodes)


def test_joints_and_pivots() -> None:
    arm = Body("arm", Shape.box(0.03, 0.4), effects=("pivot_damping", "pivot_friction"))
    joint = Joint("hinge", ("arm", "world"), (0.0, 0.18), (0.0, 0.0))
    scene = Scene(time_step=0.02, gravity=(0, -G), bodies=(arm,), joints=(joint,))
    attached = attach(scene)
    op = SimulatorOp(Physics(scene, attached))
    values = {"mass": 0.5, "r": 0.1, "mu_c": 0.1}
    values |= {"pivot_damping_coefficient": 0.01, "pivot_friction_torque": 0.02}
    rng = np.random.default_rng(12)
    theta, omega = rng.normal(0, 1, 10), rng.normal(0, 2, 10)
    x, y = 0.18 * np.sin(theta), -0.18 * np.cos(theta)
    start = np.stack([x, y, theta, -omega * y, omega * x, omega], axis=-1)[:, None]
    args = op.physics.layout.to_vector(values), start, np.zeros((10, 3, 1, 3))
    np.testing.assert_array_equal(compiled(op, None)(*args), expected(op, *args))


# -- identity --------------------------------------------------------------------------------------


def test_equality_and_hash_are_those_of_the_properties() -> None:
    op = make()
    assert op == make()
    assert hash(op) == hash(make())
    assert op == make(substeps=10)  # the scene's own
    for other in (make(substeps=20), make(threads=2), make(effects=())):
        assert op != other
    assert len({op, make(), make(threads=2)}) == 2


def test_equal_ops_are_merged_in_a_graph() -> None:
    phi, start, actions = pt.dvector("phi"), pt.dtensor3("start"), pt.dtensor4("actions")
    total = make()(phi, start, actions) + make()(phi, start, actions)
    f = pytensor.function([phi, start, actions], total, mode="FAST_RUN")
    assert sum(isinstance(node.op, SimulatorOp) for node in f.maker.fgraph.apply_nodes) == 1


def test_pickled_op_gives_the_same() -> None:
    op = make()
    values = inputs(op)
    want = op.predict(*values)
    restored = pickle.loads(pickle.dumps(op))
    assert restored == op
    np.testing.assert_array_equal(restored.predict(*values), want)


# -- memory ----------------------------------------------------------------------------------------


@MODES
def test_second_call_gives_an_equal_and_independent_array(mode) -> None:
    op = make()
    values = inputs(op)
    f = compiled(op, mode)
    first = f(*values)
    keep = first.copy()
    second = f(*values)
    np.testing.assert_array_equal(second, keep)
    assert not np.shares_memory(first, second)
    first[:] = 0.0
    second[:] = -1.0
    np.testing.assert_array_equal(f(*values), keep)


def test_memory_tells_inputs_apart() -> None:
    """Every input counts, in any order of calls, also after more calls than are remembered."""
    op = make()
    phi, start, actions = inputs(op)
    asked = [(phi + 0.01 * i, start + 0.01 * j, actions) for i in range(3) for j in range(3)]
    asked += [(phi, start, actions + 0.5), (phi, start[:3], actions[:3])]
    for _ in range(2):
        for values in asked:
            np.testing.assert_array_equal(op.predict(*values), expected(op, *values))


def test_memory_tells_shapes_apart() -> None:
    """The same bytes in another shape are another question, here one without an answer."""
    op = make()
    phi, start, actions = inputs(op, n=2, horizon=2)
    op.predict(phi, start, actions)
    with pytest.raises(SimulationError, match="actions have shape"):
        op.predict(phi, start, actions.reshape(4, 1, 1, 3))


# -- bad input -------------------------------------------------------------------------------------


def test_wrong_shapes_are_refused_when_the_graph_is_built() -> None:
    op = make()
    phi, start, actions = inputs(op)
    p = op.physics.layout.size
    with pytest.raises(SimulationError, match=rf"phi has shape \({p - 1},\), expected \({p}\)"):
        op(phi[:-1], start, actions)
    with pytest.raises(SimulationError, match="phi has shape"):
        op(phi[None], start, actions)
    with pytest.raises(SimulationError, match=r"start has shape .*expected \(\?, 1, 6\)"):
        op(phi, start[0], actions)
    with pytest.raises(SimulationError, match=r"start has shape \(12, 1, 5\)"):
        op(phi, start[..., :5], actions)
    with pytest.raises(SimulationError, match=r"actions has shape .*expected \(\?, \?, 1, 3\)"):
        op(phi, start, actions[:, 0])


@MODES
def test_wrong_values_are_refused_when_it_runs(mode) -> None:
    op = make()
    phi, start, actions = inputs(op)
    f = compiled(op, mode)
    with pytest.raises(SimulationError, match="finite"):
        f(phi, start + np.nan, actions)
    with pytest.raises(SimulationError, match="phi has shape"):
        f(phi[:-1], start, actions)
    with pytest.raises(SimulationError, match="actions have shape"):
        f(phi, start, actions[:-1])
    # and it still works
    np.testing.assert_array_equal(f(phi, start, actions), expected(op, phi, start, actions))


@MODES
@pytest.mark.parametrize("mass", [-1.0, 0.0, np.inf, np.nan])
def test_an_impossible_proposal_predicts_nothing(mode, mass) -> None:
    """A sampler whose transform over- or underflows gets there: its likelihood is then zero."""
    op = make()
    phi, start, actions = inputs(op)
    impossible = phi.copy()
    impossible[op.physics.layout.index("mass", "cart")] = mass
    f = compiled(op, mode)
    assert np.isnan(f(impossible, start, actions)).all()
    np.testing.assert_array_equal(f(phi, start, actions), expected(op, phi, start, actions))


# -- the derivative --------------------------------------------------------------------------------


@MODES
def test_gradient_is_that_of_the_closed_form(mode) -> None:
    """A drifting puck: x' = x + v t + F t^2 / 2 m, so d/dm = -F t^2 / 2 m^2; r does nothing."""
    scene = Scene(time_step=0.5, bodies=(Body("puck", BOX, known={"mu_c": 0.1}),))
    op = SimulatorOp(Physics(scene))
    phi = pt.dvector("phi")
    rng = np.random.default_rng(1)
    start, actions = rng.normal(0, 1, (5, 1, 6)), rng.normal(0, 3, (5, 1, 1, 3))
    cotangent = rng.normal(0, 1, (5, 1, 1, 6))
    gradient = pytensor.grad((op(phi, start, actions) * cotangent).sum(), phi)
    mass = 2.5
    moment = BOX.unit_moment * mass
    acceleration = actions / np.array([mass, mass, moment])
    derivative = np.concatenate([acceleration * 0.5**2 / 2, acceleration * 0.5], axis=-1) / -mass
    found = pytensor.function([phi], gradient, mode=mode)(np.array([mass, 0.3]))
    np.testing.assert_allclose(found, [(derivative * cotangent).sum(), 0.0], rtol=1e-7, atol=1e-9)


def test_all_columns_of_the_jacobian_come_in_one_call(monkeypatch) -> None:
    op = make()
    phi, start, actions = inputs(op)
    calls = []
    call = Simulator.__call__

    def counted(self, points, *rest):
        calls.append(np.shape(points))
        return call(self, points, *rest)

    monkeypatch.setattr(Simulator, "__call__", counted)
    jacobian = op.physics.jacobian(phi, start, actions)
    assert calls == [(2 * op.physics.layout.size, op.physics.layout.size)]
    assert jacobian.shape == (*actions.shape[:3], 6, op.physics.layout.size)
    # the mass turns force into acceleration; far from the wall elasticity does nothing
    assert np.abs(jacobian[..., op.physics.layout.index("mass", "cart")]).max() > 1e-3


def test_derivative_stays_inside_the_support() -> None:
    op = make(effects=())
    _, start, actions = inputs(make())
    phi = np.full(op.physics.layout.size, 0.1)
    phi[op.physics.layout.index("mass", "cart")] = 1e-9
    for name, bound in (("mu_x", 0.0), ("mu_y", 1.0), ("w_x", 0.45), ("r", 0.0)):
        phi[op.physics.layout.index(name, "cart")] = bound
    assert np.isfinite(op.physics.jacobian(phi, 0.0 * start, 1e-9 * actions)).all()


def test_start_states_have_no_derivative() -> None:
    op = make()
    phi, start, actions = inputs(op)
    variable = pt.as_tensor_variable(start)
    with pytest.raises(NullTypeGradError, match="differentiated by phi alone"):
        pytensor.grad(op(phi, variable, actions).sum(), variable)


def test_every_catalogue_effect_compiles_into_the_op() -> None:
    scene = make(gravity=(0.0, -0.5)).physics.scene
    names = tuple(
        effect.name for effect in catalogue
        if effect.applies(scene, scene.dynamic[0]) and effect.name != "distance_joint"
    )  # fmt: skip
    assert len(names) > 40
    op = make(effects=names, gravity=(0.0, -0.5))
    phi = np.array([max(prior.centre, 0.05) for prior in op.physics.layout.priors])
    _, start, actions = inputs(make())
    got = op(phi, start, actions).eval()
    np.testing.assert_array_equal(got, expected(op, phi, start, actions))


# -- one engine ------------------------------------------------------------------------------------


def test_an_engine_can_be_forced() -> None:
    op = make()
    values = inputs(op)
    values[1][..., 0] -= 20.0  # far from the wall
    forced = [op.physics.changed(engine=engine) for engine in ("chipmunk", "contact-free")]
    chipmunk, fast = map(SimulatorOp, forced)
    assert chipmunk != op and chipmunk == SimulatorOp(forced[0])
    np.testing.assert_array_equal(fast.predict(*values), op.predict(*values))
    np.testing.assert_allclose(chipmunk.predict(*values), op.predict(*values), atol=1e-11)


def test_ops_of_one_physics_share_its_worlds() -> None:
    op = make()
    other = SimulatorOp(op.physics)
    assert other.physics.simulator is op.physics.simulator
