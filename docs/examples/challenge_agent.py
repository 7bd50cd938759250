"""Agent for the evaluator of the Air Hockey Challenge (2023): ``7dof-hit`` with ``interpolation_order=None``.

    python docs/examples/challenge_run.py --environment CLONE --episodes 30

The agent waits at a home configuration, predicts the puck and the opponent's mallet, plans a hit that meets the moving
puck, and returns. The planner is a network of cnpgen; the executed motions are those of ``PlanRuntime``.
"""

from __future__ import annotations

import mujoco
import numpy as np
from air_hockey_challenge.framework import AgentBase

import cnpgen
from cnpgen.results import HitOptions, PlanRuntime, PuckModel

TICK_S, TICKS_PER_STEP = 1e-3, 20
GOAL = np.array([2.49, 0.0])  # m, in the robot's frame
AIMS_M = np.array(
    [-0.065, -0.04, -0.02, 0.0, 0.02, 0.04, 0.065]
)  # offsets from the goal's centre
SPEED_SHARES = (
    0.95,
    0.7,
)  # of the highest possible speed; the second if the keeper is in the way of the first
MIN_ACCEPTED_M = -0.005  # smallest margin of a hit
PUCK = PuckModel(
    restitution=0.46,
    friction=1.0,
    band_restitution=0.7,
    band_loss=1 / 3,
    home_edge=0.5677,
)
REACH_X_M, REACH_Y_M = (0.72, 1.32), 0.43  # of pucks that are hit
MEETING_TIMES_S = np.arange(0.34, 2.6, 0.06)
MIN_CONTACT_TIME_S = 0.05  # of a hit that is executed
MIN_DELAY_S, MAX_DELAY_S = (
    0.1,
    0.18,
)  # before the start of a hit, for planning in several steps
CHECKED_STATES, MIN_CLEARANCE = (
    30,
    0.005,
)  # of a plan; m, rad and rad/s, for the error of the controller
KEEPER_RATE_RAD_S = 3.0  # of the opponent's motion
KEEPER_X_M = np.linspace(2.28, 2.48, 6)
KEEPER_RADIUS_M = 0.08
MIN_MARGIN_M = 0.03  # of the puck to keeper and posts, to hit at once
SAFE_X_M = 0.78  # a puck that stays farther away can wait until the arm is at home
FIRST_MOTION_S = 2.2
PUSH_ANGLES_RAD = np.radians(
    np.arange(-180.0, 180.0, 15.0)
)  # of pucks that the arm cannot hit forwards
PUSH_SHARES = np.array([0.2, 0.35, 0.5])
PUSH_MEETING_S = 0.75
PUSH_REST_S = 3.0
MAX_PUSH_COST_M = 0.6
OWN_GOAL_M = 0.19  # half width of the goal with a margin
PUSHED_TO_M = np.array([1.0, 0.0])


class Mallet:
    """Model of the mallet: a payload that the controller does not know, on a passive universal joint.

    Args:
        env_info: Information of the environment.
    """

    mass, com, inertia = 0.283, 0.0682827, 0.005  # kg, m, kg m^2
    gain, damping = 4.0, 0.31  # of the joint's controller [N m/rad], [N m s/rad]
    contact_height = 0.05  # of the puck below the tip [m]
    dry = np.array(
        [0.384477, 0.496333, 0.173951, 0.3751, 0.481099, 0.196149, 0.299238]
    )  # N m
    viscous = np.array(
        [0.33032, 0.21216, 0.1, 0.219041, 0.185923, 0.1, 0.1]
    )  # N m s/rad

    def __init__(self, env_info):
        self.model = env_info["robot"]["robot_model"]
        self.data = mujoco.MjData(self.model)
        self.body = self.model.body("iiwa_1/striker_joint_link").id

    def kinematics(self, q, inertia=False):
        """Return positions, rotations, Jacobians and, on request, inertia matrices at K states."""
        x, R = np.zeros((len(q), 3)), np.zeros((len(q), 3, 3))
        J, M = np.zeros((len(q), 6, 7)), np.zeros((len(q), 7, 7))
        for k, joints in enumerate(q):
            self.data.qpos[:] = joints
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            x[k], R[k] = (
                self.data.xpos[self.body],
                self.data.xmat[self.body].reshape(3, 3),
            )
            mujoco.mj_jacBody(self.model, self.data, J[k, :3], J[k, 3:], self.body)
            if inertia:
                mujoco.mj_crb(self.model, self.data)
                mujoco.mj_fullM(self.model, self.data, M[k])
        return x, R, J, M

    def feedforward(self, q, dq, ddq):
        """Return accelerations that make up for the payload and the friction, shape (K, 7)."""
        _, _, J, M = self.kinematics(q, inertia=True)
        velocity = np.einsum("kij,kj->ki", J[:, :3], dq)
        force = self.mass * (np.gradient(velocity, TICK_S, axis=0) + [0.0, 0.0, 9.81])
        torque = (
            np.einsum("kij,ki->kj", J[:, :3], force)
            + self.viscous * dq
            + self.dry * np.tanh(dq / 0.02)
        )
        return ddq + np.linalg.solve(M, torque[..., None])[..., 0]

    def offset(self, q, dq, dt):
        """Return the horizontal offset of the mallet's disc from the tip [m] and its velocity, at the last state."""
        _, R, J, _ = self.kinematics(q)
        v, w = (
            np.einsum("kij,kj->ki", J, dq)[:, [0, 1, 3, 4]]
            .reshape(-1, 2, 2)
            .transpose(1, 0, 2)
        )
        a, rate = np.gradient(v, dt, axis=0), np.stack([-w[:, 1], w[:, 0]], axis=1)
        rest = self._commanded(R)
        h, lever = self.contact_height, self.mass * self.com
        u, du = rest[0].copy(), np.zeros(2)
        for k in range(len(q)):
            torque = -self.gain * (u - rest[k]) - self.damping * (du - h * rate[k])
            torque -= 9.81 * lever * u + h * lever * a[k]
            du = du + torque / (self.inertia + lever * self.com) * dt
            u = u + du * dt
        return u, du

    def _commanded(self, R):
        """Return the offsets at the angles to which the environment moves the universal joint."""
        x, y, zero = R[..., 0], R[..., 1], np.zeros(len(R))

        def angle(a, b, axis):
            return np.arctan2(
                np.sum(np.cross(a, b) * axis, axis=1), np.sum(a * b, axis=1)
            )

        first = angle(x, np.stack([-y[:, 1], y[:, 0], zero], 1), y)
        rows = (
            [zero, -y[:, 2], y[:, 1]],
            [y[:, 2], zero, -y[:, 0]],
            [-y[:, 1], y[:, 0], zero],
        )
        cross = np.stack([np.stack(row, 1) for row in rows], 1)
        s, c = np.sin(first)[:, None, None], np.cos(first)[:, None, None]
        turned = np.einsum("kij,kj->ki", np.eye(3) + cross * s + cross**2 * (1 - c), x)
        second = angle(y, np.stack([turned[:, 1], -turned[:, 0], zero], 1), turned)
        local = np.stack(
            [
                np.sin(first) * np.cos(second),
                -np.sin(second),
                np.cos(first) * np.cos(second),
            ],
            1,
        )
        axis = np.einsum("kij,kj->ki", R, local)
        return self.contact_height * axis[:, :2] / np.abs(axis[:, 2:])


class HitAgent(AgentBase):
    """Wait, hit the moving puck past the opponent's mallet, return, and wait again."""

    warm_up_steps = 40

    def __init__(self, env_info, **kwargs):
        super().__init__(env_info, **kwargs)
        self.planner = cnpgen.Planner("airhockey-online")
        self.home = self.planner.robot.home
        self.mallet = Mallet(env_info)
        self.log = []
        self.reset()
        self.warm_up()

    def reset(self):
        """Forget the last episode."""
        self.step, self.runtime, self.shot, self.keeper = 0, None, None, None

    def draw_action(self, observation):
        """Return the next 20 set-points; see ``action``."""
        q, puck, velocity = observation[6:12], observation[:2], observation[3:5]
        now = self.step * TICKS_PER_STEP * TICK_S
        if self.runtime is None:
            self.start(q, puck, velocity)
        keeper = observation[21]
        speed = 0.0 if self.keeper is None else (keeper - self.keeper) / 0.02
        self.keeper = keeper
        if now >= self.runtime.end_time - 1e-9 and self.step > 0:
            self.think(
                now, puck, velocity, np.array([keeper, speed / KEEPER_RATE_RAD_S])
            )
        self.step += 1
        return self.action(now)

    def warm_up(self):
        """Load all kernels before the first step."""
        observation = np.zeros(23)
        observation[:2], observation[6:12], observation[20] = [1.0, 0.2], self.home, 2.4
        for _ in range(self.warm_up_steps):
            self.draw_action(observation)
        still = np.zeros(6)
        hits = cnpgen.plan_hits(
            self.planner, (self.home, still, still), observation[:2], GOAL
        )
        cnpgen.refine_plans(hits.plans, workers=1)
        self.reset()

    def start(self, q, puck, velocity):
        """Begin with the motion to the home configuration, unless the puck would be lost meanwhile."""
        self.runtime = PlanRuntime(
            self.planner, q, judge=False
        )  # ``checked`` applies the Challenge's own rules
        later, _ = PUCK.predict(puck[None], velocity[None], np.array([FIRST_MOTION_S]))
        if later[0, 0] > SAFE_X_M or np.abs(q - self.home).max() < 1e-6:
            self.go_home(q, 0.0)

    def go_home(self, q, at):
        """Move from rest to the home configuration."""
        self.runtime.switch(self.planner.plan(q, self.home), at)

    def action(self, now):
        """Return positions, velocities and accelerations of the next 20 ticks, shape (20, 3, 7)."""
        count = round(now / TICK_S)
        states = self.runtime.set_point(
            (count + np.arange(TICKS_PER_STEP + 1)) * TICK_S
        )
        q, dq, ddq = (np.pad(values, ((0, 0), (0, 1))) for values in states)
        return np.stack([q, dq, self.mallet.feedforward(q, dq, ddq)], axis=1)[
            :TICKS_PER_STEP
        ]

    def think(self, now, puck, velocity, keeper):
        """Take the next step of the decision: find a meeting, plan three times, check the hit, add the way back."""
        rest = self.runtime.state_at(now).q
        if self.shot is None:
            self.shot, waits = self.find_shot(now, rest, puck, velocity, keeper)
            if (
                self.shot is None
                and not waits
                and np.abs(rest - self.home).max() > 1e-6
            ):
                self.go_home(rest, now)
        elif self.shot["plans"] < 3:
            self.aim(self.shot, now, rest, puck, velocity)
        elif "hit" not in self.shot:
            self.shot["hit"] = (
                self.checked(self.shot["hits"].plans) if self.shot["planned"] else None
            )
            self.shot = None if self.shot["hit"] is None else self.shot
        else:
            shot, self.shot = self.shot, None
            self.switch_to(shot, now)

    def switch_to(self, shot, now):
        """Switch to a hit and its way back, if both keep the constraints and there is time."""
        hit = shot["hit"]
        start = shot["time"] - float(
            hit.duration[0] - shot["hits"].overlap / hit.columns["hit_speed"][0]
        )
        if start < now:
            return
        q, dq, ddq = hit.states_at(hit.duration)
        back = self.checked(self.planner.plan(q, self.home, start_dq=dq, start_ddq=ddq))
        if back is not None:
            shot["switch"] = self.runtime.switch(cnpgen.join_plans(hit, back), start)
            self.log.append(shot)

    def checked(self, plan):
        """Return a plan that keeps the constraints, or else the refined one; None if that violates one, too."""
        if self.keeps_constraints(plan):
            return plan
        refined = cnpgen.refine_plans(plan, workers=1).plans
        return refined if self.keeps_constraints(refined) else None

    def keeps_constraints(self, plan):
        """Return whether a plan keeps the Challenge's constraints with a margin."""
        states = plan.motion.at_times(
            np.linspace(0, 1, CHECKED_STATES)[None] * plan.duration[:, None]
        )
        q, dq = (
            np.pad(values[0], ((0, 0), (0, 1))) for values in (states.q, states.dq)
        )
        values = map(self.env_info["constraints"].fun, q, dq)
        return (
            max(value.max() for row in values for value in row.values())
            < -MIN_CLEARANCE
        )

    def find_shot(self, now, rest, puck, velocity, keeper):
        """Return a hit to the goal or else a push, and whether to wait if there is none."""
        best, waits = None, False
        for share in SPEED_SHARES:
            shot = self.find_meeting(now, rest, puck, velocity, keeper, share)
            if shot is not None and (best is None or shot["margin"] > best["margin"]):
                best = shot
            if best is not None and best["margin"] >= MIN_MARGIN_M:
                break
        if best is not None and best["margin"] >= MIN_ACCEPTED_M:
            waits = best["delay"] > MAX_DELAY_S
            return (None if waits else best), waits
        return self.find_push(now, rest, puck, velocity), False

    def find_meeting(self, now, rest, puck, velocity, keeper, share):
        """Return the earliest meeting whose puck passes the keeper, or that with the largest margin."""
        still = np.zeros(6)
        hits = cnpgen.plan_hits(
            self.planner,
            (rest, still, still),
            puck,
            GOAL,
            puck_velocity=velocity,
            meeting_time=MEETING_TIMES_S,
            options=HitOptions(speed_share=share, puck_model=PUCK),
        )
        rows = hits.plans.sample_id
        meeting = MEETING_TIMES_S[rows]
        pucks = np.tile(puck, (len(rows), 1)), np.tile(velocity, (len(rows), 1))
        position, puck_velocity = PUCK.predict(*pucks, meeting)
        good = (
            (hits.delay >= MIN_DELAY_S)
            & (position[:, 0] > REACH_X_M[0])
            & (position[:, 0] < REACH_X_M[1])
        )
        good &= np.abs(position[:, 1]) < REACH_Y_M
        if not good.any():
            return None
        rows, meeting, delay = np.flatnonzero(good), meeting[good], hits.delay[good]
        position, puck_velocity, speed = (
            position[good],
            puck_velocity[good],
            hits.plans.columns["hit_speed"][good],
        )
        target = GOAL + np.stack([np.zeros_like(AIMS_M), AIMS_M], 1)
        line = target[None] - position[:, None]  # (K, aims, 2)
        length = np.linalg.norm(line, axis=2)
        along = line / length[..., None]
        approach = np.einsum("kai,ki->ka", along, puck_velocity)
        after = (1 + PUCK.restitution) * speed[:, None] - PUCK.restitution * approach
        part = (KEEPER_X_M - position[:, None, None, 0]) / line[..., :1]  # (K, aims, X)
        with np.errstate(invalid="ignore"):
            flight = (
                -np.log(1 - PUCK.drag * part * length[..., None] / after[..., None])
                / PUCK.drag
            )
        arrival = meeting[:, None, None] + flight
        y = keeper[0] * np.cos(KEEPER_RATE_RAD_S * arrival) + keeper[1] * np.sin(
            KEEPER_RATE_RAD_S * arrival
        )
        clear = (
            np.abs(position[:, None, None, 1] + part * line[..., 1:] - y)
            - KEEPER_RADIUS_M
        )
        margin = np.nan_to_num(clear.min(axis=2), nan=-1.0)
        margin = np.minimum(margin, 0.0933 - np.abs(AIMS_M)) - 0.1 * np.abs(AIMS_M)
        best = margin.argmax(axis=1)
        score = margin[np.arange(len(best)), best]
        enough = np.flatnonzero(score >= MIN_MARGIN_M)
        index = int(enough[0]) if len(enough) else int(score.argmax())
        return {
            "time": now + meeting[index],
            "target": target[best[index]],
            "plans": 0,
            "margin": score[index],
            "delay": delay[index],
            "share": share,
            "u": np.zeros(2),
            "du": np.zeros(2),
            "speed": speed[index],
        }

    def find_push(self, now, rest, puck, velocity):
        """Return a slow hit that moves a puck at the arm's own band, where it cannot be hit forwards, to the centre."""
        still, time = np.zeros(6), np.array([PUSH_MEETING_S])
        (position,), (puck_velocity,) = PUCK.predict(puck[None], velocity[None], time)
        angles, shares = (
            part.ravel() for part in np.meshgrid(PUSH_ANGLES_RAD, PUSH_SHARES)
        )
        normals = np.stack([np.cos(angles), np.sin(angles)], 1)
        hits = cnpgen.plan_hits(
            self.planner,
            (rest, still, still),
            np.tile(position, (len(angles), 1)),
            position + normals,
            options=HitOptions(speed_share=shares),
        )
        rows, speed = hits.plans.sample_id, hits.plans.columns["hit_speed"]
        delay = PUSH_MEETING_S - hits.contact_time
        before = np.tile(puck_velocity, (len(rows), 1))
        after = PUCK.velocity_after(
            before, speed[:, None] * normals[rows], normals[rows]
        )
        end, _ = PUCK.predict(
            np.tile(position, (len(rows), 1)), after, np.full(len(rows), PUSH_REST_S)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            at_band = (
                position[1] + after[:, 1] * (PUCK.home_edge - position[0]) / after[:, 0]
            )
        own_goal = (after[:, 0] < 0) & (np.abs(at_band) < OWN_GOAL_M)
        cost = np.linalg.norm((end - PUSHED_TO_M) * [1.0, 0.5], axis=1)
        cost = np.where(own_goal | (delay < MIN_DELAY_S), np.inf, cost)
        if not len(cost) or cost.min() > MAX_PUSH_COST_M:
            return None
        index = int(cost.argmin())
        return {
            "time": now + PUSH_MEETING_S,
            "normal": normals[rows[index]],
            "plans": 0,
            "margin": -cost[index],
            "share": shares[rows[index]],
            "u": np.zeros(2),
            "du": np.zeros(2),
            "speed": speed[index],
        }

    def aim(self, shot, now, rest, puck, velocity):
        """Plan the hit so that the disc of the tilted mallet meets the puck behind its centre."""
        still = np.zeros(6)
        left = np.array([shot["time"] - now])
        position, puck_velocity = PUCK.predict(puck[None], velocity[None], left)
        normal = shot.get("normal")
        if "target" in shot:
            angle = PUCK.hit_angle(
                puck_velocity, np.array([shot["speed"]]), shot["target"] - position
            )[0]
            normal = np.array([np.cos(angle), np.sin(angle)])
        tip = shot["speed"] * normal - shot["du"]
        tip = tip / np.linalg.norm(tip)
        goal = position[0] - shot["u"] + 0.07 * (tip - normal)
        hits = cnpgen.plan_hits(
            self.planner,
            (rest, still, still),
            goal,
            goal + tip,
            options=HitOptions(speed_share=shot["share"]),
        )
        shot["plans"] += 1
        shot["hits"], shot["normal"], shot["position"], shot["velocity"] = (
            hits,
            normal,
            position[0],
            puck_velocity[0],
        )
        contact = 0.0 if hits.reasons[0] else float(hits.contact_time[0])
        shot["planned"] = (
            contact >= MIN_CONTACT_TIME_S
        )  # not for a mallet that is at the puck already
        if not shot["planned"]:
            shot["plans"] = 3
            return
        plan = hits.plans
        states = plan.motion.at_times(
            np.arange(0, contact + 1e-9, contact / np.ceil(contact / 3e-3))[None]
        )
        q, dq = (
            np.pad(values[0], ((0, 0), (0, 1))) for values in (states.q, states.dq)
        )
        shot["u"], shot["du"] = self.mallet.offset(
            q, dq, contact / np.ceil(contact / 3e-3)
        )
        shot["speed"] = float(
            np.linalg.norm(plan.columns["hit_speed"][0] * tip + shot["du"])
        )


def build_agent(env_info, **kwargs):
    """Return the agent."""
    return HitAgent(
        env_info,
        **{name: value for name, value in kwargs.items() if name == "agent_id"},
    )
