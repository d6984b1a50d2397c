"""The arm's physics against closed forms and a plain loop of MuJoCo's steps."""

import dataclasses

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from ms_slam_env.robot.arm import load_arm
from ms_slam_env.robot.arm.cartesian_path import progress
from ms_slam_env.robot.arm.dynamics import ArmDynamics, smooth

MASS, LENGTH, KP, KV, GEAR = 2.0, 0.5, 400.0, 30.0, 2.0
LIFT = f"""
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body gravcomp="SUPPORT"><joint name="lift" axis="0 -1 0" actuatorgravcomp="MOTOR"/>
    <inertial pos="{LENGTH} 0 0" mass="{MASS}" diaginertia="1e-4 1e-4 1e-4"/>
    <site name="camera" pos="{LENGTH} 0 0"/>
  </body></worldbody>
  <actuator><position joint="lift" kp="{KP}" kv="{KV}" gear="{GEAR}"/></actuator>
</mujoco>"""
WEIGHT = MASS * 9.81


@pytest.fixture(params=[(0, "false"), (1, "false"), (1, "true")], ids=["bare", "spring", "motor"])
def lift(request, tmp_path):
    support, motor = request.param
    path = tmp_path / "lift.xml"
    path.write_text(LIFT.replace("SUPPORT", str(support)).replace("MOTOR", motor))
    return load_arm(str(path)), support


def turn(start, stop, seconds, tick_s=0.05):
    ticks = round(seconds / tick_s)
    share = progress(np.arange(ticks + 1) / ticks)
    return (start + (stop - start) * share)[:, None], tick_s


def test_work_of_lifting_is_weight_times_height(lift):
    arm, _ = lift
    dynamics = ArmDynamics(arm)
    dynamics.reset(np.array([-np.pi / 2]))  # hanging
    dynamics.run(np.array([[-np.pi / 2]]), 1.0, 500)
    motion = dynamics.run(*turn(-np.pi / 2, np.pi / 3, 8), 4200)
    height = LENGTH * (np.sin(motion.q[-1, 0]) + 1)
    assert_allclose(motion.energy_j, WEIGHT * height, rtol=0.02)


def test_a_load_sags_by_torque_over_stiffness(lift):
    arm, support = lift
    dynamics = ArmDynamics(arm)
    dynamics.reset(np.zeros(1))
    q = dynamics.run(np.zeros((1, 1)), 1.0, 3000).q[-1, 0]
    expected = 0.0 if support else -WEIGHT * LENGTH * np.cos(q) / (GEAR**2 * KP)
    assert_allclose(q, expected, atol=1e-6)


def test_the_servo_does_not_trail_behind_a_steady_motion(lift):
    arm, support = lift
    dynamics = ArmDynamics(arm)
    dynamics.reset(np.zeros(1))
    command = np.arange(61)[:, None] * 0.02
    motion = dynamics.run(command, 0.05, 1400)  # 0.4 rad/s; without the velocity 7.5 mrad behind
    late = command[-1, 0] - 0.4 * (3.0 - 1400 * 0.002) - motion.q[-1, 0]
    sag = 0 if support else WEIGHT * LENGTH * np.cos(motion.q[-1, 0]) / (GEAR**2 * KP)
    assert_allclose(late, sag, atol=2e-4)


def test_a_motion_is_a_loop_of_steps():
    arm = load_arm("mico")
    mj, rng = arm.mj, np.random.default_rng(0)
    command = arm.home + np.cumsum(rng.normal(0, 0.01, (11, 6)), axis=0)
    push = rng.normal(0, 0.5, (80, 6))
    dynamics = ArmDynamics(arm)
    dynamics.reset(command[0])
    motion = dynamics.run(command, 0.04, 80, push)
    data = mujoco.MjData(mj)
    data.qpos[arm.qpos] = command[0]
    q, velocity = smooth(command, 0.04, mj.opt.timestep * np.arange(80))
    kp, kv = mj.actuator_gainprm[:, 0], -mj.actuator_biasprm[:, 2]
    work = 0.0
    for k in range(80):
        data.ctrl[:] = q[k] + kv / kp * velocity[k]
        data.qfrc_applied[:] = push[k]
        before = data.qvel.copy()
        mujoco.mj_step(mj, data)
        work += np.abs(data.qfrc_actuator * (before + data.qvel) / 2).sum() * mj.opt.timestep
        assert_allclose(motion.q[k], data.qpos, rtol=0, atol=1e-12)
    assert_allclose(motion.velocity[-1], data.qvel, atol=1e-10)
    assert_allclose(motion.energy_j, work)


def test_it_goes_on_bit_exactly_from_a_saved_state():
    arm = load_arm("mico")
    first, second = ArmDynamics(arm), ArmDynamics(arm)
    command = arm.home + np.linspace(0, 0.3, 9)[:, None]
    first.reset(arm.home)
    first.run(command, 0.05, 70)
    second.reset(arm.home)
    second.state = first.state
    a, b = (d.run(command[::-1], 0.05, 100) for d in (first, second))
    assert_array_equal(a.q, b.q)
    assert_array_equal(a.velocity, b.velocity)
    assert a.energy_j == b.energy_j
    assert_array_equal(first.state, second.state)


def test_links_that_meet_stop_each_other():
    arm = load_arm("mico")
    spec = mujoco.MjSpec.from_file(str(arm.path))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    ghost = dataclasses.replace(arm, mj=spec.compile())
    rng = np.random.default_rng(0)
    through = arm.home
    while _penetration(arm, through) < 0.02:
        through = np.clip(arm.home + rng.uniform(-2, 2, 6), arm.chain.lower, arm.chain.upper)
    depth = []
    for model in (arm, ghost):
        dynamics = ArmDynamics(model)
        dynamics.reset(arm.home)
        q = dynamics.run(np.linspace(arm.home, through, 60), 0.05, 800).q[-1]
        depth.append(_penetration(arm, q))
    assert depth[0] < 0.003
    assert depth[1] > 0.01


def _penetration(arm, q):
    data = mujoco.MjData(arm.mj)
    data.qpos[:] = q
    mujoco.mj_forward(arm.mj, data)
    return -data.contact.dist.min(initial=0)


def test_joints_beside_the_chain_keep_their_place():
    from test_arm_model import SECOND_ARM

    arm = load_arm(str(SECOND_ARM), "lens")
    dynamics = ArmDynamics(arm)
    dynamics.reset(arm.home)
    dynamics.run(np.linspace(arm.home, arm.home + 0.2, 20), 0.05, 600)
    beside = np.setdiff1d(np.arange(arm.mj.nq), arm.qpos)
    position = dynamics.state[1 + beside]  # time comes first
    assert_allclose(position, arm.mj.qpos0[beside], atol=2e-3)


def test_smoothing_passes_through_ticks_and_rests_at_both_ends():
    q = np.cumsum(np.random.default_rng(0).normal(size=(7, 2)), axis=0)
    times = np.linspace(0, 0.6, 601)
    angles, velocity = smooth(q, 0.1, times)
    assert_allclose(angles[::100], q, atol=1e-12)
    assert_allclose(velocity[[0, -1]], 0, atol=1e-9)
    assert_allclose(velocity[1:-1], (angles[2:] - angles[:-2]) / 0.002, atol=0.2)
    after, still = smooth(q, 0.1, np.array([0.7, 5.0]))
    assert_allclose(after, np.tile(q[-1], (2, 1)))
    assert_allclose(still, 0, atol=1e-9)
    straight, speed = smooth(np.arange(9.0)[:, None], 0.5, np.array([1.1, 2.3]))
    assert_allclose(straight[:, 0], [2.2, 4.6])
    assert_allclose(speed, 2.0)
