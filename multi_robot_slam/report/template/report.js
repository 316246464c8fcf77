"use strict";

// ---- data: figures as Plotly takes them, and what the slider shows

const {frames, figures, sights} = JSON.parse(document.getElementById("data").textContent);
const TYPES = {f4: Float32Array, f8: Float64Array, i4: Int32Array};

function unpacked({dtype, bdata}) {
  return new TYPES[dtype](Uint8Array.from(atob(bdata), c => c.charCodeAt(0)).buffer);
}

for (const part of [frames, frames.landmarks, ...Object.values(frames.robots), ...Object.values(sights)]) {
  for (const [key, value] of Object.entries(part)) {
    if (value && value.bdata !== undefined) part[key] = unpacked(value);
  }
}

// Whole paths, from which those of a limited time are cut.
const paths = new Map(figures.scene.data.filter(trace => trace.meta.is_path).map(trace => [
  trace, Object.fromEntries(["x", "y", "z", "customdata"].map(key => [key, unpacked(trace[key])]))]));

// In the order of the configuration, which the JSON's alphabetic one need not be.
const team = frames.team.map(name => frames.robots[name]);

const state = {step: Math.max(0, frames.seconds.length - 1), scale: 1, trail: Infinity, hidden: new Set()};

// ---- looks

const dark = window.matchMedia("(prefers-color-scheme: dark)");

function template() {
  const [ink, line, paper] = dark.matches
    ? ["#C3CAD2", "#2F363E", "#12161B"] : ["#3D444D", "#E4E8EC", "#FFFFFF"];
  const axis = {gridcolor: line, zerolinecolor: line, linecolor: line, automargin: true, title: {standoff: 8}};
  const axis3d = {gridcolor: line, zerolinecolor: line, linecolor: line, showbackground: false, showspikes: false};
  return {layout: {
    font: {family: "system-ui, sans-serif", size: 12, color: ink},
    paper_bgcolor: paper, plot_bgcolor: paper, hovermode: "x unified",
    hoverlabel: {bgcolor: paper, bordercolor: line, font: {color: ink}, namelength: -1},
    xaxis: {...axis, hoverformat: ".1f"}, yaxis: {...axis, hoverformat: ".3~f"},
    margin: {l: 56, r: 12, t: 34, b: 40},
    legend: {orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom"},
    modebar: {bgcolor: "rgba(0,0,0,0)", color: "#7D8590", activecolor: ink},
    scene: {xaxis: axis3d, yaxis: axis3d, zaxis: {...axis3d, nticks: 3, title: ""}},
  }};
}

const CHART = {displayModeBar: false, responsive: true};
// The wheel scrolls the page, over the scene too.
const SCENE = {displaylogo: false, responsive: true, scrollZoom: false, modeBarButtons: [["orbitRotation", "pan3d", "zoom3d", "toImage"]]};

// ---- shapes in the scene

const UNIT_CIRCLE = Array.from({length: 33}, (_, n) => [Math.cos(n * Math.PI / 16), Math.sin(n * Math.PI / 16)]);

// An octahedron with every face cut in four, pushed out to the unit sphere.
const SPHERE = (() => {
  const points = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];
  const middles = new Map();
  const middle = (a, b) => {
    const key = Math.min(a, b) * 6 + Math.max(a, b);
    if (!middles.has(key)) {
      middles.set(key, points.length);
      points.push([0, 1, 2].map(d => (points[a][d] + points[b][d]) / Math.SQRT2));
    }
    return middles.get(key);
  };
  const faces = [];
  for (const x of [0, 1]) for (const y of [2, 3]) for (const z of [4, 5]) {
    const [xy, yz, zx] = [middle(x, y), middle(y, z), middle(z, x)];
    faces.push([x, xy, zx], [y, yz, xy], [z, zx, yz], [xy, yz, zx]);
  }
  return {points, faces};
})();

// The landmarks seen so far; they are stored in the order in which they were first seen.
function seenSoFar() {
  const first = frames.landmarks.first;
  let count = first.length;
  while (count && first[count - 1] > state.step) count--;
  return count;
}

function landmarks() {
  const {positions, ids, observations} = frames.landmarks, count = seenSoFar();
  const rows = Array.from({length: count}, (_, n) => n);
  return {
    x: rows.map(n => positions[3 * n]),
    y: rows.map(n => positions[3 * n + 1]),
    z: rows.map(n => positions[3 * n + 2]),
    text: rows.map(n => `${ids[n]}, observed ${observations[n]} times`),
  };
}

function ellipsoids() {
  const {positions, roots} = frames.landmarks, {points, faces} = SPHERE, count = seenSoFar();
  const [x, y, z] = [0, 1, 2].map(() => new Float32Array(count * points.length));
  const [i, j, k] = [0, 1, 2].map(() => new Int32Array(count * faces.length));
  for (let n = 0; n < count; n++) {
    const [xx, xy, xz, yy, yz, zz] = roots.subarray(6 * n, 6 * n + 6), base = n * points.length;
    points.forEach(([a, b, c], p) => {
      x[base + p] = positions[3 * n] + state.scale * (xx * a + xy * b + xz * c);
      y[base + p] = positions[3 * n + 1] + state.scale * (xy * a + yy * b + yz * c);
      z[base + p] = positions[3 * n + 2] + state.scale * (xz * a + yz * b + zz * c);
    });
    faces.forEach((face, f) => [i, j, k].forEach((to, v) => { to[n * faces.length + f] = base + face[v]; }));
  }
  return {x, y, z, i, j, k};
}

// Tip, left, notch, right of an arrow-head at a pose (x, y, yaw), on the ground.
function arrow(pose) {
  const [x, y, yaw] = pose, [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [[1, 0], [-0.7, 0.6], [-0.35, 0], [-0.7, -0.6]].map(([ahead, left]) => [
    x + frames.body_m * (c * ahead - s * left), y + frames.body_m * (s * ahead + c * left)]);
}

function body(robot) {
  const corners = arrow(at(robot.poses)), low = 0.02, high = low + 0.25 * frames.body_m;
  return {
    x: [...corners, ...corners].map(p => p[0]), y: [...corners, ...corners].map(p => p[1]),
    z: [low, low, low, low, high, high, high, high],
    i: [0, 0, 4, 4, 0, 0, 1, 1, 2, 2, 3, 3], j: [1, 2, 5, 6, 1, 5, 2, 6, 3, 7, 0, 4], k: [2, 3, 6, 7, 5, 4, 6, 5, 7, 6, 4, 7],
  };
}

function trueBody(robot) {
  const corners = arrow(at(robot.truth)), closed = [...corners, corners[0]];
  return {x: closed.map(p => p[0]), y: closed.map(p => p[1]), z: closed.map(() => 0.02)};
}

function ellipse(robot) {
  const [x, y] = at(robot.means), [xx, xy, yy] = at(robot.roots);
  return {
    x: UNIT_CIRCLE.map(([a, b]) => x + state.scale * (xx * a + xy * b)),
    y: UNIT_CIRCLE.map(([a, b]) => y + state.scale * (xy * a + yy * b)),
    z: UNIT_CIRCLE.map(() => 0.02 + 0.3 * frames.body_m),
  };
}

function sight(robot) {
  const [x, y] = at(robot.poses), positions = frames.landmarks.positions;
  const seen = now(robot.seen, robot.seen_starts).map(n => positions.subarray(3 * n, 3 * n + 3));
  const met = now(robot.met, robot.met_starts).map(n => [...at(team[n].poses).subarray(0, 2), 0]);
  const ends = [...seen, ...met];
  return {
    x: ends.flatMap(end => [x, end[0], null]),
    y: ends.flatMap(end => [y, end[1], null]),
    z: ends.flatMap(end => [robot.camera_m, end[2], null]),
  };
}

// Of lists one after the other, that of the chosen time.
function now(values, starts) {
  return Array.from(values.subarray(starts[state.step], starts[state.step + 1]));
}

function recent({x, y, z, customdata}) {
  if (state.trail === Infinity) return {x, y, z, customdata};
  const end = frames.seconds[state.step], from = customdata.findIndex(t => t >= end - state.trail);
  const past = customdata.findIndex(t => t > end), to = past < 0 ? customdata.length : past;
  const cut = values => from < 0 ? values.subarray(0, 0) : values.subarray(from, to);
  return {x: cut(x), y: cut(y), z: cut(z), customdata: cut(customdata)};
}

function at(values) {
  return values.subarray(3 * state.step, 3 * state.step + 3);
}

const SHAPES = {landmarks, uncertainty: ellipsoids, body, ellipse, sight, true_body: trueBody};
const LAYER_OF = {body: "", ellipse: "uncertainty", true_body: "truth"};

// ---- drawing

const divs = new Map([...document.querySelectorAll("[data-figure]")].map(div => [div.dataset.figure, div]));

function isShown({layer, robot}) {
  return !state.hidden.has(`layer ${LAYER_OF[layer] ?? layer}`) && !state.hidden.has(`robot ${robot}`);
}

// Its x axis is the time.
function isOverTime(name) {
  return name !== "scene" && figures[name].layout.meta?.is_over_time !== false;
}

function drawScene() {
  const {data, layout} = figures.scene;
  for (const trace of data) {
    trace.visible = isShown(trace.meta);
    if (paths.has(trace) && frames.seconds.length) Object.assign(trace, recent(paths.get(trace)));
    if (trace.meta.moves && trace.visible && frames.seconds.length) {
      Object.assign(trace, SHAPES[trace.meta.layer](frames.robots[trace.meta.robot]));
    }
  }
  return Plotly.react(divs.get("scene"), data, layout, SCENE);
}

function drawChart(name) {
  const {data, layout} = figures[name];
  return Plotly.react(divs.get(name), data, layout, CHART);
}

function drawAll() {
  for (const {layout} of Object.values(figures)) layout.template = template();
  return Promise.all([...divs.keys()].map(name => name === "scene" ? drawScene() : drawChart(name)));
}

function moveCursors() {
  const x = frames.seconds[state.step];
  for (const [name, div] of divs) {
    if (isOverTime(name) && visible.has(div)) Plotly.relayout(div, {"shapes[0].x0": x, "shapes[0].x1": x});
  }
}

// ---- what the cameras saw

const SVG = "http://www.w3.org/2000/svg";
const MARKS = [
  ["matched", "circle", ([x, y]) => ({cx: x, cy: y, r: 2})],
  ["new", "circle", ([x, y]) => ({cx: x, cy: y, r: 2.2})],
  ["rejected", "path", ([x, y]) => ({d: `M${x - 2.2},${y - 2.2}l4.4,4.4m0,-4.4l-4.4,4.4`})],
];

function mark(kind, place) {
  const [name, shape, attributes] = MARKS[kind], element = document.createElementNS(SVG, shape);
  element.setAttribute("class", name);
  for (const [key, value] of Object.entries(attributes(place))) element.setAttribute(key, value);
  return element;
}

// The newest picture at the chosen time; before the first, none.
function drawSights() {
  for (const figure of document.querySelectorAll("[data-sight]")) {
    const name = figure.dataset.sight, seen = sights[name];
    let shown = seen.instants.length - 1;
    while (shown >= 0 && seen.instants[shown] > state.step) shown--;
    figure.hidden = state.hidden.has(`robot ${name}`);
    if (figure.dataset.shown === String(shown)) continue;
    figure.dataset.shown = shown;
    const image = figure.querySelector("img"), marks = [];
    image.style.visibility = shown < 0 ? "hidden" : "visible";
    image.src = `data:image/jpeg;base64,${seen.pictures[Math.max(shown, 0)]}`;
    for (let n = seen.starts[shown] ?? 0; n < (seen.starts[shown + 1] ?? 0) && shown >= 0; n++) {
      marks.push(mark(seen.kinds[n], seen.points.subarray(2 * n, 2 * n + 2)));
    }
    figure.querySelector("svg").replaceChildren(...marks);
    const counts = MARKS.map(([kind]) => `${marks.filter(m => m.getAttribute("class") === kind).length} ${kind}`);
    figure.querySelector("output").textContent = shown < 0 ? "no picture yet" : `${seen.taken[shown].toFixed(1)} s: ${counts.join(", ")}`;
  }
}

// ---- time

const slider = document.getElementById("time-slider");
const play = document.getElementById("play");
const PLAY_MS = 20000;  // the whole run
let isDrawing = false, playing = null;

function show(step) {
  state.step = Math.min(Math.max(0, step), frames.seconds.length - 1);
  const told = `${frames.seconds[state.step].toFixed(1)} s, step ${frames.steps[state.step]}`;
  slider.value = state.step;
  slider.setAttribute("aria-valuetext", told);
  document.getElementById("time-shown").textContent = told;
  if (!isDrawing) draw();
}

// One drawing at a time: where it is slow, times in between are left out.
async function draw() {
  isDrawing = true;
  for (let drawn = null; drawn !== state.step;) {
    await new Promise(requestAnimationFrame);
    drawn = state.step;
    moveCursors();
    drawSights();
    await drawScene();
  }
  isDrawing = false;
}

function toggle() {
  if (playing) return stop();
  const last = frames.seconds.length - 1, first = state.step >= last ? 0 : state.step;
  const since = performance.now();
  playing = setInterval(() => {
    const step = first + Math.floor((performance.now() - since) / PLAY_MS * (last + 1));
    if (step !== state.step && !isDrawing) show(step);
    if (state.step === last) stop();
  }, 50);
  play.textContent = "❚❚";
  play.setAttribute("aria-label", "Pause");
}

function stop() {
  clearInterval(playing);
  playing = null;
  play.textContent = "▶";
  play.setAttribute("aria-label", "Play");
}

// ---- start

const CAMERAS = {
  aslant: {eye: {x: -0.1, y: -0.85, z: 0.85}, center: {x: 0, y: 0, z: -0.18}, up: {x: 0, y: 0, z: 1}},
  above: {eye: {x: 0, y: 0, z: 1.4}, center: {x: 0, y: 0, z: 0}, up: {x: 0, y: 1, z: 0}},
};

// Farther away where the picture is higher than wide.
function fitted(camera) {
  const {clientWidth, clientHeight} = divs.get("scene");
  return moved(camera, Math.max(1, 1.3 * clientHeight / clientWidth));
}

function moved({eye, center, up}, factor) {
  const shifted = axis => center[axis] + factor * (eye[axis] - center[axis]);
  return {eye: {x: shifted("x"), y: shifted("y"), z: shifted("z")}, center, up};
}

function look(camera) {
  return Plotly.relayout(divs.get("scene"), {"scene.camera": camera});
}

const controls = document.getElementById("controls");

function readControls() {
  const boxes = [...controls.querySelectorAll("input")];
  state.hidden = new Set(boxes.filter(box => !box.checked).map(box => `${box.name} ${box.value}`));
  state.scale = Number(controls.elements.scale.value);
  state.trail = Number(controls.elements.trail.value);
}

controls.addEventListener("change", () => { readControls(); drawSights(); drawScene(); });
controls.addEventListener("click", ({target}) => {
  if (target.dataset.view) look(fitted(CAMERAS[target.dataset.view]));
  if (target.dataset.zoom) look(moved(figures.scene.layout.scene.camera, Number(target.dataset.zoom)));
});
controls.addEventListener("submit", event => event.preventDefault());

// Charts out of sight get their cursor when they come into view.
const visible = new Set();
const watcher = new IntersectionObserver(entries => {
  for (const {target, isIntersecting} of entries) visible[isIntersecting ? "add" : "delete"](target);
  if (slider) moveCursors();
});

figures.scene.layout.uirevision = "kept";
figures.scene.layout.margin = {l: 0, r: 0, t: 0, b: 0};
figures.scene.layout.hovermode = "closest";
figures.scene.layout.scene.camera = fitted(CAMERAS.aslant);
for (const [name, {layout}] of Object.entries(figures)) {
  if (!isOverTime(name)) continue;
  const cursor = {type: "line", xref: "x", yref: "paper", y0: 0, y1: 1, x0: 0, x1: 0, line: {color: "#7D8590", width: 1}};
  layout.shapes = [cursor, ...(layout.shapes ?? [])];
}
readControls();
drawAll().then(() => {
  for (const [name, div] of divs) {
    if (!isOverTime(name)) continue;
    watcher.observe(div);
    div.on("plotly_click", ({points}) => show(nearest(points[0].x)));
  }
  if (slider) {
    slider.max = frames.seconds.length - 1;
    slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
    play.addEventListener("click", toggle);
    show(state.step);
  }
  document.documentElement.dataset.ready = "";
});
dark.addEventListener("change", drawAll);

function nearest(seconds) {
  let best = 0;
  frames.seconds.forEach((t, n) => { if (Math.abs(t - seconds) < Math.abs(frames.seconds[best] - seconds)) best = n; });
  return best;
}
