// Six strokes of a movement: wide where it is free, close where it is precise. Positions in m, times in s.

function generator(seed) { // mulberry32: the same strokes at every start
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

const SHAPES = {
  "Reach and insert": {
    path: (s) => [0.12 + 0.62 * s, 0.16 + 0.26 * Math.sin(Math.PI * Math.min(1, 1.15 * s)) * (1 - 0.35 * s) + 0.1 * s],
    spread: (s) => 0.05 * (1 - s) ** 1.5 + 0.003,
  },
  "Letter S": {
    path: (s) => [0.45 + 0.2 * Math.sin(2 * Math.PI * (1.12 - s) + 0.75) * (0.85 + 0.15 * s), 0.52 - 0.44 * s],
    spread: (s) => 0.003 + 0.035 * Math.sin(Math.PI * s) ** 2,
  },
  "Through a gate": {
    path: (s) => [0.1 + 0.7 * s, 0.3 + 0.14 * Math.sin(2 * Math.PI * s)],
    spread: (s) => 0.003 + 0.05 * Math.abs(s - 0.5) ** 1.2 * 2,
  },
};

export const EXAMPLES = Object.keys(SHAPES);

export function example(name, count = 6) {
  const random = generator(7 + EXAMPLES.indexOf(name));
  const normal = () => Math.sqrt(-2 * Math.log(1 - random())) * Math.cos(2 * Math.PI * random());
  const { path, spread } = SHAPES[name];
  return Array.from({ length: count }, () => {
    const weights = Array.from({ length: 8 }, normal), duration = 2.2 * (1 + 0.12 * normal()), bend = 0.12 * normal();
    const steps = Math.round(duration * 60), rows = [];
    for (let i = 0; i <= steps; i++) {
      const u = i / steps, minimumJerk = u * u * u * (10 - 15 * u + 6 * u * u);
      const s = Math.min(1, Math.max(0, minimumJerk + bend * Math.sin(Math.PI * u) * 0.3));
      const off = [0, 4].map((k) => weights[k] * Math.cos(2.2 * s) + weights[k + 1] * Math.sin(2.2 * s)
        + 0.4 * (weights[k + 2] * Math.cos(5 * s) + weights[k + 3] * Math.sin(5 * s)));
      const [x, y] = path(s), wide = spread(s);
      rows.push([i * duration / steps, x + 0.6 * wide * off[0], y + 0.6 * wide * off[1]]);
    }
    return rows;
  });
}
