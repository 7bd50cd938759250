/* A hit: the arm moves the mallet from the middle of the table to a contact with the puck, towards the target. */
const scene = { puck: [1.1, 0.15], target: [2.49, 0], selected: "puck", height: 0, roll: 0, pitch: 0, factor: 1, speed: 0.7 };
const VIEW = { left: -0.1, right: 2.65, low: -0.62, high: 0.62 };
const HANDLES = {
  puck: { left: 0.85, right: 1.35, low: -0.35, high: 0.35 }, /* where most hits of the data set are */
  target: { left: 1.9, right: 2.6, low: D.y[0], high: D.y[1] },
};
const degree = Math.PI / 180, [lowest, highest] = D.ranges.table_height, [slowest] = D.ranges.velocity_factor;
const tilt = D.ranges.table_pitch.map((angle) => Math.round(angle / degree));
const SLIDERS = [
  { name: "height", label: "Height of the table", low: 100 * lowest, high: 100 * highest, step: 0.5, unit: "cm", factor: 0.01 },
  { name: "pitch", label: "Tilt along the table", low: tilt[0], high: tilt[1], step: 0.25, unit: "°", factor: degree },
  { name: "roll", label: "Tilt across the table", low: tilt[0], high: tilt[1], step: 0.25, unit: "°", factor: degree },
  { name: "factor", label: "Velocity limits", low: 100 * slowest, high: 100, step: 1, unit: "%", factor: 0.01 },
  { name: "speed", label: "Speed of the hit", low: 40, high: 100, step: 1, unit: "% of the largest", factor: 0.01 },
];
const velocityFactor = () => scene.factor;

/* Axes of the table in the world, Ry(pitch) Rx(roll), and a point of the table in the world; it turns about its pivot. */
function tableAxes() {
  const [sr, cr, sp, cp] = [Math.sin(scene.roll), Math.cos(scene.roll), Math.sin(scene.pitch), Math.cos(scene.pitch)];
  return [cp, sp * sr, sp * cr, 0, cr, -sr, -sp, cp * sr, cp * cr];
}
const onTable = (x, y, z) => add(add(apply(tableAxes(), add([x, y, z], D.pivot, -1)), D.pivot, 1), [0, 0, scene.height], 1);

/* The nearest configuration with the tip at a point. */
const configurationAt = (point, q, tolerance) => nearest(q, (at) => {
  const { p, J } = tipOf(at);
  return { e: add(point, p, -1), J };
}, tolerance);

/* The objective of the data set: squared manipulability along the hit, minus the distance from home in rated velocities. */
function objectiveOf(q, d) {
  const { J } = tipOf(q), along = J[0].map((_, i) => d[0] * J[0][i] + d[1] * J[1][i] + d[2] * J[2][i]);
  const away = q.map((value, i) => (value - D.home[i]) / D.rated[i]);
  return dot(along, along) - dot(away, away);
}

/* Gradient ascent on the configurations with the tip at the point; the step halves when it fails. */
function ascend(point, d, q, steps) {
  let value = objectiveOf(q, d), length = 0.4;
  for (let step = 0; step < steps && length > 1e-3; step++) {
    const gradient = q.map((_, i) => (objectiveOf(q.map((v, k) => v + (k === i ? 1e-5 : 0)), d) - value) / 1e-5);
    const { J } = tipOf(q), free = add(gradient, leastSquares(J, J.map((row) => dot(row, gradient)), 1e-9), -1);
    const next = configurationAt(point, add(q, free, Math.min(length, 0.3 / Math.hypot(...free))), 1e-6);
    const nextValue = objectiveOf(next, d);
    if (nextValue > value) [q, value] = [next, nextValue];
    else length /= 2;
  }
  return [value, q];
}

/* The fastest joint velocities along a direction: at the optimum of the linear program all joints but two are at their
limits, and those two and the speed solve J dq = speed d. */
function fastestAlong(J, d) {
  const limit = D.velocity.map((value) => value * scene.factor), C = d.map((value) => -value);
  let best = [0, limit.map(() => 0)];
  for (let a = 0; a < n; a++) for (let b = a + 1; b < n; b++) {
    const others = limit.map((_, i) => i).filter((i) => i !== a && i !== b), column = (i) => J.map((row) => row[i]);
    const A = column(a), B = column(b), det = dot(A, cross(B, C));
    for (let signs = 0; Math.abs(det) > 1e-12 && signs < 2 ** others.length; signs++) {
      const dq = limit.map(() => 0);
      others.forEach((i, k) => { dq[i] = (signs >> k) & 1 ? limit[i] : -limit[i]; });
      const rest = J.map((row) => -dot(row, dq));
      dq[a] = dot(rest, cross(B, C)) / det;
      dq[b] = dot(A, cross(rest, C)) / det;
      const speed = dot(A, cross(B, rest)) / det;
      const within = [a, b].every((i) => Math.abs(dq[i]) <= limit[i]);
      if (within && speed > best[0]) best = [speed, dq];
    }
  }
  return best[1];
}

/* The start and the goal of a hit from the puck to the target, and the parameters of the problem. */
function requestOf() {
  const [px, py] = scene.puck, dx = scene.target[0] - px, dy = scene.target[1] - py, length = Math.hypot(dx, dy) || 1;
  const [ux, uy] = [dx / length, dy / length], d = apply(tableAxes(), [ux, uy, 0]);
  const point = onTable(px - D.contact * ux, py - D.contact * uy, D.z);
  const sides = [-0.3, 0.3].map((side) => ascend(point, d, configurationAt(point, D.home.map((v, i) => v + (i === 2 ? side : 0))), 6));
  const [, best] = ascend(point, d, sides[0][0] > sides[1][0] ? sides[0][1] : sides[1][1], 24), goal = configurationAt(point, best);
  const dq = fastestAlong(tipOf(goal).J, d), zero = D.home.map(() => 0);
  const values = { table_height: scene.height, table_roll: scene.roll, table_pitch: scene.pitch, velocity_factor: scene.factor };
  return [...configurationAt(onTable(...D.start), D.home), ...zero, ...zero, ...goal, ...dq.map((v) => v * scene.speed),
    ...Object.keys(D.ranges).map((name) => values[name])];
}

function drawScene() {
  const edge = [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]].map(([i, j]) => onTable(D.x[i], D.y[j], D.z));
  const tips = tipsOf(), top = ([x, y]) => [x, y], side = ([x, , z]) => [x, z];
  const above = prepared("scene", VIEW);
  above.area(edge.map(top), "#e5eef6");
  above.line([scene.puck, scene.target], "#7c8aa0", 1);
  poses().forEach((q, k) => drawArm(above, top, q, k === 4));
  if (last.code === 0) above.line(tips.map(top), "#c4581a", 3);
  above.disc(tips[0], D.mallet, "#8d99a8", false);
  if (last.code === 0) above.disc(tips[tips.length - 1], D.mallet, "#c4581a88", false);
  above.disc(scene.puck, D.puck, "#1f6fb2", scene.selected === "puck");
  above.disc(scene.target, D.puck, "#2a8a4a", scene.selected === "target");
  const beside = prepared("side", { left: -0.3, right: 2.2, low: -0.12, high: 1.02 });
  beside.area(edge.map(side), "#a9c4de");
  beside.line(edge.map(side), "#7c9ab8", 3);
  poses().forEach((q, k) => drawArm(beside, side, q, k === 4));
  if (last.code === 0) beside.line(tips.map(side), "#c4581a", 3);
}
