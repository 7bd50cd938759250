/* A transport: the arm carries a load upright from one pedestal to the other. Views have the world's y to the left. */
const scene = { start: [0.45, 0.4], goal: [-0.45, 0.4], selected: "start", from: 0.35, to: 0.35, mass: 8 };
const VIEW = { left: -0.9, right: 0.9, low: -0.3, high: 0.85 };
const [first, second] = D.pedestals, [lightest, heaviest] = D.ranges.payload_mass;
const HANDLES = {
  start: { left: -first[3], right: -first[2], low: first[0], high: first[1] },
  goal: { left: -second[3], right: -second[2], low: second[0], high: second[1] },
};
const SLIDERS = [
  { name: "mass", label: "Mass of the load", low: lightest, high: heaviest, step: 0.1, unit: "kg", factor: 1 },
  { name: "from", label: "Height at the start", low: 20, high: 50, step: 1, unit: "cm", factor: 0.01 },
  { name: "to", label: "Height at the goal", low: 20, high: 50, step: 1, unit: "cm", factor: 0.01 },
];
const velocityFactor = () => 1;
const placeOf = (name, height) => [scene[name][1], -scene[name][0], height];

/* The nearest configuration with the load upright at a point: the cross product of its z axis and the world's vanishes. */
const uprightAt = (point, q) => nearest(q, (at) => {
  const { p, R, J, axes } = tipOf(at), turn = cross([R[2], R[5], R[8]], [0, 0, 1]);
  return { e: [...add(point, p, -1), turn[0], turn[1]], J: [...J, axes.map((axis) => axis[0]), axes.map((axis) => axis[1])] };
});

/* Configurations near those of the example with the nearest positions, which are of the data set. */
function requestOf() {
  const ends = [placeOf("start", scene.from), placeOf("goal", scene.to)], wanted = ends.flat();
  const distance = (example) => Math.hypot(...add(wanted, example, -1));
  const example = D.examples.reduce((best, other) => (distance(other) < distance(best) ? other : best));
  const [start, goal] = ends.map((point, k) => uprightAt(point, example.slice(6 + k * n, 6 + (k + 1) * n)));
  const zero = start.map(() => 0);
  return [...start, ...zero, ...zero, ...goal, ...zero, scene.mass];
}

/* The edges of the load: its corners in turn, four edges in each direction. */
function drawLoad(view, project, q, color) {
  const { p, R } = tipOf(q), half = D.object.map((size) => size / 2);
  const corner = (a, b, c) => project(add(p, apply(R, [a * half[0], b * half[1], c * half[2]]), 1));
  for (const c of [-1, 1]) view.line([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]].map(([a, b]) => corner(a, b, c)), color, 2);
  for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) view.line([corner(a, b, -1), corner(a, b, 1)], color, 2);
}

function drawScene() {
  const tips = tipsOf(), top = ([x, y]) => [-y, x], side = ([, y, z]) => [-y, z];
  const above = prepared("scene", VIEW), beside = prepared("side", { left: -0.9, right: 0.9, low: -0.05, high: 1.1 });
  D.pedestals.forEach(([x0, x1, y0, y1], k) => {
    const height = (k ? scene.to : scene.from) - D.object[2] / 2;
    above.area([[x0, y0], [x1, y0], [x1, y1], [x0, y1]].map(top), "#dfe6ee");
    beside.area([[0, y0, 0], [0, y1, 0], [0, y1, height], [0, y0, height]].map(side), "#dfe6ee");
  });
  for (const [view, project] of [[above, top], [beside, side]]) {
    poses().forEach((q, k, all) => {
      drawArm(view, project, q, k === 0 || k === all.length - 1);
      drawLoad(view, project, q, k === 0 ? "#1f6fb2" : k === 4 ? "#2a8a4a" : "#c4581a66");
    });
    if (last.code === 0) view.line(tips.map(project), "#c4581a", 3);
  }
  above.disc(scene.start, 0.02, "#1f6fb2", scene.selected === "start");
  above.disc(scene.goal, 0.02, "#2a8a4a", scene.selected === "goal");
}
