// The page's state, its socket, and what the controls do. The server moves the robot; this asks it for each frame.
import { empirical } from "./empirical.js";
import { EXAMPLES, example } from "./examples.js";
import { View, WORLD, drawScene, drawStrip, readColours } from "./scene.js";
import { listen } from "./input.js";

const find = (id) => document.getElementById(id);
const SLIDERS = [
  ["stiffness_min", "least K", 1, 1000, 1, "N/m"],
  ["stiffness_max", "largest K", 50, 3000, 10, "N/m"],
  ["damping_ratio", "damping", 0.05, 2, 0.05, ""],
  ["mass", "mass", 0.2, 20, 0.1, "kg"],
  ["speed", "speed", 0.25, 2, 0.05, "x"],
];

export const state = {
  mode: "draw", strokes: [], current: null, pen: null, undone: [],
  measured: null, pictures: {}, shown: [], draws: true, via: [], chosen: -1, place: null,
  settings: { stiffness_min: 50, stiffness_max: 1000, damping_ratio: 1, mass: 1, speed: 1, smooth: false, models: [] },
  schedule: null, robot: null, trace: [], hand: null, push: [0, 0], isPaused: false,
};
// For whoever measures: frames a second, and times from asking for a frame to having it, in ms.
export const statistics = { frames: 0, rate: 0, trips: [], learned: 0, asked: 0 };
window.playground = { state, statistics };

let socket = null, waiting = null, number = 0, isBending = false, bendDue = null;

export function ask(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function connect() {
  socket = new WebSocket(`ws://${location.host}${location.pathname}live`);
  socket.onmessage = (event) => receive(JSON.parse(event.data));
  socket.onclose = (event) => {
    state.robot = null;
    waiting = null;
    say(event.code === 1009 ? "That was too much to send." : "The playground has ended, or another page has this one's place.");
    if (event.code !== 1008) setTimeout(connect, 1500);
  };
}

function receive(answer) {
  if (answer.type === "robot") {
    const asked = waiting;
    waiting = null;
    if (asked) statistics.trips.push(performance.now() - asked.at);
    if (statistics.trips.length > 4000) statistics.trips.splice(0, 1000);
    if (!answer.is_there) return;
    const last = state.robot ? state.robot.time : 0;
    if (answer.time < last - 0.01) state.trace = [];
    if (!state.isPaused) state.trace.push([answer.time, answer.deviation]);
    if (state.trace.length > 3000) state.trace.splice(0, 1000);
    state.robot = answer;
  } else if (answer.type === "hello") {
    offer(answer);
    learn();
  } else if (answer.type === "restarted") {
    learn();
  } else if (answer.type === "picture") {
    if (isBending) { isBending = false; answer.draws = []; }
    if (!state.settings.models.includes(answer.model)) return;
    state.pictures[answer.model] = answer;
    state.shown = state.settings.models.filter((name) => state.pictures[name]);
    if (!statistics.learned) statistics.learned = performance.now();
    if (answer.seconds) say(`learned from ${visible().length} strokes in ${answer.seconds.toFixed(2)} s`);
    if (bendDue) bend(...bendDue);
  } else if (answer.type === "schedule") {
    state.schedule = answer;
    state.trace = [];
    report(answer);
  } else if (answer.type === "score") {
    const which = state.settings.models.indexOf(answer.model);
    if (which >= 0) find(`score-${which}`).textContent = `left-out strokes: ${answer.nats.toFixed(2)} nats a sample`;
  } else if (answer.type === "strokes") {
    const { place, note } = placement(answer.strokes);
    state.strokes = answer.strokes.map((rows) => ({ rows: rows.map(place), hidden: false }));
    changed();
    find("note").textContent = note; // what is taken home is not in the file's coordinates
  } else if (answer.type === "file") {
    const href = `data:application/octet-stream;base64,${answer.content}`;
    Object.assign(document.createElement("a"), { href, download: answer.name }).click();
  } else if (answer.type === "error") {
    isBending = false;
    fail(answer.text);
  }
}

// A file's movements may be anywhere and of any size: where they do not fit they are moved and scaled, all alike.
function placement(all) {
  const flat = all.flat(), low = [1, 2].map((k) => Math.min(...flat.map((row) => row[k])));
  const high = [1, 2].map((k) => Math.max(...flat.map((row) => row[k])));
  if (low[0] >= 0 && low[1] >= 0 && high[0] <= WORLD.width && high[1] <= WORLD.height)
    return { place: (row) => row, note: "The file's numbers count as metres." };
  const scale = Math.min(0.8 * WORLD.width / (high[0] - low[0] || 1), 0.8 * WORLD.height / (high[1] - low[1] || 1));
  const place = ([t, x, y]) => [t, 0.1 * WORLD.width + scale * (x - low[0]), 0.1 * WORLD.height + scale * (y - low[1])];
  return { place, note: `The file was moved, and scaled by ${scale.toPrecision(3)}: these files are not for its robot.` };
}

function say(text) { find("status").textContent = text; find("error").hidden = true; }

export function fail(text) { find("error").textContent = text; find("error").hidden = false; }

const visible = () => state.strokes.filter((stroke) => !stroke.hidden);

export function changed() {
  find("note").textContent = "";
  listStrokes();
  learn();
}

function learn() {
  state.via = [];
  state.chosen = -1;
  find("unbend").hidden = true;
  for (const which of [0, 1]) find(`score-${which}`).textContent = "";
  if (visible().length < 2) {
    Object.assign(state, { measured: null, pictures: {}, shown: [], schedule: null });
    find("safety").hidden = true;
    say(visible().length ? "Draw it once more, a little differently." : "Draw a movement here.");
    return;
  }
  say(state.schedule ? "learning ..." : "learning ... (at the start some seconds)");
  statistics.asked = performance.now();
  statistics.learned = 0;
  state.measured = empirical(visible().map((stroke) => stroke.rows));
  ask({ type: "learn", strokes: visible().map((stroke) => stroke.rows), settings: state.settings });
}

export function bend(isFinished) {
  if (isBending) { bendDue = [isFinished || (bendDue && bendDue[0])]; return; }
  bendDue = null;
  isBending = true;
  find("unbend").hidden = !state.via.length;
  ask({ type: "bend", points: state.via.map((via) => [via.time, ...via.point]), follow: Boolean(isFinished) });
}

function report(answer) {
  // Two spaces begin an entry, more go on with it; its name ends with two.
  const entries = answer.report.replace(/\n {3,}/g, " ").split("\n").slice(1).map((line) => line.trim().split(/ {2,}/));
  const verdict = find("verdict"), safety = find("safety");
  verdict.textContent = `Stability: ${entries[0][1]}`;
  verdict.className = answer.is_guaranteed ? "" : "wrong";
  find("report").textContent = entries.map((entry) => entry.join(": ")).join("\n");
  safety.hidden = false;
}

function listStrokes() {
  find("count").textContent = state.strokes.length || "";
  find("strokes").replaceChildren(...state.strokes.map((stroke, k) => {
    const item = document.createElement("li"), show = document.createElement("button"), drop = document.createElement("button");
    show.textContent = k + 1;
    show.className = stroke.hidden ? "hidden" : "";
    show.setAttribute("aria-label", `${stroke.hidden ? "show" : "hide"} stroke ${k + 1}`);
    show.onclick = () => { stroke.hidden = !stroke.hidden; changed(); };
    drop.textContent = "\u00d7";
    drop.setAttribute("aria-label", `remove stroke ${k + 1}`);
    drop.onclick = () => { state.undone.push([...state.strokes]); state.strokes.splice(k, 1); changed(); };
    item.onkeydown = (event) => {
      if (event.key === "h" || event.key === "H") show.click();
      else if (event.key === "Delete") drop.click();
      else return;
      event.stopPropagation();
    };
    item.append(show, drop);
    return item;
  }));
}

export function setMode(mode) {
  state.mode = mode;
  state.hand = null;
  for (const each of ["draw", "bend", "push"]) find(`mode-${each}`).setAttribute("aria-checked", String(each === mode));
}

export function undo() {
  if (state.undone.length) state.strokes = state.undone.pop();
  changed();
}

export function addStroke(rows) {
  if (rows.length < 5 || rows[rows.length - 1][0] < 0.1) { fail("That was too short: draw it more slowly."); return; }
  state.undone.push([...state.strokes]);
  state.strokes.push({ rows, hidden: false });
  changed();
}

export function showExample(name = EXAMPLES[(EXAMPLES.indexOf(find("example").value) + 1) % EXAMPLES.length]) {
  find("example").value = name;
  state.undone.push([...state.strokes]);
  state.strokes = example(name).map((rows) => ({ rows, hidden: false }));
  changed();
}

export function togglePause() {
  state.isPaused = !state.isPaused;
  find("pause").textContent = state.isPaused ? "Go on" : "Pause";
}

function options(select, names, chosen) {
  select.replaceChildren(...names.map(([value, text]) => new Option(text, value, false, value === chosen)));
}

function offer({ models, files }) {
  const before = state.settings.models;
  options(find("model-0"), models.map((name) => [name, name]), before[0]);
  options(find("model-1"), [["", "compare with ..."], ...models.map((name) => [name, name])], before[1] || "");
  find("files").replaceChildren(...files.map((name) => {
    const button = Object.assign(document.createElement("button"), { textContent: name });
    button.onclick = () => ask({ type: "take", name });
    return button;
  }));
  choose();
}

function choose() {
  state.settings.models = [...new Set([find("model-0").value, find("model-1").value])].filter(Boolean);
  state.pictures = {};
  state.shown = [];
}

function readFile(file) {
  if (!file) return;
  const reader = new FileReader();
  reader.onload = () => ask({ type: "read", name: file.name, content: reader.result.split(",")[1] || "" });
  reader.readAsDataURL(file);
}

function controls() {
  options(find("example"), EXAMPLES.map((name) => [name, name]), EXAMPLES[0]);
  find("example").onchange = () => showExample(find("example").value);
  find("undo").onclick = undo;
  find("clear").onclick = () => { state.undone.push([...state.strokes]); state.strokes = []; changed(); };
  find("open").onchange = (event) => readFile(event.target.files[0]);
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => { event.preventDefault(); readFile(event.dataTransfer.files[0]); });
  for (const which of [0, 1]) find(`model-${which}`).onchange = () => { choose(); learn(); };
  find("draws").onchange = (event) => { state.draws = event.target.checked; };
  find("unbend").onclick = () => { state.via = []; state.chosen = -1; bend(true); };
  find("pause").onclick = togglePause;
  for (const mode of ["draw", "bend", "push"]) find(`mode-${mode}`).onclick = () => setMode(mode);
  const adjust = () => state.schedule && ask({ type: "adjust", settings: state.settings });
  find("smooth").onchange = (event) => { state.settings.smooth = event.target.checked; adjust(); };
  find("sliders").replaceChildren(...SLIDERS.map(([name, text, low, high, step, unit]) => {
    const label = document.createElement("label"), value = document.createElement("output");
    const input = Object.assign(document.createElement("input"), { type: "range", min: low, max: high, step, id: name });
    input.value = state.settings[name];
    const show = () => { value.textContent = `${Number(input.value)} ${unit}`; };
    input.oninput = show;
    input.onchange = () => {
      state.settings[name] = Number(input.value);
      const [least, most] = [find("stiffness_min"), find("stiffness_max")];
      if (Number(least.value) > Number(most.value)) {
        const other = name === "stiffness_min" ? most : least;
        other.value = input.value;
        other.oninput();
        state.settings[other.id] = Number(other.value);
      }
      adjust();
    };
    label.className = "slider";
    label.append(text, input, value);
    show();
    return label;
  }));
}

let second = performance.now(), count = 0;
function frame(now) {
  count += 1;
  statistics.frames += 1;
  if (now - second > 1000) { statistics.rate = 1000 * count / (now - second); second = now; count = 0; }
  const { hand, push, isPaused } = state, late = waiting && performance.now() - waiting.at > 1000;
  if ((!waiting || late) && socket && socket.readyState === WebSocket.OPEN) {
    waiting = { at: performance.now() };
    ask({ type: "frame", frame: (number += 1), hand, push, is_paused: isPaused });
  }
  move(now);
  drawScene(scene, state);
  drawStrip(strip, state);
  requestAnimationFrame(frame);
}

readColours();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readColours);
const scene = new View(find("scene")), strip = new View(find("strip"));
controls();
const move = listen(scene, state);
state.strokes = example(EXAMPLES[0]).map((rows) => ({ rows, hidden: false }));
listStrokes();
connect();
requestAnimationFrame(frame);
