// Pointer and keys: strokes, via points, pushes.
import { WORLD } from "./scene.js";
import { addStroke, bend, fail, setMode, showExample, togglePause, undo } from "./app.js";

const NEAR = 28; // px: how far from the path it is taken hold of
const PEN_SPEED = 0.25, PUSH = 12; // m/s, N: of the arrow keys
const CENTRE = [WORLD.width / 2, WORLD.height / 2];
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export function listen(view, state) {
  const held = new Set();
  let began = 0, last = performance.now();
  const at = (event) => {
    const box = view.canvas.getBoundingClientRect();
    return view.world([event.clientX - box.left, event.clientY - box.top]);
  };
  const row = (event) => [(event.timeStamp - began) / 1000, ...at(event)];

  view.canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    event.preventDefault();
    view.canvas.focus({ preventScroll: true });
    view.canvas.setPointerCapture(event.pointerId);
    if (state.mode === "draw") {
      began = event.timeStamp;
      state.current = [row(event)];
    } else if (state.mode === "push") state.hand = at(event);
    else hold(at(event));
  });

  view.canvas.addEventListener("pointermove", (event) => {
    if (state.mode === "draw" && state.current) {
      const events = event.getCoalescedEvents ? event.getCoalescedEvents() : [];
      state.current.push(...(events.length ? events : [event]).map(row)); // with the times they had
    } else if (state.mode === "push" && state.hand) state.hand = at(event);
    else if (state.mode === "bend" && state.isHeld) { state.via[state.chosen].point = at(event); bend(false); }
  });

  const release = () => {
    state.hand = null;
    if (state.current) { const rows = state.current; state.current = null; addStroke(rows); }
    if (state.isHeld) { state.isHeld = false; bend(true); }
  };
  view.canvas.addEventListener("pointerup", release);
  view.canvas.addEventListener("pointercancel", release);

  function hold(point) {
    const picture = state.shown.length ? state.pictures[state.shown[0]] : null;
    if (!picture) { fail("There is no movement yet to bend: draw two strokes."); return; }
    const far = (place) => view.scale * Math.hypot(place[0] - point[0], place[1] - point[1]);
    const known = state.via.findIndex((via) => far(via.point) < NEAR / 2);
    if (known >= 0) state.chosen = known;
    else {
      const nearest = picture.path.reduce((best, place, i) => (far(place) < far(picture.path[best]) ? i : best), 0);
      if (far(picture.path[nearest]) > NEAR) return;
      pin(nearest, picture);
      state.via[state.chosen].point = point;
    }
    state.isHeld = true;
    bend(false);
  }

  function pin(i, picture) {
    if (state.via.length >= 12) { state.via.shift(); }
    state.via.push({ time: picture.time[i], point: [...picture.path[i]] });
    state.chosen = state.via.length - 1;
  }

  function nudge([dx, dy]) {
    const picture = state.shown.length ? state.pictures[state.shown[0]] : null;
    if (!picture) return;
    if (state.place !== null) {
      const i = Math.round(state.place * (picture.path.length - 1));
      state.chosen = state.via.findIndex((via) => via.time === picture.time[i]);
      if (state.chosen < 0) pin(i, picture);
    }
    if (state.chosen < 0) return;
    const via = state.via[state.chosen];
    via.point = [via.point[0] + 0.005 * dx, via.point[1] + 0.005 * dy];
    bend(true);
  }

  document.addEventListener("keydown", (event) => {
    const inField = ["INPUT", "SELECT"].includes(event.target.tagName);
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") undo();
    else if (event.ctrlKey || event.metaKey || event.altKey || inField) return;
    else if (event.key === " " && event.target.tagName !== "BUTTON" && event.target.tagName !== "SUMMARY") togglePause();
    else if ("dbp".includes(event.key.toLowerCase())) setMode({ d: "draw", b: "bend", p: "push" }[event.key.toLowerCase()]);
    else if (event.key.toLowerCase() === "e") showExample();
    else if (event.key in ARROWS) { if (state.mode === "bend") nudge(ARROWS[event.key]); else held.add(event.key); }
    else if ((event.key === "[" || event.key === "]") && state.mode === "bend") {
      const step = event.key === "[" ? -0.04 : 0.04;
      state.place = Math.min(1, Math.max(0, (state.place ?? 0.5) + step));
    } else if (event.key === "Backspace" && state.chosen >= 0) {
      state.via.splice(state.chosen, 1);
      state.chosen = state.via.length - 1;
      bend(true);
    } else if (event.key === "Enter" && state.mode === "draw" && event.target === view.canvas) {
      if (state.current) release();
      else { began = performance.now(); state.pen ??= CENTRE; state.current = [[0, ...state.pen]]; }
    } else return;
    event.preventDefault();
  });
  document.addEventListener("keyup", (event) => held.delete(event.key));
  window.addEventListener("blur", () => held.clear());

  return (now) => { // what held keys do until this frame
    const elapsed = Math.min(0.1, (now - last) / 1000), step = [0, 0];
    last = now;
    for (const key of held) ARROWS[key].forEach((part, k) => { step[k] += part; });
    state.push = state.mode === "push" ? step.map((part) => PUSH * part) : [0, 0];
    if (state.mode !== "draw" || !held.size) return;
    state.pen ??= CENTRE;
    state.pen = [
      Math.min(WORLD.width, Math.max(0, state.pen[0] + PEN_SPEED * elapsed * step[0])),
      Math.min(WORLD.height, Math.max(0, state.pen[1] + PEN_SPEED * elapsed * step[1])),
    ];
    if (state.current) state.current.push([(performance.now() - began) / 1000, ...state.pen]);
  };
}
