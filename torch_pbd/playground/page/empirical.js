// What strokes alone say, before a model has learned from them: their mean and covariance at even shares of their times.

const SHARES = 50;

function place(rows, share) { // on the straight line between two samples
  const time = share * rows[rows.length - 1][0], after = Math.max(1, rows.findIndex((row) => row[0] >= time));
  const [a, b] = [rows[after - 1], rows[after]], part = (time - a[0]) / (b[0] - a[0] || 1);
  return [a[1] + part * (b[1] - a[1]), a[2] + part * (b[2] - a[2])];
}

export function empirical(strokes) {
  const path = [], covariance = [], mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  for (let i = 0; i < SHARES; i++) {
    const places = strokes.map((rows) => place(rows, i / (SHARES - 1)));
    const centre = [0, 1].map((k) => mean(places.map((each) => each[k])));
    const between = (k, l) => mean(places.map((each) => (each[k] - centre[k]) * (each[l] - centre[l])));
    const unbiased = strokes.length / (strokes.length - 1);
    path.push(centre);
    covariance.push([between(0, 0), between(0, 1), between(1, 1)].map((value) => unbiased * value));
  }
  return { path, covariance, draws: [] };
}
