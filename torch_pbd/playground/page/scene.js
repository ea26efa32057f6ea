// What is drawn: strokes, models, via points, the robot with its stiffness and its force; and the strip below.

export const WORLD = { width: 0.9, height: 0.6 }; // m

let colours = {};
export function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ground", "ink", "soft", "line", "strokes", "model", "second", "empirical", "robot", "force"])
    colours[name] = style.getPropertyValue(`--${name}`).trim();
}

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => this.fit()).observe(canvas);
    this.fit();
  }

  fit() {
    const { clientWidth: w, clientHeight: h } = this.canvas, ratio = window.devicePixelRatio || 1;
    this.canvas.width = w * ratio;
    this.canvas.height = h * ratio;
    this.width = w;
    this.height = h;
    this.ratio = ratio;
    this.scale = Math.min((w - 30) / WORLD.width, (h - 30) / WORLD.height);
    this.left = (w - this.scale * WORLD.width) / 2;
    this.bottom = (h + this.scale * WORLD.height) / 2;
  }

  pixel([x, y]) { return [this.left + this.scale * x, this.bottom - this.scale * y]; }

  world([px, py]) { return [(px - this.left) / this.scale, (this.bottom - py) / this.scale]; }

  begin() {
    this.context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    this.context.clearRect(0, 0, this.width, this.height);
    this.context.lineJoin = this.context.lineCap = "round";
  }
}

function line(view, points, colour, width, alpha = 1, dash = []) {
  const c = view.context;
  c.globalAlpha = alpha;
  c.strokeStyle = colour;
  c.lineWidth = width;
  c.setLineDash(dash);
  c.beginPath();
  points.forEach((point, i) => (i ? c.lineTo(...view.pixel(point)) : c.moveTo(...view.pixel(point))));
  c.stroke();
  c.setLineDash([]);
  c.globalAlpha = 1;
}

// Axes of a symmetric matrix (xx, xy, yy): [larger, smaller] eigenvalue, and the angle of the larger one's axis.
function axes([xx, xy, yy]) {
  const middle = (xx + yy) / 2, radius = Math.hypot((xx - yy) / 2, xy);
  return [middle + radius, Math.max(0, middle - radius), Math.atan2(2 * xy, xx - yy) / 2];
}

function ellipse(view, centre, half, angle, { stroke, fill, alpha = 1, width = 1 }) {
  const c = view.context;
  c.beginPath();
  c.ellipse(...view.pixel(centre), half[0], half[1], -angle, 0, 2 * Math.PI); // y is up
  c.globalAlpha = alpha;
  if (fill) { c.fillStyle = fill; c.fill(); }
  if (stroke) { c.strokeStyle = stroke; c.lineWidth = width; c.stroke(); }
  c.globalAlpha = 1;
}

function mark(view, point, colour, text) {
  const c = view.context, [x, y] = view.pixel(point);
  c.fillStyle = colour;
  c.font = "12px system-ui, sans-serif";
  c.fillText(text, x + 9, y - 9);
}

function legend(view, entries) { // along the frame's lower edge, as many in a row as fit
  const c = view.context, left = view.left + 10, right = view.left + view.scale * WORLD.width - 10;
  c.font = "12px system-ui, sans-serif";
  c.lineWidth = 3;
  let x = left, y = view.bottom - 10;
  for (const [text, colour] of entries) {
    const width = c.measureText(text).width + 44;
    if (x > left && x + width > right) { x = left; y -= 17; }
    c.strokeStyle = colour;
    c.beginPath();
    c.moveTo(x, y - 4);
    c.lineTo(x + 20, y - 4);
    c.stroke();
    c.fillStyle = colours.soft;
    c.fillText(text, x + 26, y);
    x += width;
  }
}

export function drawScene(view, state) {
  view.begin();
  const c = view.context, [x0, y1] = view.pixel([0, WORLD.height]);
  c.strokeStyle = colours.line;
  c.lineWidth = 1;
  c.strokeRect(x0, y1, view.scale * WORLD.width, view.scale * WORLD.height);
  for (const stroke of state.strokes)
    if (!stroke.hidden) line(view, stroke.rows.map((row) => row.slice(1)), colours.strokes, 1.4, 1);
  if (state.current) line(view, state.current.map((row) => row.slice(1)), colours.ink, 2);
  const entries = [["your strokes", colours.strokes]];
  if (state.shown.length)
    state.shown.forEach((name, which) => {
      const colour = which ? colours.second : colours.model;
      entries.push([`${name}: mean, 2 sd`, colour]);
      drawModel(view, state, state.pictures[name], colour, which ? [7, 6] : []);
    });
  else if (state.measured) {
    entries.push(["their mean, 2 sd", colours.empirical]);
    drawModel(view, state, state.measured, colours.empirical);
  }
  if (state.robot && state.robot.is_there) entries.push(["robot, its stiffness", colours.robot]);
  legend(view, entries);
  for (const [i, via] of state.via.entries()) {
    const colour = i === state.chosen ? colours.force : colours.ink, [x, y] = view.pixel(via.point);
    c.strokeStyle = colour;
    c.lineWidth = 2;
    c.strokeRect(x - 5, y - 5, 10, 10);
  }
  if (state.mode === "draw" && state.pen) ellipse(view, state.pen, [4, 4], 0, { stroke: colours.ink, width: 1.5 });
  if (state.mode === "bend" && state.place !== null && state.shown.length) {
    const path = state.pictures[state.shown[0]].path, at = path[Math.round(state.place * (path.length - 1))];
    ellipse(view, at, [8, 8], 0, { stroke: colours.ink, width: 1.5 });
  }
  if (state.robot && state.robot.is_there) drawRobot(view, state);
}

function drawModel(view, state, picture, colour, dash = []) {
  if (state.draws) for (const made of picture.draws) line(view, made, colour, 1, 0.35);
  picture.covariance.forEach((matrix, i) => {
    if (i % 3) return;
    const [large, small, angle] = axes(matrix); // two standard deviations
    const half = [large, small].map((value) => Math.max(1, 2 * view.scale * Math.sqrt(value)));
    ellipse(view, picture.path[i], half, angle, { stroke: colour, fill: colour, alpha: 0.13 });
  });
  line(view, picture.path, colour, 3, 1, dash);
  if (dash.length) return;
  const first = picture.path[0], last = picture.path[picture.path.length - 1];
  for (const end of [first, last]) ellipse(view, end, [4, 4], 0, { fill: colour });
  mark(view, first, colours.ink, "start");
  mark(view, last, colours.ink, "goal");
}

function drawRobot(view, state) {
  const { position, desired, stiffness, force } = state.robot, c = view.context;
  const [large, small, angle] = axes(stiffness), most = state.settings.stiffness_max;
  const half = [large, small].map((value) => 6 + 38 * value / most);
  ellipse(view, position, half, angle, { stroke: colours.robot, width: 2 });
  line(view, [position, desired], colours.soft, 1, 1, [3, 3]);
  ellipse(view, desired, [3, 3], 0, { fill: colours.soft });
  if (state.hand) {
    spring(view, position, state.hand);
    ellipse(view, state.hand, [6, 6], 0, { fill: colours.force });
  }
  if (Math.hypot(...force) > 0.05) {
    const [x, y] = view.pixel(position), tip = [x + 5 * force[0], y - 5 * force[1]]; // 5 px a newton
    const turn = Math.atan2(tip[1] - y, tip[0] - x);
    c.strokeStyle = c.fillStyle = colours.force;
    c.lineWidth = 2.5;
    c.beginPath();
    c.moveTo(x, y);
    c.lineTo(...tip);
    for (const side of [2.6, -2.6]) { c.moveTo(...tip); c.lineTo(tip[0] + 8 * Math.cos(turn + side), tip[1] + 8 * Math.sin(turn + side)); }
    c.stroke();
  }
  ellipse(view, position, [7, 7], 0, { fill: colours.robot, stroke: colours.ground, width: 1.5 });
}

function spring(view, from, to) {
  const c = view.context, [a, b] = [view.pixel(from), view.pixel(to)], length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
  const along = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
  c.strokeStyle = colours.force;
  c.lineWidth = 1.5;
  c.beginPath();
  c.moveTo(...a);
  for (let i = 1; i < 24; i++) {
    const share = i / 24, off = i % 2 ? 5 : -5;
    c.lineTo(a[0] + share * (b[0] - a[0]) - off * along[1], a[1] + share * (b[1] - a[1]) + off * along[0]);
  }
  c.lineTo(...b);
  c.stroke();
}

export function drawStrip(view, state) {
  view.begin();
  const c = view.context, { width, height } = view, left = 52, right = width - 56, top = 18, bottom = height - 18;
  c.font = "11px system-ui, sans-serif";
  c.fillStyle = colours.soft;
  if (!state.schedule) {
    c.fillText("stiffness and deviation over the movement, once there are two strokes", 14, height / 2);
    return;
  }
  const { stiffness, duration } = state.schedule, most = state.settings.stiffness_max;
  const across = (time) => left + (right - left) * Math.min(1, time / duration);
  const widest = Math.max(0.01, ...state.trace.map((row) => row[1]));
  c.fillText(`K ${most.toFixed(0)}`, 8, top + 4);
  c.fillText("N/m  0", 8, bottom + 4);
  c.fillText("stiffness along the stiffer and the softer axis", left + 4, top - 5);
  c.fillText("0 s", left, height - 4);
  c.textAlign = "right";
  c.fillText(`${duration.toFixed(1)} s`, right, height - 4);
  c.fillStyle = colours.robot;
  c.fillText("deviation of the robot", right - 4, top - 5);
  c.textAlign = "left";
  c.fillText(`${(1000 * widest).toFixed(0)} mm`, right + 6, top + 4);
  c.strokeStyle = colours.line;
  c.lineWidth = 1;
  c.strokeRect(left, top, right - left, bottom - top);
  for (const axis of [0, 1]) {
    c.strokeStyle = colours.model;
    c.lineWidth = axis ? 2 : 1.2;
    c.beginPath();
    stiffness.forEach((row, i) => {
      const x = left + (right - left) * i / Math.max(1, stiffness.length - 1), y = bottom - (bottom - top) * row[axis] / most;
      if (i) c.lineTo(x, y); else c.moveTo(x, y);
    });
    c.stroke();
  }
  c.strokeStyle = colours.robot;
  c.lineWidth = 1.8;
  c.beginPath();
  state.trace.forEach(([time, deviation], i) => {
    const x = across(time), y = bottom - (bottom - top) * deviation / widest;
    if (i) c.lineTo(x, y); else c.moveTo(x, y);
  });
  c.stroke();
  if (state.robot && state.robot.is_there) {
    c.strokeStyle = colours.ink;
    c.lineWidth = 1;
    c.beginPath();
    c.moveTo(across(state.robot.time), top);
    c.lineTo(across(state.robot.time), bottom);
    c.stroke();
  }
}
